"""What a student starts from (`student.init_from`): a run or a folder with its parameters."""

from operator import attrgetter
from pathlib import Path

from ddgrasp import artifacts
from ddgrasp.config import Config, StudentConfig
from ddgrasp.errors import UserError
from ddgrasp.shipped import holding, shipped
from learning.params import Params, load_params
from student_jax.policy import PARAMS_FILE, param_shapes

_THE_SAME = (
    "picture.channels", "picture.height_px", "picture.width_px", "picture.min_depth_m", "picture.max_depth_m",
    "encoder.output_stride", "hand_view.pitch_m", "head.diffusion_steps",
)  # fmt: skip
"""Values whose change leaves arrays of the same shape that mean something else."""


def _folder(config: StudentConfig) -> Path:
    return holding(config.init_from, PARAMS_FILE, "student") or shipped(config.init_from)


def load(config: StudentConfig, network: Params) -> Params:
    """Parameters that `config.init_from` names, shaped like those of `network` (arrays or their shapes).

    Raises UserError if they do not fit it.
    """
    return load_params(_folder(config) / PARAMS_FILE, network)


def check(config: Config) -> None:
    """UserError if the student's network is another one than that of its `init_from`, or what its numbers
    stand for is; trains nothing."""
    if config.student.init_from:
        load(config.student, param_shapes(config.student, config.world.profile))
        _check_meaning(config.student)


def change_of_pictures(config: StudentConfig) -> str:
    """A line where holes are filled now and were not in the start's training, or the other way round; empty
    if neither."""
    trained = _trained(config)
    if trained is None or trained.picture.fill_holes == config.picture.fill_holes:
        return ""
    there, here = trained.picture.fill_holes, config.picture.fill_holes
    return (
        f"the student in {_folder(config)} was trained with student.picture.fill_holes {there}, here it is "
        f"{here}: it sees other pictures from now on"
    )


def _check_meaning(config: StudentConfig) -> None:
    trained = _trained(config)
    if trained is None:
        return
    for name in _THE_SAME:
        there, here = map(attrgetter(name), (trained, config))
        unused = name == "hand_view.pitch_m" and not config.hand_view.size_px
        if there != here and not unused:
            raise UserError(
                f"The student in {_folder(config)} has student.{name} {there!r}, this configuration "
                f"{here!r}: use the same value, or start from nothing (--student.init-from=)."
            )


def _trained(config: StudentConfig) -> StudentConfig | None:
    """How the start was trained; None of bare parameters."""
    source = _folder(config)
    if not artifacts.is_finished(source):
        return None
    return artifacts.config_from_json(artifacts.read_manifest(source).config).student
