"""Work that is spread over processes, from scripts of users."""

import subprocess
import sys
from multiprocessing import get_context
from pathlib import Path

import pytest

from ddgrasp.workers import spread
from workers_support import Doubler

UNGUARDED = """
import sys
from ddgrasp.workers import spread
from workers_support import Doubler

print("script", flush=True)
assert sorted(spread(Doubler, [1, 2, 3], 2)) == [2, 4, 6]
assert sys.modules["__main__"].__spec__ is None and __file__ == sys.argv[0]
print("done")
"""


ITEMS = """
from ddgrasp.workers import spread
from workers_support import Doubler

class Number(int):
    pass

if __name__ == "__main__":
    print(sorted(map(int, spread(Doubler, [Number(1), Number(2)], 2))))
"""
OWN = """
from ddgrasp.workers import spread

class Own:
    def run(self, item):
        return item + 1
    def close(self):
        pass

{guard}
    print(sorted(spread(Own, [1, 2, 3], 2)))
"""


def run(script: Path, text: str) -> subprocess.CompletedProcess[str]:
    script.write_text(text)
    root = Path(__file__).parents[1]
    return subprocess.run(
        [sys.executable, str(script)],
        env={"PYTHONPATH": f"{root}:{root / 'tests'}"},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_a_script_without_a_guard_is_not_run_again_by_its_workers(tmp_path: Path):
    told = run(tmp_path / "mine.py", UNGUARDED)
    assert (told.returncode, told.stdout.split()) == (0, ["script", "done"]), told.stderr


@pytest.mark.parametrize(
    ("guard", "said"), [('if __name__ == "__main__":', "[2, 3, 4]"), ("if True:", "put it into a module")]
)
def test_a_worker_of_the_script_s_own_needs_the_guard(tmp_path: Path, guard: str, said: str):
    told = run(tmp_path / "own.py", OWN.format(guard=guard))
    assert said in (told.stdout if "main" in guard else told.stderr.splitlines()[-1])


def test_items_of_the_script_s_own_arrive(tmp_path: Path):
    told = run(tmp_path / "items.py", ITEMS)
    assert told.stdout == "[2, 4]\n", told.stderr


def doubled(numbers: list[int]) -> list[int]:
    return list(spread(Doubler, numbers, 2))


def test_in_a_worker_of_multiprocessing_all_is_done_there():
    with get_context("spawn").Pool(1) as pool:
        assert pool.apply(doubled, ([1, 2],)) == [2, 4]
