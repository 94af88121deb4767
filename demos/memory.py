"""What collecting demonstrations takes: of the device by shapes alone, of host and disk by counting."""

from dataclasses import replace

import numpy as np

from ddgrasp import contract
from ddgrasp.config import Config
from demos.rollout import Roller
from learning.memory import Need, traced_bytes
from ppo.policy import TeacherPolicy

_STEP_BYTES = 4 * (contract.STATE_SIZE + contract.ACTION_SIZE + contract.OBSERVATION_SIZE) + 1
"""A step beside its pictures: state, action, observation, held."""


def need(config: Config) -> Need:
    """What stage `demos` takes. Pictures of a batch of episodes lie on disk until it is known which failed;
    the demonstrations that are kept are not in it."""
    demos, profile = config.demos, config.world.profile
    pixels = profile.height_px * profile.width_px * (2 + 3 * demos.rgb)
    steps = demos.parallel * config.world.episode_steps
    host = demos.parallel * pixels + steps * _STEP_BYTES
    remedy = "demos.parallel or world.camera_scale"
    return Need("demos", drawing_bytes(config, demos.parallel, demos.rgb), host, steps * pixels, remedy)


def drawing_bytes(config: Config, count: int, rgb: bool) -> int:
    """What a picture of each of `count` environments takes: the JAX ray caster, all at once, as on
    accelerators."""
    world = replace(config.world, backend="cpu", renderer="jax")
    nobody = TeacherPolicy(np.zeros(0), np.zeros(0), [])
    roller = Roller(replace(config, world=world), nobody, count, with_rgb=rgb)
    programs = roller.programs()
    return max(traced_bytes(programs[name]) for name in ("depth", *["rgb"] * rgb))
