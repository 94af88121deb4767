"""Work that is spread over processes, from scripts of users."""

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import sys
from ddgrasp.workers import spread
from workers_support import Doubler

print("script", flush=True)
assert sorted(spread(Doubler, [1, 2, 3], 2)) == [2, 4, 6]
assert sys.modules["__main__"].__spec__ is None and __file__ == sys.argv[0]
print("done")
"""


def test_a_script_without_a_guard_is_not_run_again_by_its_workers(tmp_path: Path):
    script = tmp_path / "mine.py"
    script.write_text(SCRIPT)
    root = Path(__file__).parents[1]
    told = subprocess.run(
        [sys.executable, str(script)],
        env={"PYTHONPATH": f"{root}:{root / 'tests'}"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (told.returncode, told.stdout.split()) == (0, ["script", "done"]), told.stderr
