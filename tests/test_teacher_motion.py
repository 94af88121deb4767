"""Motion metrics by hand, and in an evaluation."""

from pathlib import Path

import numpy as np
import pytest

from ddgrasp.config import WorldConfig
from mjx_envs.grasp_env import GraspEnv
from ppo import policy as teacher_policy
from ppo.evaluate import evaluate
from ppo.motion import motion_metrics

ROOT = Path(__file__).parents[1]


def still(steps: int = 4, episodes: int = 2):
    """Arguments of `motion_metrics`: nothing moves, the gripper stays open, all episodes run."""
    action = np.zeros((steps, episodes, 8))
    action[..., 7] = -1.0
    return np.zeros((steps, episodes, 7)), action, np.ones((steps, episodes), bool)


def test_standing_still_is_zero_everywhere():
    assert set(motion_metrics(*still()).values()) == {0.0}


def test_one_jolt_by_hand():
    velocity, action, running = still()
    velocity[1, 0, 1] = 0.3  # joint 2: 3 rad/s^2 up, then down, of 7.5; jerk 30, -60, 30 rad/s^3, of 3750
    metrics = motion_metrics(velocity, action, running)
    assert metrics["acceleration_max"] == pytest.approx(3.0 / 7.5)
    assert metrics["jerk_max"] == pytest.approx(60.0 / 3750)
    # Eight steps: (0, .4, .4, 0) and four zeros; 99th percentile between the two largest, which are equal.
    assert metrics["acceleration_p99"] == pytest.approx(0.4)


def test_the_joint_nearest_its_own_limit_counts():
    velocity, action, running = still()
    velocity[3, 0, 0], velocity[3, 0, 6] = 0.9, 1.0  # 9 of 15 beats 10 of 20
    assert motion_metrics(velocity, action, running)["acceleration_max"] == pytest.approx(9.0 / 15.0)


def test_toggles_count_per_episode_from_an_open_gripper():
    velocity, action, running = still()
    action[:, 0, 7] = [-1, 1, -1, 1]  # three changes
    action[:, 1, 7] = [1, 1, 1, 1]  # one: it began open
    assert motion_metrics(velocity, action, running)["gripper_toggles"] == 2.0


def test_saturation_counts_joints_not_the_gripper_and_ended_episodes_do_not_count():
    velocity, action, running = still()
    action[:, 0, 0], action[:, 0, 1] = 0.96, 0.94
    assert motion_metrics(velocity, action, running)["saturated_actions"] == pytest.approx(4 / 56)
    running[2:, 0] = False
    velocity[3, 0, 0] = 99.0
    metrics = motion_metrics(velocity, action, running)
    assert metrics["saturated_actions"] == pytest.approx(2 / 42)
    assert metrics["acceleration_max"] == 0.0


def test_an_evaluation_reports_motion_per_object():
    env = GraspEnv(WorldConfig(objects=("cube", "apple"), episode_steps=12))
    result = evaluate(env, teacher_policy.load(ROOT / "pretrained" / "teacher"), trials=8, seed=0)
    assert [row["object"] for row in result["motion"]] == ["cube", "apple", "all"]
    by_object = {row["object"]: row for row in result["motion"]}
    share = result["objects"]["cube"]["n"] / 8
    for name in ("saturated_actions", "gripper_toggles"):
        mean = share * by_object["cube"][name] + (1 - share) * by_object["apple"][name]
        assert by_object["all"][name] == pytest.approx(mean, rel=1e-5)
    assert 0 < by_object["all"]["acceleration_p99"] <= by_object["all"]["acceleration_max"] < 3
    assert result["saturated_actions"] == by_object["all"]["saturated_actions"]
