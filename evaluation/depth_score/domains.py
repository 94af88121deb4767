"""The sets of depth maps that Table I compares, each a function of one episode; and the table's columns.

A column compares two of them, as the paper does: most compare simulation with raw recorded depth, inpainting
and the monocular network with recorded depth treated alike.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt16

from ddgrasp import contract
from ddgrasp.config import DDGConfig, DextrahConfig, ScoreConfig
from ddgrasp.depth import to_metres, to_millimetres
from evaluation.depth_score.data import REAL, SIM, Episode
from sensors.inpainting import inpainted

if TYPE_CHECKING:
    import ddg_jax.network_prior
    import ddg_jax.sample

Maps = dict[str, UInt16[np.ndarray, "_ _ _"]]
"""Domain -> (T, H, W) millimetres."""

RAW = "real_raw"
FLOOR = "sim_sensed"
"""What the camera recorded of the episodes whose geometry the methods get: the real-vs-real floor."""
LIMIT = "sim_graft_limit"
"""Exact simulated depth under the holes that the camera itself had there: what grafting of holes alone can
reach at best, whatever the generator."""
_REPEATS = 100_000
"""Added to an episode's number where its world stands still: other noise than the moving episode's."""
_PHOTOS = 1000
"""Times an episode's number: what its frames count from where each is an episode of its own."""


def monocular_network(score: ScoreConfig, ddg: DDGConfig) -> "ddg_jax.network_prior.DepthNetworkPrior | None":
    """The network of column monocular; None without that column, or if no folder was named and the usual one
    is not there. Raises UserError for weights of another network."""
    from ddg_jax.network_prior import DepthNetworkPrior, weights_folder

    prior = replace(ddg.prior, source=score.monocular, weights=score.monocular_weights, in_sim="rgb")
    settings = replace(ddg, prior=prior)
    absent = not score.monocular_weights and not weights_folder(settings).exists()
    return None if absent or "monocular" not in score.columns else DepthNetworkPrior(settings)


@dataclass(frozen=True)
class Methods:
    """What makes depth from an episode."""

    config: ScoreConfig
    seed: int
    generator: "ddg_jax.sample.Generator"

    @cached_property
    def monocular(self) -> "ddg_jax.network_prior.DepthNetworkPrior | None":
        """See `monocular_network`."""
        return monocular_network(self.config, self.generator.config)

    @property
    def needs_rgb(self) -> bool:
        """Whether episodes must bring colour."""
        return self.monocular is not None or self.generator.prior.needs_sim_rgb


def sense(methods: Methods, episode: Episode, names: Sequence[str]) -> Maps:
    """Domain -> (T, H, W) uint16 millimetres, of those `names` that belong to the episode's side."""
    made: dict[str, np.ndarray] = {}
    for name in names:
        domain = DOMAINS[name]
        if domain.side == episode.side and name not in made:
            made.update(domain.make(methods, episode))
    return {name: made[name] for name in names if name in made}


def sense_repeats(methods: Methods, episode: Episode, names: Sequence[str]) -> Maps:
    """The same for the episode's first scene, sensed again and again; {} if it was not."""
    if not len(episode.repeats_mm):
        return {}
    still = episode.repeated()
    return sense(methods, replace(still, number=still.number + _REPEATS), names)


# --- domains -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Domain:
    """title: for people; side: whose episodes; make: its maps, perhaps another domain's along with them."""

    title: str
    side: str
    make: Callable[[Methods, Episode], Maps]


def _graft_limit(methods: Methods, episode: Episode) -> Maps:
    del methods
    return {LIMIT: np.where(episode.sensed_mm > 0, episode.clean_mm, 0)}


def _rand_noise(methods: Methods, episode: Episode) -> Maps:
    """DextrAH-G's published noise."""
    import jax

    base = contract.D455.scaled(episode.clean_mm.shape[2] / contract.D455.width_px)
    profile = replace(base, fx_px=episode.focal_px, fy_px=episode.focal_px, baseline_m=episode.baseline_m)
    key = jax.random.fold_in(jax.random.key(methods.seed), episode.number)
    noisy = _dextrah(profile)(key, to_metres(episode.clean_mm), None)
    return {"sim_rand_noise": to_millimetres(np.asarray(noisy))}


@cache
def _dextrah(profile: contract.CameraProfile) -> Callable[..., Any]:
    import jax

    from sensors.models.procedural import dextrah

    return jax.jit(dextrah(DextrahConfig(), profile))


def _real_inpaint(methods: Methods, episode: Episode) -> Maps:
    radius_px = methods.config.inpaint_radius_px
    return {"real_inpaint": inpainted(episode.sensed_mm, radius_px)}


def _monocular(name: str) -> Callable[[Methods, Episode], Maps]:
    def make(methods: Methods, episode: Episode) -> Maps:
        """Relative depth from colour, made metric by the depth of its own side."""
        from ddg_jax.network_prior import metric_depth

        assert methods.monocular is not None and episode.rgb is not None
        reference = to_metres(episode.sensed_mm if episode.side == REAL else episode.clean_mm)
        pictures = [episode.rgb] if episode.consecutive else [picture[None] for picture in episode.rgb]
        relative = np.concatenate([methods.monocular.relative(p, reference.shape[1:]) for p in pictures])
        far_m = methods.generator.config.depth.far_m
        fitted = [metric_depth(r, d, far_m) for r, d in zip(relative, reference, strict=True)]
        return {name: to_millimetres(np.stack(fitted))}

    return make


def _generated(methods: Methods, episode: Episode) -> Maps:
    import jax

    from ddg_jax.sample import generate

    count, number, frame = len(episode.clean_mm), episode.number, None
    if not episode.consecutive:
        number, frame = number * _PHOTOS + np.arange(count), np.zeros(count, int)
    made = generate(
        jax.random.key(methods.seed), methods.generator, to_metres(episode.clean_mm), episode.rgb,
        episode=number, frame=frame,
    )  # fmt: skip
    return {"sim_ddg": to_millimetres(made.depth_m), "sim_ddg_no_graft": to_millimetres(made.predicted_m)}


DOMAINS: dict[str, Domain] = {
    RAW: Domain("Real Raw", REAL, lambda m, e: {RAW: e.sensed_mm}),
    FLOOR: Domain("Real Raw, other episodes", SIM, lambda m, e: {FLOOR: e.sensed_mm}),
    "sim_gt": Domain("Sim GT", SIM, lambda m, e: {"sim_gt": e.clean_mm}),
    LIMIT: Domain("Camera's holes, exact depth", SIM, _graft_limit),
    "sim_rand_noise": Domain("Sim Rand Noise", SIM, _rand_noise),
    "real_inpaint": Domain("Real Inpaint", REAL, _real_inpaint),
    "real_monocular": Domain("Real monocular", REAL, _monocular("real_monocular")),
    "sim_monocular": Domain("Sim monocular", SIM, _monocular("sim_monocular")),
    "sim_ddg_no_graft": Domain("Sim DDG w/o graft", SIM, _generated),
    "sim_ddg": Domain("Sim DDG", SIM, _generated),
}


@dataclass(frozen=True)
class Column:
    """real, sim: names of the two domains compared."""

    title: str
    real: str
    sim: str


COLUMNS: dict[str, Column] = {
    "sim_gt": Column("Sim GT", RAW, "sim_gt"),
    "rand_noise": Column("Rand Noise", RAW, "sim_rand_noise"),
    "inpaint": Column("Inpaint", "real_inpaint", "sim_gt"),
    "monocular": Column("Monocular", "real_monocular", "sim_monocular"),
    "ddg_no_graft": Column("DDG w/o graft", RAW, "sim_ddg_no_graft"),
    "ddg": Column("DDG", RAW, "sim_ddg"),
}
"""The paper's Table I and its t-SNE's six pairings, by the names of `ddgrasp.config.SCORE_COLUMNS`."""
REFERENCES: dict[str, Column] = {
    "graft_limit": Column("Graft limit", RAW, LIMIT),
    "floor": Column("Real vs real", RAW, FLOOR),
}
"""What figures are to be read against; no methods, and no column can be expected to pass the floor."""


def wanted_domains(columns: Sequence[str]) -> list[str]:
    """Domains that the columns and the references need, in the order of DOMAINS."""
    pairs = [*(COLUMNS[name] for name in columns), *REFERENCES.values()]
    needed = {name for pair in pairs for name in (pair.real, pair.sim)}
    return [name for name in DOMAINS if name in needed]
