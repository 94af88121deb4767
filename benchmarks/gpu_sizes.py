"""How much `benchmarks.gpu_check` runs, on a GPU and, to try the command itself, on a CPU."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ddgrasp.config import Backend


@dataclass(frozen=True)
class Sizes:
    """How much to run."""

    physics: tuple[Backend, ...]
    """The teachers train on the first that can."""
    renderers: tuple[str, ...]
    env_counts: dict[Backend, tuple[int, ...]]
    """Of each of `physics`, the one that matters most first."""
    control_steps: int
    frame_sizes_px: tuple[int, ...]
    frame_pixels: int
    """Of all pictures of a batch together."""
    scenes: int
    """Drawn by every renderer and compared."""
    teacher: dict[str, Any]
    """Fields of TeacherConfig that differ from the presets'."""
    evaluations: int
    """Episodes of each evaluation of a teacher."""
    preset: str
    """Whose generator and student are timed."""
    training_steps: int
    """Timed, of each."""
    slack: float
    """Deadlines are longer by this factor."""
    on_gpu: bool = False
    """Whether a machine without a GPU is refused, and a teacher that does not learn is an error."""


GPU = Sizes(
    physics=("warp", "jax"),
    renderers=("warp", "jax"),
    env_counts={"warp": (8192, 1024, 256, 16384), "jax": (8192, 1024)},
    control_steps=20,
    frame_sizes_px=(64, 128, 256),
    frame_pixels=2**26,
    scenes=48,
    teacher={"total_steps": 20_000_000, "num_envs": 4096, "minibatches": 16, "eval_every": 10},
    evaluations=256,
    preset="paper",
    training_steps=50,
    slack=1.0,
    on_gpu=True,
)
CPU = Sizes(
    physics=("cpu",),
    renderers=("jax",),
    env_counts={"cpu": (4, 16)},
    control_steps=2,
    frame_sizes_px=(16,),
    frame_pixels=2**11,
    scenes=2,
    teacher={
        "total_steps": 64, "num_envs": 8, "unroll_steps": 4, "minibatches": 2, "epochs": 1, "eval_every": 1,
        "critic_warmup": 0, "hidden": (8,), "clone_envs": 4, "clone_steps": 2,
    },
    evaluations=8,
    preset="debug",
    training_steps=3,
    slack=5.0,
)  # fmt: skip
SIZES = {"gpu": GPU, "cpu": CPU}


def only(sizes: Sizes, backends: Sequence[str]) -> Sizes:
    """`sizes` with these of its backends, in this order; none stands for all."""
    if not backends:
        return sizes
    kept = {
        kind: tuple(b for b in backends if b in getattr(sizes, kind)) for kind in ("physics", "renderers")
    }
    return replace(sizes, **kept)
