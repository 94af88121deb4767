"""What fitting the generator and drawing from it takes, by shapes alone."""

from ddg_jax import programs
from ddg_jax.data import frames_bytes
from ddgrasp.config import Config, DDGConfig
from learning.memory import Need, traced_bytes


def need(config: Config, frames: int | None = None) -> Need:
    """What stage `ddg` takes on so many frames; without a number those of the rig's recordings."""
    ddg, count = config.ddg, "record.frames" if frames is None else "the number of frames"
    if frames is None:
        frames = config.record.trajectories * config.record.frames
    device = max(training_bytes(ddg), sampling_bytes(ddg))
    remedy = f"ddg.training.batch_size, ddg.sampling.batch_size or {count}"
    return Need("ddg", device, frames_bytes(ddg, frames), remedy=remedy)


def training_bytes(config: DDGConfig) -> int:
    """What an optimiser step takes."""
    return traced_bytes(programs.train_step(config))


def sampling_bytes(config: DDGConfig) -> int:
    """What drawing a batch of maps takes."""
    return traced_bytes(programs.sampler(config))
