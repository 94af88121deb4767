"""Tests hold functions to the shapes and kinds in their annotations (typecheck_support.py)."""

from collections.abc import Iterator

import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError

from ddgrasp import contract
from mjx_envs import grasp_math, kinematics
from ppo.policy import TeacherPolicy
from typecheck_support import checks


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


@checks
def _scaled(count: int, row: Float[np.ndarray, " n"], by: "Float[np.ndarray, ' n']") -> str:
    return f"{count} {row * by}"


@checks
def _padded(row: Float[np.ndarray, " n"], to: int) -> Float[np.ndarray, " {to}"]:
    return np.pad(row, (0, 2))


@checks
def _rows(count: int) -> Iterator[Float[np.ndarray, " n"]]:
    yield from (np.zeros(n) for n in range(count))


@checks
def _named(it: "NobodyKnows") -> int:  # noqa: F821  # pyright: ignore[reportUndefinedVariable]
    return it


def test_lengths_with_one_name_are_one_number_in_each_call():
    for n in (2, 3):
        assert _scaled(2, np.ones(n), np.ones(n)).startswith("2 [1.")
    with pytest.raises(TypeCheckError, match="by"):
        _scaled(2, np.ones(2), np.ones(3))
    with pytest.raises(TypeCheckError, match="count"):
        _scaled("2", np.ones(2), np.ones(2))
    assert _padded(np.ones(3), 5).shape == (5,)
    with pytest.raises(TypeCheckError):
        _padded(np.ones(3), 4)
    assert [len(row) for row in _rows(3)] == [0, 1, 2]


def test_a_result_of_another_kind_is_noticed_and_an_unknown_name_is_not():
    assert _named(1) == 1
    with pytest.raises(TypeCheckError, match="return"):
        _named("1")
