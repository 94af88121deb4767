"""What training the student takes: of the device by shapes alone, of host and disk by counting frames."""

from dataclasses import replace

from ddgrasp import contract
from ddgrasp.config import Config
from demos.memory import drawing_bytes
from learning.memory import Need, traced_bytes
from learning.prefetch import AHEAD
from student_jax import programs
from student_jax.data import CACHE, Window, kept_of_a_demo, learns_from_pictures
from student_jax.source_check import needs_rgb

_ROW_BYTES = 4 * (9 + 8 + 40 + 1) + 17
"""A training step beside its picture: state, action, observation, held, episode, step and drawn."""


def need(config: Config) -> Need:
    """What stage `student` takes. Depth of its training frames lies on disk while it works, and a copy on an
    accelerator if it has room for it besides."""
    student, profile = config.student, config.world.profile
    length = config.world.episode_steps
    frames = config.demos.episodes * kept_of_a_demo(student, length) * learns_from_pictures(student)
    frames += student.dagger.rounds * student.dagger.episodes * length
    acting = _acting(
        config, max(student.dagger.episodes * bool(student.dagger.rounds), config.evaluation.student_trials)
    )
    host = (AHEAD + 2) * batch_bytes(config) + frames * _ROW_BYTES + acting.host
    height, width = Window.seen(profile, student.training.crop_shift_px).shape
    disk = frames * 2 * height * width + acting.disk
    device = max(training_bytes(config), acting.device)
    remedy = (
        "student.training.batch_size, student.dagger.episodes, evaluation.student_trials or "
        "world.camera_scale"
    )
    return Need("student", device, host, disk, remedy, CACHE)


def trials_need(config: Config) -> Need:
    """What `evaluation.student_trials` take by themselves (`student_jax.evaluate`). What the student saw lies
    among temporary files."""
    return replace(
        _acting(config, config.evaluation.student_trials),
        remedy="the number of trials (--trials)",
        elsewhere="name another place for temporary files (TMPDIR)",
    )


def _acting(config: Config, count: int) -> Need:
    """What `count` environments take that the student acts in, all at once; on disk what it saw of them."""
    profile = config.world.profile
    picture = 2 * profile.height_px * profile.width_px
    device = max(acting_bytes(config, count), drawing_bytes(config, count, needs_rgb(config)))
    host = count * (contract.DEPTH_FRAMES + 3) * picture
    return Need("student eval", device, host, count * config.world.episode_steps * picture)


def batch_bytes(config: Config) -> int:
    """Depth of the samples of one step, whole pictures."""
    profile, count = config.world.profile, config.student.training.batch_size
    return 2 * count * contract.DEPTH_FRAMES * profile.height_px * profile.width_px


def training_bytes(config: Config) -> int:
    """What an optimiser step on pictures takes."""
    return traced_bytes(programs.train_step(config))


def acting_bytes(config: Config, count: int) -> int:
    """What the actions for `count` environments take."""
    return traced_bytes(programs.acting(config, count))
