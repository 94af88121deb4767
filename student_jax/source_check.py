"""Whether `student.depth_source` can be had with this configuration, said before anything begins.

Imports no JAX, so that a command can say it at once.
"""

from ddg_jax.monocular import MonocularDepth
from ddg_jax.network_prior import NETWORKS, DepthNetworkPrior
from ddgrasp.config import BY_COLOUR, Config
from ddgrasp.errors import UserError

LEARNED = ("learned", "learned_ungrafted")
"""Sources that are the run's generator."""


def check_source(config: Config) -> None:
    """UserError if the weights of the source, or of the generator's prior, are missing, or the demos will
    lack the colour that the source needs."""
    name = config.student.depth_source
    if config.ddg.prior.source in NETWORKS:
        DepthNetworkPrior(config.ddg)
    if name == "monocular":
        MonocularDepth(config.ddg)
    if needs_rgb(config) and not config.demos.rgb:
        raise UserError(
            f"student.depth_source {name!r} needs colour in the demos, and demos.rgb is false: give "
            "--demos.rgb, or take another source."
        )


def needs_rgb(config: Config) -> bool:
    """Whether the source sees colour, so that all of its pictures are drawn in it."""
    name, prior = config.student.depth_source, config.ddg.prior
    if name in LEARNED:
        return prior.source in NETWORKS and prior.in_sim == "rgb"
    return name in (*BY_COLOUR, "monocular")
