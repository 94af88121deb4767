"""What a generator starts from (`ddg.init_from`): where it is, and whether its network is the one asked for.

Imports no JAX, so that a command can say it before it begins.
"""

from operator import attrgetter
from pathlib import Path

from ddg_jax.network_prior import NETWORKS, weights_folder
from ddgrasp import artifacts
from ddgrasp.config import DDGConfig
from ddgrasp.errors import UserError
from ddgrasp.shipped import holding, shipped
from foundation import store

_THE_SAME = (
    "depth.height_px", "depth.width_px", "depth.representation", "training.hole_loss", "depth.surface",
    "depth.near_m", "depth.far_m", "prior.source", "prior.blur_px", "prior.input_px", "prior.noise",
    "unet.space_to_depth", "unet.widths", "unet.blocks", "unet.attention_heads", "unet.position",
    "diffusion.steps", "diffusion.schedule", "diffusion.log_snr_shift",
)  # fmt: skip
"""Values that a fitted network cannot be used without: its shape, and what its numbers stand for."""


def folder(config: DDGConfig) -> Path:
    """The stage's folder that `config.init_from` names, itself or in a run."""
    return holding(config.init_from, artifacts.MANIFEST, "ddg") or shipped(config.init_from)


def check(config: DDGConfig) -> None:
    """UserError if what `config.init_from` holds is no generator, or has another network or depth space than
    `config`."""
    source = folder(config)
    artifacts.check_stage("ddg.init_from", source, "ddg")
    manifest = artifacts.read_manifest(source)
    fitted = artifacts.config_from_json(manifest.config).ddg
    network = config.prior.source in NETWORKS
    unused = "prior.blur_px" if network else "prior.input_px"
    pairs = {name: tuple(map(attrgetter(name), (fitted, config))) for name in _THE_SAME if name != unused}
    other = {name: (there, here) for name, (there, here) in pairs.items() if there != here}
    if other:
        first, *more = other
        there, here = other[first]
        besides = f" (others: {', '.join(more)})" if more else ""
        raise UserError(
            f"The generator in {source} has ddg.{first} {there!r}, this configuration {here!r}{besides}: "
            f"take the preset that it was fitted with ({manifest.config['preset']}), the same values, or fit "
            "a new one (name none to begin with)."
        )
    if network:
        _check_weights(source, manifest.metrics.get("prior_source"), weights_folder(config))


def drawn_otherwise(config: DDGConfig) -> str:
    """Which values of sampling and grafting are others than those that `config.init_from` was made with, for
    people; "" if none is."""
    there = artifacts.config_from_json(artifacts.read_manifest(folder(config)).config).ddg
    other = [
        f"ddg.{section}.{name} {getattr(getattr(config, section), name)!r} (there {value!r})"
        for section in ("sampling", "graft")
        for name, value in vars(getattr(there, section)).items()
        if name != "batch_size" and value != getattr(getattr(config, section), name)
    ]
    return f"{config.init_from} was made to draw otherwise: {', '.join(other)}" if other else ""


def _check_weights(source: Path, fitted_on: object, weights: Path) -> None:
    """UserError if the prior's `weights` are not of the file that the generator in `source` was fitted on."""
    here = store.read_manifest(weights).source_sha256
    there = fitted_on.get("source_sha256", here) if isinstance(fitted_on, dict) else here
    if there != here:
        raise UserError(
            f"The generator in {source} was fitted on a prior by weights of SHA-256 {there[:8]}, those in "
            f"{weights} are of {here[:8]}: give the same (ddg.prior.weights), or fit a new one."
        )
