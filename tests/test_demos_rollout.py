"""What becomes a demonstration, and how its teacher is disturbed."""

import numpy as np

from demos.rollout import Episodes, Scene, noisy_teacher, successful
from demos.spool import Spool

COUNT, STEPS, NOISE = 400, 24, 0.3


def episodes(success: list[bool], length: list[int]) -> Episodes:
    """Random episodes, one for each of `success`."""
    rng, count = np.random.default_rng(0), len(success)
    spool = Spool()
    for _ in range(STEPS):
        spool.add(rng.integers(0, 999, (count, 4, 5)).astype(np.uint16))
    return Episodes(
        state=rng.normal(size=(count, STEPS, 8)),
        action=rng.normal(size=(count, STEPS, 8)),
        observation=rng.normal(size=(count, STEPS, 40)),
        held=rng.random((count, STEPS)) > 0.5,
        length=np.array(length),
        success=np.array(success),
        object_index=np.arange(count),
        T_world_cam=rng.normal(size=(count, 4, 4)),
        variant=np.arange(count) + 10,
        size=1.0 + np.arange(count) / 10,
        depth_mm=spool,
    )


def test_episodes_that_succeed_are_kept_as_long_as_they_lasted():
    all_of_them = episodes([True, False, True, False], [7, 24, 12, 3])
    kept = list(successful(all_of_them))
    assert [int(episode["object_index"]) for _, episode in kept] == [0, 2]
    for (steps, episode), i, length in zip(kept, (0, 2), (7, 12), strict=True):
        assert {len(rows) for rows in steps.values()} == {length}
        for name in ("state", "action", "observation"):
            np.testing.assert_array_equal(
                steps[name], getattr(all_of_them, name)[i, :length].astype(np.float32)
            )
        np.testing.assert_array_equal(steps["held"], all_of_them.held[i, :length])
        assert all_of_them.depth_mm is not None
        np.testing.assert_array_equal(steps["depth_mm"], all_of_them.depth_mm.episode(i, length))
        np.testing.assert_array_equal(episode["T_world_cam"], all_of_them.T_world_cam[i].astype(np.float32))
        assert (int(episode["variant"]), float(episode["size"])) == (10 + i, np.float32(1.0 + i / 10))


def acted(noise: float, share: float) -> np.ndarray:
    """(STEPS, COUNT, 8) what a disturbed teacher that stands still does."""
    actor = noisy_teacher(np.random.default_rng(0), COUNT, noise, share)
    nothing = np.zeros((COUNT, 0, 0), np.uint16)
    still = np.zeros((COUNT, 8))
    still[:, 7] = -1.0
    about = {"observation": np.zeros((COUNT, 40)), "held": np.zeros(COUNT, bool)}
    return np.stack(
        [actor(Scene(nothing, np.zeros((COUNT, 8)), still, step=t, **about)) for t in range(STEPS)]
    )


def test_a_push_holds_for_four_steps_and_leaves_the_gripper_alone():
    actions = acted(NOISE, share=0.1)
    np.testing.assert_array_equal(actions[..., 7], -1.0)
    pushed = actions[..., :7].any(axis=-1)
    changes = np.diff(actions[..., :7], axis=0).any(axis=-1)
    for environment in range(COUNT):
        starts = np.flatnonzero(pushed[:, environment] & np.r_[True, changes[:, environment]])
        for start in starts[starts <= STEPS - 4]:
            held = actions[start : start + 4, environment, :7]
            np.testing.assert_array_equal(held, held[[0] * 4])
    # A share s of the free steps begins a push of four: 4 s / (1 + 3 s) of all are pushed.
    assert abs(pushed[8:].mean() - 0.4 / 1.3) < 0.03
    assert abs(actions[..., :7][pushed].std() - NOISE) < 0.02


def test_without_noise_the_teacher_acts():
    for actions in (acted(0.0, share=1.0), acted(NOISE, share=0.0)):
        assert not actions[..., :7].any()


def test_no_action_is_beyond_its_bounds():
    assert np.abs(acted(5.0, share=1.0)).max() == 1.0
