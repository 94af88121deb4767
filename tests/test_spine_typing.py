"""Tests hold functions to the shapes and kinds in their annotations (typecheck_support.py)."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from ddgrasp import contract
from mjx_envs import grasp_math, kinematics
from ppo.policy import TeacherPolicy


def test_a_wrong_shape_or_kind_is_noticed():
    qpos = np.concatenate([contract.HOME_RAD, np.zeros(2)])
    assert kinematics.grip_pose(qpos[:7])[0].shape == (3,)
    with pytest.raises(TypeCheckError, match="grip_pose"):
        kinematics.grip_pose(qpos)
    with pytest.raises(TypeCheckError, match="controls"):
        grasp_math.controls(np.zeros((2, 7)), np.zeros((3, 8)))
    with pytest.raises(TypeCheckError, match="yaw_of"):
        kinematics.yaw_of(np.array([1, 0, 0, 0]))
    layer = np.zeros((40, 16)), np.zeros(16)
    assert TeacherPolicy(np.zeros(40), np.ones(40), [layer])(np.zeros((5, 40))).shape == (5, 8)
