"""Public functions say what they take, and tests check that they are told the truth."""

import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from mjx_envs import grasp_math, kinematics, scene
from ppo.policy import TeacherPolicy

ROOT = Path(__file__).parents[1]
COMPLETE = ("mjx_envs", "ppo", "demos", "foundation", "evaluation", "ddgrasp", "app")
"""Packages whose public functions are all documented and annotated."""


def public(tree: ast.Module | ast.ClassDef, inside: str = "") -> Iterator[tuple[str, ast.FunctionDef]]:
    """(dotted name, node) of the public functions and methods, `__init__` and `__call__` among them."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            yield from public(node, f"{inside}{node.name}.")
        elif isinstance(node, ast.FunctionDef):
            if not node.name.startswith("_") or node.name in ("__init__", "__call__"):
                yield inside + node.name, node


def lacks(name: str, node: ast.FunctionDef) -> list[str]:
    """What is not said of a function."""
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    missing = [a.arg for a in arguments if a.annotation is None and a.arg not in ("self", "cls")]
    if node.name != "__init__":
        missing += ["its result"] * (node.returns is None)
        missing += ["a docstring"] * (ast.get_docstring(node) is None)
    return [f"{name}: {what}" for what in missing]


@pytest.mark.parametrize("package", COMPLETE)
def test_every_public_function_is_documented_and_annotated(package):
    wrong = [
        f"{file.relative_to(ROOT)} {gap}"
        for file in sorted((ROOT / package).rglob("*.py"))
        for name, node in public(ast.parse(file.read_text()))
        for gap in lacks(name, node)
    ]
    assert wrong == []


def test_gaps_are_found():
    text = 'class A:\n    def f(self, x, y: int): pass\ndef g() -> int: "doc"\ndef _h(x): pass\n'
    found = [gap for name, node in public(ast.parse(text)) for gap in lacks(name, node)]
    assert found == ["A.f: x", "A.f: its result", "A.f: a docstring"]


def test_a_wrong_shape_or_kind_is_noticed():
    qpos = np.concatenate([scene.HOME_RAD, np.zeros(2)])
    assert kinematics.grip_pose(qpos[:7])[0].shape == (3,)
    with pytest.raises(TypeCheckError, match="grip_pose"):
        kinematics.grip_pose(qpos)
    with pytest.raises(TypeCheckError, match="controls"):
        grasp_math.controls(np.zeros((2, 7)), np.zeros((3, 8)))
    with pytest.raises(TypeCheckError, match="yaw_of"):
        kinematics.yaw_of(np.array([1, 0, 0, 0]))
    layer = np.zeros((40, 16)), np.zeros(16)
    assert TeacherPolicy(np.zeros(40), np.ones(40), [layer])(np.zeros((5, 40))).shape == (5, 8)
