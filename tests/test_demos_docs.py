"""What docs/data.md says of the demonstrations' store is what the store is."""

import re
from pathlib import Path

import numpy as np

from demos.store import EpisodeStore

PAGE = (Path(__file__).parents[1] / "docs" / "data.md").read_text()


def test_the_page_s_reader_reads_a_store(tmp_path):
    lengths, rng = (3, 5), np.random.default_rng(0)
    store = EpisodeStore(tmp_path / "episodes.zarr", create=True)
    written = []
    for length in lengths:
        steps = {
            "depth_mm": rng.integers(1, 900, (length, 18, 32)).astype(np.uint16),
            "state": rng.random((length, 8), np.float32),
            "action": rng.random((length, 8), np.float32),
        }
        store.append(steps, {"object_index": np.int32(0)})
        written.append(steps)
    code, _ = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict = {}
    exec(code, names)
    read = list(names["episodes"](str(tmp_path / "episodes.zarr")))
    assert len(read) == len(written)
    for arrays, steps in zip(read, written, strict=True):
        for array, name in zip(arrays, ("depth_mm", "state", "action"), strict=True):
            np.testing.assert_array_equal(array, steps[name])


def test_the_page_names_what_a_rollout_writes():
    source = (Path(__file__).parents[1] / "demos" / "rollout.py").read_text()
    named = set(re.findall(r"`(?:data|meta)/(\w+)`", PAGE)) - {"episode_ends"}
    assert {name for name in named if f'"{name}"' not in source} == set()
