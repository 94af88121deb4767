"""Which stages there are, what each is made from, and what of the configuration it depends on.

The one table of the flow: the pipeline runs it, manifests are hashed by it, reports list it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from ddgrasp.config import (
    DDGTrainingConfig,
    DeployConfig,
    ExportConfig,
    FrankaConfig,
    RealSenseConfig,
    TeacherConfig,
)
from ddgrasp.errors import looked_up


@dataclass(frozen=True)
class Stage:
    """One box of the flow picture."""

    name: str
    """Also its directory under the run."""
    module: str
    """Where its `run(job: ddgrasp.job.Job) -> Artifact` is."""
    parents: tuple[str, ...]
    """Stages it is made from."""
    sections: tuple[str, ...]
    """What it reads of `Config` itself, sections or fields in them (`deploy.noise`); its parents' count as
    well (`config_fields`)."""
    makes: str
    """What it leaves behind, for people."""


STAGES = (
    Stage(
        "teacher", "ppo.stage", (), ("seed", "world", "teacher", "evaluation.teacher_trials"),
        "policy on the privileged state",
    ),
    Stage("demos", "demos.stage", ("teacher",), ("demos",), "successful teacher episodes with clean depth"),
    Stage("record", "rig.stage", ("teacher",), ("record",), "RGB-D recordings from the development rig"),
    Stage("ddg", "ddg_jax.stage", ("record",), ("ddg",), "diffusion model of the camera's errors"),
    Stage(
        "student", "student_jax.stage", ("teacher", "demos", "ddg"),
        ("student", "deploy.noise", "evaluation.student_trials"), "depth-only diffusion policy",
    ),
    Stage("export", "export.stage", ("student",), ("export",), "one ONNX file, checked against JAX"),
    Stage(
        "deploy", "deploy.stage", ("export",), ("deploy", "evaluation.rig_trials"),
        "the exported student on the development rig at 10 Hz",
    ),
)  # fmt: skip
"""What `ddgrasp run` makes, in this order."""

ON_REQUEST = (
    Stage("noisy", "ddg_jax.generate", ("demos", "ddg"), (), "depth of the demos with artefacts"),
    Stage(
        "score", "evaluation.depth_score.stage", ("teacher", "ddg"), ("score",),
        "generated depth against the rig's: Table I",
    ),
    Stage(
        "score_real", "evaluation.depth_score.real", (), ("seed", "ddg", "score"),
        "generated depth against a real camera's",
    ),
    Stage(
        "curve", "evaluation.depth_score.curve", ("teacher", "record", "ddg"), ("score",),
        "score against recorded trajectories",
    ),
    Stage(
        "samplers", "evaluation.depth_score.samplers", ("teacher", "ddg"), ("score",),
        "score against network evaluations",
    ),
)  # fmt: skip
"""Stages with a command of their own (`ddgrasp ddg generate`, `score`, `curve`, `samplers`)."""

CHECKPOINTS = {"teacher": "policy.msgpack", "ddg": "params.msgpack", "student": "params.msgpack"}
"""File that a folder a stage starts from must hold, itself or in a folder named after the stage. Named here
too, since the stages' own modules import JAX."""

MADE_BY = {
    "teacher": "teacher train", "demos": "demos collect", "record": "record", "ddg": "ddg fit",
    "student": "student train", "export": "export",
}  # fmt: skip
"""Stage -> the command that makes it alone."""

_BY_NAME = {stage.name: stage for stage in (*STAGES, *ON_REQUEST)}


def get_stage(name: str) -> Stage:
    """The stage of that name; UserError with the nearest right name otherwise."""
    return looked_up("stage", name, _BY_NAME)


INDIFFERENT = {
    "export.max_abs_diff": ExportConfig.max_abs_diff,
    "deploy.workers": DeployConfig.workers,
    "deploy.franka.host": FrankaConfig.host,
    "deploy.realsense.serial": RealSenseConfig.serial,
    "teacher.checkpoint_every": TeacherConfig.checkpoint_every,
    "ddg.training.checkpoint_every": DDGTrainingConfig.checkpoint_every,
}
"""Fields that decide whether or how a result comes about, not what it is. They count as these values when
configurations are compared, so that a stage that missed its bound, or took too much memory, goes on."""


def config_fields(stage: Stage, known: Sequence[Stage] = tuple(_BY_NAME.values())) -> tuple[str, ...]:
    """What of `Config` the stage's result depends on: its parents' and its own `sections`, each once."""
    by_name = {other.name: other for other in known}
    inherited = (field for name in stage.parents for field in config_fields(by_name[name], known))
    return tuple(dict.fromkeys((*inherited, *stage.sections)))
