"""Shared by all tests: one persistent JAX compilation cache, so that a second run compiles nothing."""

import gc
import os
import signal
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from typecheck_support import install as install_type_checks

# Python's own cache, whatever the shell says: without it every process that a test starts compiles anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

TYPED = (
    "mjx_envs", "learning", "ppo", "demos", "sensors", "rig", "foundation", "ddg_jax", "export", "deploy",
)  # fmt: skip
"""Packages whose annotations, shapes among them, are checked in every call that a test makes."""
install_type_checks(TYPED)

_CACHE = Path(__file__).parents[1] / ".cache" / "jax"

# Through the environment: subprocesses that tests start use the same cache, and JAX is not imported here.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")
os.environ.setdefault("WARP_CACHE_PATH", str(_CACHE.with_name("warp")))
os.environ.setdefault("DDGRASP_CACHE", str(_CACHE.parent))
os.environ.setdefault("MPLBACKEND", "Agg")
# Compiling is most of the suite's time, and half of that goes into making small programs faster.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# The older emitters of XLA compile the same programs in a third of the time (PPO's four: 5.2 s instead of
# 16.2 s of CPU time), and in one piece instead of 32 in a seventh less again. JAX 0.12 has only the new
# emitters, and an unknown flag ends the process.
if tuple(map(int, version("jax").split(".")[:2])) < (0, 12):
    _FAST = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    if _FAST not in (_flags := os.environ.get("XLA_FLAGS", "")):  # a worker has them from who started it, and
        os.environ["XLA_FLAGS"] = f"{_flags} {_FAST}"  # the cache takes the same ones twice for others

SLOW = (
    "test_flow_debug", "test_deploy_fr3", "test_teacher_devices", "test_evaluation_score",
    "test_teacher_improves", "test_deploy_fr3_record", "test_world_physics", "test_programs_lower",
    "test_student_training", "test_ddg_training", "test_gpu_check", "test_teacher_learner",
)  # fmt: skip
"""Files that take longest come first: workers end together if what they share out last is small."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow files first; the order within a file, and of the others, stays."""
    items.sort(key=lambda item: SLOW.index(item.path.stem) if item.path.stem in SLOW else len(SLOW))


def pytest_collection_finish() -> None:
    """What is imported by now stays: Python's collector, a twelfth of the CPU time, need not look at it
    again, nor as often, since JAX has work of its own done at every look."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


@pytest.fixture(scope="session", autouse=True)
def fast_prior():
    """The generator's prior is compiled with all optimisations: its loop takes 50 times as long without."""
    if "jax" not in sys.modules:
        yield
        return
    from ddg_jax import piecewise
    from xla_support import optimizing

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(piecewise, "_minimise", optimizing(piecewise._minimise))
        yield


@pytest.fixture
def ctrl_c():
    """Is KeyboardInterrupt, also where the tests run in the background and a shell has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def open_gl(monkeypatch: pytest.MonkeyPatch):
    """mujoco.Renderer over EGL, whatever MUJOCO_GL was when mujoco was imported; or a skip."""
    import mujoco

    try:
        from mujoco.egl import GLContext
        from mujoco.rendering.classic import gl_context

        monkeypatch.setattr(gl_context, "GLContext", GLContext, raising=False)
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # the back ends raise whatever their loaders do
        pytest.skip(f"no OpenGL context could be made through EGL: {type(error).__name__} {error}")
    return mujoco.Renderer
