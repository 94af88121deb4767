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
    name, network = config.student.depth_source, config.ddg.prior.source in NETWORKS
    by_network = network and DepthNetworkPrior(config.ddg).needs_sim_rgb
    if name == "monocular":
        MonocularDepth(config.ddg)
    needs_rgb = by_network if name in LEARNED else name in (*BY_COLOUR, "monocular")
    if needs_rgb and not config.demos.rgb:
        raise UserError(
            f"student.depth_source {name!r} needs colour in the demos, and demos.rgb is false: give "
            "--demos.rgb, or take another source."
        )
