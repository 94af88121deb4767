"""What Table II compares: its rows as differences of one configuration, and which rows make a table.

A row is a training depth, with or without what is done to it by hand, and what is done to recorded depth
before its policy sees it. Rows that train alike share a student.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ddgrasp import artifacts
from ddgrasp.config import DDIM, DEPTH, SQUARED, UNIFORM, Config, DDGConfig
from ddgrasp.config.student import Source
from ddgrasp.errors import UserError, looked_up, unknown_name
from ddgrasp.shipped import holding, shipped
from evaluation.treatments import RECORDED, TreatmentName

PAPER_THRESHOLD = -0.2
"""Below it a pixel of a generated depth map is a hole: surfaces are 0 to 1 there, holes -1."""
PAPER_SAMPLING: dict[str, Any] = {"sampler": DDIM, "spacing": "linspace", "steps": 10, "eta": 0.0}
"""The paper names DDPM and DDIM; docs/table2.md has what others of as many evaluations are off by."""
ELLIPSES = 4.0
"""Holes of 30 pixels and more that the rig's camera, overexposed (`record.stereo.exposure_target` 0.7), has
in a picture of 320x180 before other tables, away from its left and upper edges (mean of 80 recordings' first
pictures, opened by 5x5, 2026-11-29; their areas go from 30 to 1,300 pixels)."""
HAND_MADE = ("disparity_noise_px", "edge_noise_px", "unseen_share")
"""Fields of `student.training` that add noise made by hand; 0 turns each off."""


@dataclass(frozen=True)
class Row:
    """One method."""

    title: str
    source: Source
    """Where training depth comes from (`student.depth_source`)."""
    depth: TreatmentName = RECORDED
    """What its policy sees on the rig."""
    ripple: bool = False
    """Whether training has the noise made by hand: surfaces that ripple (`student.training.
    disparity_noise_px`), edges that do more (`edge_noise_px`), objects that are not seen (`unseen_share`):
    the last two as much as the recipe has."""
    paper_generator: bool = False
    """Whether the generator is the paper's: depth itself, uniform weights."""
    filled: bool = False
    """Whether its student fills holes by itself (`student.picture.fill_holes`), in training as on the rig."""
    dextrah_scale: float = 1.0
    """Size of the formulas' pixel (`student.dextrah_scale`)."""
    dextrah_normal_m: float = 0.0
    """How far the formulas move pixels along normals (`student.dextrah_normal_m`)."""
    ellipses: bool = False
    """Whether training depth has holes cut by hand (`student.ellipse_dropout`): `ELLIPSES` in a picture,
    whatever number the configuration has, of its sizes; other rows have none."""

    @property
    def student(self) -> str:
        """Name of the student that it needs, the same for rows that train alike."""
        parts = (
            self.source,
            "paper" * self.paper_generator,
            "ripple" * self.ripple,
            "filled" * self.filled,
            f"x{self.dextrah_scale:g}" * (self.dextrah_scale != 1),
            _normal(self.dextrah_normal_m),
            "ellipses" * self.ellipses,
        )
        return "_".join(part for part in parts if part)


def _normal(metres: float) -> str:
    """The one of `rand_noise_normal` without its number."""
    return "normal" * (metres != 0) + f"{metres:g}" * (metres not in (0.0, 0.01))


@dataclass(frozen=True)
class Table:
    """Rows side by side."""

    title: str
    reference: str
    """Row that the others are tested against."""
    rows: tuple[str, ...]


ROWS: dict[str, Row] = {
    "sim_gt": Row("Sim GT", "ideal"),
    "rand_noise": Row("Rand Noise", "dextrah"),
    "inpaint": Row("Inpaint", "ideal", depth="inpaint"),
    "monocular": Row("Monocular", "monocular", depth="monocular"),
    "ddg_no_graft": Row("DDG without grafting", "learned_ungrafted"),
    "ddg": Row("DDG", "learned"),
    "upper_bound": Row("Upper bound: development rig's camera", "rig"),
    "sim_gt_ripple": Row("Sim GT, ripple", "ideal", ripple=True),
    "rand_noise_ripple": Row("Rand Noise, ripple", "dextrah", ripple=True),
    "ddg_ripple": Row("DDG, ripple", "learned", ripple=True),
    "sim_gt_filled": Row("Sim GT, holes filled", "ideal", filled=True),
    "rand_noise_filled": Row("Rand Noise, holes filled", "dextrah", filled=True),
    "ddg_filled": Row("DDG, holes filled", "learned", filled=True),
    "rand_noise_double": Row("Rand Noise, twice as strong", "dextrah", dextrah_scale=2.0),
    "rand_noise_normal": Row("Rand Noise, along normals as well", "dextrah", dextrah_normal_m=0.01),
    "sim_gt_ellipses": Row("Sim GT, holes cut by hand", "ideal", ellipses=True),
    "rand_noise_ellipses": Row("Rand Noise, holes cut by hand", "dextrah", ellipses=True),
    "ddg_ellipses": Row("DDG, holes cut by hand", "learned", ellipses=True),
    "sim_gt_ripple_filled": Row("Sim GT, ripple, holes filled", "ideal", ripple=True, filled=True),
    "sim_gt_ellipses_filled": Row(
        "Sim GT, holes cut by hand and filled", "ideal", filled=True, ellipses=True
    ),
    "rand_noise_ellipses_filled": Row(
        "Rand Noise, holes cut by hand and filled", "dextrah", filled=True, ellipses=True
    ),
    "paper_ddg_no_graft": Row(
        "Paper's generator without grafting", "learned_ungrafted", paper_generator=True
    ),
    "paper_ddg": Row("Paper's generator, grafted", "learned", paper_generator=True),
}
TABLES: dict[str, Table] = {
    "main": Table(
        "Table II: hand-made noise off",
        "ddg",
        ("sim_gt", "rand_noise", "inpaint", "monocular", "ddg_no_graft", "ddg", "upper_bound"),
    ),
    "ripple": Table(
        "Hand-made ripple, off and on",
        "ddg",
        ("sim_gt", "sim_gt_ripple", "rand_noise", "rand_noise_ripple", "ddg", "ddg_ripple"),
    ),
    "filled": Table(
        "Holes as recorded and filled by the student; filled, with ripple made or holes cut by hand",
        "ddg_filled",
        (
            "sim_gt",
            "sim_gt_filled",
            "sim_gt_ripple_filled",
            "sim_gt_ellipses_filled",
            "rand_noise",
            "rand_noise_filled",
            "rand_noise_ellipses_filled",
            "ddg",
            "ddg_filled",
        ),
    ),
    "formulas": Table(
        "Formulas in pixels of the picture, of one half as wide, and along normals as well",
        "ddg",
        ("rand_noise", "rand_noise_double", "rand_noise_normal", "ddg"),
    ),
    "ellipses": Table(
        "Holes cut by hand, off and on",
        "ddg",
        ("sim_gt", "sim_gt_ellipses", "rand_noise", "rand_noise_ellipses", "ddg", "ddg_ellipses"),
    ),
    "grafting": Table(
        "Grafting, with the paper's generator", "paper_ddg", ("paper_ddg_no_graft", "paper_ddg")
    ),
}
TRAINING = {
    "ideal": "clean",
    "dextrah": "DextrAH-G's formulas",
    "learned": "generator, grafted",
    "learned_ungrafted": "generator's own map",
    "rig": "the development rig's camera",
    "monocular": "network on simulated colour",
}
DEPLOYED = {"recorded": "as recorded", "inpaint": "inpainted on line", "monocular": "network on colour"}


def chosen(rows: Sequence[str], tables: Sequence[str]) -> tuple[str, ...]:
    """Names of the rows asked for, in the order in which they are to be made: those named, else the tables',
    each once.

    Raises UserError for an unknown row or table, or none at all.
    """
    for name in rows:
        if name not in ROWS:
            raise unknown_name("row", name, ROWS)
    found = [looked_up("table", name, TABLES) for name in tables]
    if not rows and not tables:
        raise UserError(f"--table names none, and --rows neither: give tables ({', '.join(TABLES)}) or rows.")
    return tuple(dict.fromkeys(rows or (row for table in found for row in table.rows)))


def check_shared(config: Config) -> None:
    """UserError if all rows cannot share `config`: their students would start from one that has seen other
    depth than clean depth."""
    if start := config.student.init_from:
        _check_clean(start)


def _check_clean(start: str) -> None:
    """UserError unless the student there was trained on clean depth alone, from nothing."""
    folder = holding(start, artifacts.MANIFEST, "student") or shipped(start)
    student = artifacts.read_manifest(folder).config["student"]
    training = student["training"]
    fields = ("depth_source", "init_from", "ellipse_dropout")
    seen = {f"student.{name}": student[name] for name in fields}
    seen |= {f"student.training.{name}": training[name] for name in HAND_MADE}
    if other := {name: value for name, value in seen.items() if value not in ("ideal", "", 0.0)}:
        how = ", ".join(f"{name} {value!r}" for name, value in other.items())
        raise UserError(
            f"student.init_from is {start!r}, trained with {how}: a student that has seen one row's "
            "depth is no start for the others; give one trained on clean depth alone, "
            '--student.init-from "", or preset laptop.'
        )


def row_config(shared: Config, row: Row, paper_from: str = "") -> Config:
    """What the rows have in common, with the row's differences; `paper_from`: see `paper_generator`.

    Raises UserError if the row wants a ripple and the configuration has none.
    """
    ripple_px = shared.student.training.disparity_noise_px
    if row.ripple and not ripple_px:
        raise UserError(
            f"student.training.disparity_noise_px is 0: row {row.title!r} needs its strength, for example "
            "0.25."
        )
    training = shared.student.training
    if not row.ripple:
        training = replace(training, **dict.fromkeys(HAND_MADE, 0.0))
    picture = replace(shared.student.picture, fill_holes=row.filled)
    student = replace(
        shared.student,
        depth_source=row.source,
        dextrah_scale=row.dextrah_scale,
        dextrah_normal_m=row.dextrah_normal_m,
        ellipse_dropout=ELLIPSES if row.ellipses else 0.0,
        training=training,
        picture=picture,
    )
    ddg = paper_generator(shared.ddg, paper_from) if row.paper_generator else shared.ddg
    return replace(shared, student=student, ddg=ddg)


def paper_generator(config: DDGConfig, start: str = "") -> DDGConfig:
    """The generator that draws the depth map itself by squared errors of equal weight, sampled undistilled.

    Network, prior and number of training steps stay. `start`: run or folder with one that is fitted already.
    """
    return replace(
        config,
        depth=replace(config.depth, representation=DEPTH),
        graft=replace(config.graft, noise_threshold=PAPER_THRESHOLD),
        training=replace(config.training, loss_weight=UNIFORM, hole_loss=SQUARED),
        sampling=replace(config.sampling, **PAPER_SAMPLING),
        init_from=start,
    )
