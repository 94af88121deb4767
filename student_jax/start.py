"""What a student starts from (`student.init_from`): a run or a folder with its parameters."""

from functools import partial

from ddgrasp.config import Config, StudentConfig
from ddgrasp.shipped import holding, shipped
from learning.params import Params, load_params
from student_jax.policy import PARAMS_FILE, param_shapes, told_the_change


def load(config: StudentConfig, network: Params) -> Params:
    """Parameters that `config.init_from` names, shaped like those of `network` (arrays or their shapes).

    Raises UserError if they do not fit it.
    """
    source = holding(config.init_from, PARAMS_FILE, "student") or shipped(config.init_from)
    return load_params(source / PARAMS_FILE, network, partial(told_the_change, config))


def check(config: Config) -> None:
    """UserError if the student's network is another one than that of its `init_from`; trains nothing."""
    if config.student.init_from:
        load(config.student, param_shapes(config.student, config.world.profile))
