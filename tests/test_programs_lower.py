"""Every jitted step lowers for GPUs and TPUs without either, at the shapes of preset `paper`."""

import re
from dataclasses import replace
from functools import cache

import jax
import pytest

from benchmarks.programs import PROGRAMS, Program, lower
from ddgrasp.config import Config
from ddgrasp.presets import PRESETS

PLATFORMS = ("cuda", "tpu")
PLACES = (
    "PPO: new episodes", "control step", "demo rollout: begin", "demo rollout: advance",
    "rendering: geometry", "rendering: depth", "rendering: colour", "rendering: object pixels",
)  # fmt: skip
"""Programs of physics and geometry alone."""
ROUNDED = re.compile(r"dot_general.*DEFAULT")
"""A product in TF32 or bfloat16."""
HOST_CALL = re.compile(r"custom_call.*(callback|xla_python|xla_ffi_python)")


@cache
def config() -> Config:
    """`paper` itself: nothing is computed, so its sizes cost nothing."""
    return PRESETS["paper"]


@cache
def program(name: str) -> Program:
    return PROGRAMS[name](config())


@pytest.mark.parametrize("name", PROGRAMS)
def test_it_lowers_for_every_accelerator_without_calling_the_host(name):
    text = {platform: lower(program(name), platform).as_text() for platform in PLATFORMS}
    for module in text.values():
        assert "func.func public @main" in module
        assert not HOST_CALL.search(module)
        assert name not in PLACES or not ROUNDED.search(module)


@pytest.mark.parametrize(
    ("preset", "name"),
    [("camera", "generator: train step"), ("student_paper", "student: train step")],
)
def test_what_paper_does_not_have_lowers_too(preset, name):
    """Holes as log odds; the mean of features, and actions' loss alone."""
    for platform in PLATFORMS:
        module = lower(PROGRAMS[name](PRESETS[preset]), platform).as_text()
        assert "func.func public @main" in module and not HOST_CALL.search(module)


def test_a_network_s_products_are_rounded():
    """What the test above looks for can be found, and is looked for."""
    assert set(PLACES) <= set(PROGRAMS)
    assert ROUNDED.search(lower(program("demo rollout: look"), "cuda").as_text())


def test_the_c_engine_is_a_call_of_the_host():
    """What the test above looks for can be found."""
    from mjx_envs.grasp_env import GraspEnv

    env = GraspEnv(replace(config().world, backend="cpu"))
    state = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), "uint32"))
    traced = jax.jit(env.step).trace(state, jax.ShapeDtypeStruct((8,), "float32"))
    assert HOST_CALL.search(traced.lower().as_text())
