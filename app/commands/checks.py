"""What commands check before they start: names, files, counts, devices."""

from pathlib import Path

from ddgrasp import artifacts
from ddgrasp.config import Config, WorldConfig
from ddgrasp.errors import UserError, unknown_name

CHECKPOINTS = {"teacher": "policy.msgpack", "ddg": "params.msgpack", "student": "params.msgpack"}
"""File that `<stage>.init_from` must hold, itself or in a folder named after the stage. Named here too, since
the stages' own modules import JAX."""


def check_config_values(config: Config) -> Config:
    """`config` if the names and files in it exist; UserError with the remedy otherwise."""
    from ddg_jax.network_prior import IN_SIMULATION
    from ddg_jax.prior import make_prior
    from ddgrasp.policy_metadata import check_depth_dtype
    from student_jax.depth_source import check_source

    check_objects(config.world)
    for stage, file in CHECKPOINTS.items():
        _check_start(stage, getattr(config, stage).init_from, file)
    if config.ddg.prior.in_sim not in IN_SIMULATION:
        raise unknown_name("ddg.prior.in_sim", config.ddg.prior.in_sim, IN_SIMULATION)
    check_source(config, make_prior(config.ddg))
    check_depth_dtype(config.export.depth_dtype)
    if config.student.encoder.weights:
        from student_jax import pretrained_encoder

        pretrained_encoder.source(config.student)
    return config


def check_objects(world: WorldConfig) -> None:
    """UserError unless `world` has objects, all of them known."""
    from mjx_envs.objects import OBJECTS, get_object

    if not world.objects:
        raise UserError(f"world.objects is empty; expected at least one of {', '.join(OBJECTS)}.")
    for name in world.objects:
        get_object(name)


def check_devices(config: Config, run_dir: Path) -> None:
    """UserError if the teacher, unless it is finished, cannot be trained on the devices present."""
    if not artifacts.is_finished(run_dir / "teacher"):
        from ppo.stage import check

        check(config)


def _check_start(stage: str, init_from: str, file: str) -> None:
    """UserError unless `init_from` is empty or holds the checkpoint `file`."""
    source = Path(init_from)
    if not init_from or any(path.is_file() for path in (source / file, source / stage / file)):
        return
    pretrained = source.parts[:1] == ("pretrained",)
    remedy = (
        "run it from the repository root" if pretrained else "give a run or pretrained folder, or nothing"
    )
    trouble = f"holds no {file}" if source.exists() else "does not exist"
    raise UserError(f"{stage}.init_from is {init_from!r}, which {trouble}: {remedy}.")


def check_count(option: str, value: int) -> None:
    """UserError unless `value` is at least 1."""
    if value < 1:
        raise UserError(f"{option} is {value}; expected at least 1.")
