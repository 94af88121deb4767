"""A closing lasts until the hand had the time to shut; everything else passes."""

import numpy as np

from ddgrasp.gripper import CLOSE, ClosingLatch, WidthChange


def _actions(*commands: float) -> np.ndarray:
    """(8,) actions with these gripper commands, the arm's counting up."""
    made = np.zeros((len(commands), 8), np.float32)
    made[:, :7] = np.arange(len(commands))[:, None]
    made[:, 7] = commands
    return made


def _commands(latch: ClosingLatch, *commands: float) -> list[float]:
    return [round(float(latch(action)[7]), 3) for action in _actions(*commands)]


def test_a_closing_lasts_and_then_the_policy_decides():
    latch = ClosingLatch(3)
    assert _commands(latch, -1, 0.5, -1, -1, -1, -0.5) == [-1, 0.5, CLOSE, CLOSE, -1, -0.5]
    assert _commands(latch, 0.5, -1, 0.4, 0.3, -1, -1, 1.0) == [0.5, CLOSE, 0.4, 0.3, -1, -1, 1.0]


def test_without_steps_every_action_passes():
    assert _commands(ClosingLatch(0), 1, -1, 1, -1) == [1, -1, 1, -1]


def test_a_new_episode_starts_with_an_open_hand():
    latch = ClosingLatch(5)
    _commands(latch, 1)
    latch.reset()
    assert _commands(latch, -1) == [-1]


def test_each_of_a_batch_has_its_own_and_arms_are_left_alone():
    latch = ClosingLatch(2)
    latch(_actions(1, -1))
    asked = _actions(-1, 1)
    made = latch(asked)
    np.testing.assert_array_equal(made[:, 7], [CLOSE, 1])
    np.testing.assert_array_equal(made[:, :7], asked[:, :7])
    assert asked[0, 7] == -1  # the caller's array stays as it was
    np.testing.assert_array_equal(latch(_actions(-1, -1))[:, 7], [-1, CLOSE])


def test_the_change_of_the_opening_is_the_last_number_of_each_state():
    told, states = WidthChange(), np.zeros((3, 2, 8), np.float32)
    states[:, :, 7] = [[0.08, 0.08], [0.07, 0.08], [0.07, 0.05]]
    np.testing.assert_allclose(
        [told(state)[:, 8] for state in states], [[0, 0], [-0.01, 0], [0, -0.03]], atol=1e-7
    )
    np.testing.assert_array_equal(told(states[0])[:, :8], states[0])
    told.reset()
    told(states[0])
    np.testing.assert_allclose(told(states[2], periods=3)[:, 8], [-0.01 / 3, -0.01], atol=1e-7)
    told.reset()
    assert told(states[0, 0]).tolist() == [*states[0, 0].tolist(), 0.0]
