"""What docs/data.md says of the demonstrations' store is what the store is."""

import re
from pathlib import Path

import numpy as np

from demos.rollout import Episodes, successful
from demos.spool import Spool
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
    code, *_ = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict = {}
    exec(code, names)
    read = list(names["episodes"](str(tmp_path / "episodes.zarr")))
    assert len(read) == len(written)
    for arrays, steps in zip(read, written, strict=True):
        for array, name in zip(arrays, ("depth_mm", "state", "action"), strict=True):
            np.testing.assert_array_equal(array, steps[name])


def test_the_page_names_what_a_rollout_writes_and_nothing_else(tmp_path):
    depth, rgb = Spool(tmp_path), Spool(tmp_path)
    depth.add(np.zeros((1, 2, 3), np.uint16))
    rgb.add(np.zeros((1, 2, 3, 3), np.uint8))
    one = np.ones(1, int)
    episodes = Episodes(
        state=np.zeros((1, 1, 8)), action=np.zeros((1, 1, 8)), observation=np.zeros((1, 1, 40)),
        held=np.zeros((1, 1), bool), length=one, success=one > 0, object_index=one, variant=one,
        T_world_cam=np.eye(4)[None], size=np.ones(1), depth_mm=depth, rgb=rgb,
    )  # fmt: skip
    ((steps, of_episode),) = successful(episodes)
    written = {*(f"data/{name}" for name in steps), *(f"meta/{name}" for name in of_episode)}
    named = set(re.findall(r"`((?:data|meta)/\w+)`", PAGE))
    assert named == written | {"meta/episode_ends"}
