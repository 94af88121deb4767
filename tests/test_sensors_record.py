"""Recording on the rig: what is kept, what is not, and that it can be repeated."""

import dataclasses

import numpy as np
import pytest

from ddgrasp import contract, machine
from ddgrasp.config import RandomConfig
from ddgrasp.presets import get_preset
from ddgrasp.shipped import PRETRAINED
from rig import stage
from rig import world as rig
from rig.camera import make_camera
from rig.stage import act, record_all, record_trajectory
from sensors.recordings.recording import Recording


@pytest.fixture(scope="module")
def config():
    config = get_preset("debug")
    return dataclasses.replace(config, record=dataclasses.replace(config.record, frames=4))


def _record(config, path, index=0) -> Recording:
    world = rig.make_world(config.world)
    camera = make_camera(config, world)

    def reach_down(observation: np.ndarray) -> np.ndarray:
        assert observation.shape == (contract.OBSERVATION_SIZE,)
        return np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.5, 0.0, -1.0])

    record_trajectory(config, index, path, world, camera, reach_down)
    return Recording.open(path)


def test_trajectory_is_rgbd_and_nothing_else(config, tmp_path):
    recording = _record(config, tmp_path / "rig_0000")
    assert len(recording) == 4 and recording.consecutive
    profile = config.world.profile
    assert (recording.height_px, recording.width_px) == (profile.height_px, profile.width_px)
    assert sorted(p.name for p in recording.path.iterdir()) == ["color", "depth", "meta.json"]
    assert not any("pose" in key or "T_" in key or "position" in key for key in recording.meta)
    first, last = recording.depth_mm(0), recording.depth_mm(3)
    assert 0.05 < np.mean(first == 0) < 0.3
    # The robot moved: some pixels changed by centimetres, most only by noise.
    both = (first > 0) & (last > 0)
    change = np.abs(first.astype(int) - last)[both]
    assert np.mean(change > 50) > 0.003 and np.median(change) < 10


def test_same_index_gives_the_same_recording_another_index_another_view(config, tmp_path):
    one, two = (_record(config, tmp_path / name) for name in ("a", "b"))
    other = _record(config, tmp_path / "c", index=1)
    np.testing.assert_array_equal(one.depth_mm(2), two.depth_mm(2))
    assert np.mean(one.depth_mm(2) != other.depth_mm(2)) > 0.5


def test_with_other_tables_a_recording_has_its_own_whatever_was_recorded_before(config, tmp_path):
    config = dataclasses.replace(config, record=dataclasses.replace(config.record, other_tables=True))
    world = rig.make_world(config.world)
    camera = make_camera(config, world)
    for index in range(2):
        record_trajectory(config, index, tmp_path / f"one{index}", world, camera, lambda _: np.zeros(8))
    afresh = make_camera(config, world)
    record_trajectory(config, 1, tmp_path / "again", world, afresh, lambda _: np.zeros(8))
    ordinary = make_camera(get_preset("debug"), world)
    record_trajectory(config, 1, tmp_path / "own", world, ordinary, lambda _: np.zeros(8))
    one, again, own = (Recording.open(tmp_path / name).depth_mm(3) for name in ("one1", "again", "own"))
    np.testing.assert_array_equal(one, again)
    assert np.mean(one != own) > 0.1


def test_action_is_scaled_and_clipped_to_the_joint_limits(config):
    world = rig.RigWorld(config.world.objects, RandomConfig(friction_nm=0.0, joint_rad=0.0))
    world.reset(0, "cube")
    before, _ = world.state()
    for _ in range(10):
        act(world, np.array([1.0, 0, 0, 0, 0, 0, 0, 1.0]))
    after, width_m = world.state()
    # Ten steps of 0.1 rad, less the lag of the first, give or take an overshoot.
    assert 0.5 < after[0] - before[0] <= 10 * contract.ACTION_SCALE_RAD * 1.05
    assert np.all(after <= np.array(contract.JOINT_UPPER_RAD) + 0.02)
    assert width_m < 0.03


def test_recordings_of_several_processes_are_those_of_one(config, tmp_path, monkeypatch):
    teacher = PRETRAINED / "teacher"
    monkeypatch.setattr(machine, "cores", lambda: 2)
    for name, frames in (("here", 240), ("spread", 4)):
        monkeypatch.setattr(stage, "FRAMES_A_PROCESS", frames)
        (tmp_path / name).mkdir()
        assert (
            list(record_all(config, teacher, [(i, tmp_path / name / str(i)) for i in range(3)])) == [None] * 3
        )
    for i in range(3):
        here, spread = (Recording.open(tmp_path / name / str(i)) for name in ("here", "spread"))
        assert here.meta["object"] == spread.meta["object"]
        for frame in range(4):
            np.testing.assert_array_equal(here.depth_mm(frame), spread.depth_mm(frame))
            np.testing.assert_array_equal(here.rgb(frame), spread.rgb(frame))
