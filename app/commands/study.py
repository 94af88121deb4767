"""ddgrasp study: Table II with its ablations, and where a policy loses, by cause."""

import sys
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from app.commands.base import FromPreset
from app.commands.checks import (
    check_config_values,
    check_devices,
    check_folder,
    check_start,
    check_tried,
    tell_needs,
)
from ddgrasp import artifacts, attempts, contract
from ddgrasp.config import UNIFORM, Config, DDGConfig
from ddgrasp.config.checks import Count, Range
from ddgrasp.errors import UserError
from ddgrasp.install import check_fr3
from ddgrasp.stages import CHECKPOINTS

if TYPE_CHECKING:
    from app.table2 import Study


@dataclass(frozen=True)
class StudyTable2(FromPreset):
    """Train one student per depth source, all else equal, and try them on the same trials: Table II.

    A row sets by itself student.depth_source, student.picture.fill_holes, student.dextrah_*,
    student.ellipse_dropout and, unless it has ripple, noise by hand: what is given for these does not count.
    """

    rows: tuple[str, ...] | None = None
    """Rows by name instead of the whole tables of --table, made in the order in which they are given: sim_gt,
    rand_noise, inpaint, monocular, ddg_no_graft, ddg, upper_bound, sim_gt_ripple, rand_noise_ripple,
    ddg_ripple, sim_gt_filled, rand_noise_filled, ddg_filled, rand_noise_double, rand_noise_normal,
    sim_gt_ellipses, rand_noise_ellipses, ddg_ellipses, sim_gt_ripple_filled, sim_gt_ellipses_filled,
    rand_noise_ellipses_filled, paper_ddg_no_graft, paper_ddg."""
    table: tuple[str, ...] = ("main",)
    """main (hand-made noise off), ripple (off and on), filled (holes as recorded and filled by the student;
    filled, with ripple made or holes cut by hand), formulas (with pixels of the picture's size, twice as
    large, and along normals), ellipses (holes cut by hand, off and on), grafting (with the paper's own
    generator)."""
    trials: Count = 50
    """How many with every object, the same for every row."""
    objects: tuple[str, ...] = ("all",)
    """Names (`ddgrasp objects list`, on rig fr3 with --meshes), or all: the paper's twelve, on rig fr3 six
    more."""
    paper_generator: str = ""
    """Folder with the paper's own generator, for example `paper` of another study, which rows
    paper_ddg_no_graft and paper_ddg take as it is; without it the study fits one on its recordings."""
    rig: Literal["development", "fr3"] = "development"
    """development (that everything was tuned on) or fr3 (the test rig)."""
    split: Literal["development", "test"] = "development"
    """development seeds, which choose, or test seeds, which are to be looked at once per row."""
    number: Annotated[int, Range(0, 999)] = 0
    """Which seed of the split."""
    workers: Annotated[int, Range(1, 64)] = 2
    """Rigs that run side by side."""

    @classmethod
    def default_preset(cls) -> str:
        """See FromPreset: demo's student starts from the pretrained one, which has seen another depth."""
        return "laptop"

    @classmethod
    def default_out(cls, preset: str) -> Path:
        """See FromPreset."""
        return Path("runs") / f"table2-{preset}"

    def run(self) -> None:
        """Makes what is missing of every row and prints the tables."""
        from app import table2
        from evaluation.table2 import page, results

        table2.check_shared(self.config, self.out, self.resume)
        study = self.planned()
        table2.check_place(study, self.resume)
        if not results.has_students(self.out, study.rows):
            tell_needs(study.config, self.out / results.SHARED)
        made = table2.run(study)
        print(*(self.out / name for name in (table2.STUDY_JSON, table2.STUDY_HTML)), sep="\n")
        print(page.describe(made, results.set_name(study.series)))

    def planned(self) -> "Study":
        """The study. UserError for whatever could not work hours later."""
        from app.table2 import Study
        from evaluation.rig_trials import Series
        from evaluation.table2 import results, rows

        if self.rows == ():
            raise UserError(f"--rows names none: give rows ({', '.join(rows.ROWS)}), or leave it out.")
        names = rows.chosen(self.rows or (), self.table)
        if any(rows.ROWS[name].paper_generator for name in names):
            _check_paper_generator(self.config.ddg, self.paper_generator, self.out / results.PAPER / "ddg")
        elif self.paper_generator:
            raise UserError(
                f"--paper-generator is {self.paper_generator!r}, and no row asked for has the paper's own "
                "generator: leave it out, or ask for --rows paper_ddg."
            )
        series = Series(self.rig, self.objects, self.trials, self.split, self.number).before(self.config)
        check_tried(series)
        series.names()
        if self.rig == "fr3":
            check_fr3("--rig fr3")
        config, shared = self.config, self.out / results.SHARED
        left_out = {} if self.rows else _impossible(config, names, shared)
        names = tuple(name for name in names if name not in left_out)
        for name in names:
            made = results.finished(self.out, rows.ROWS[name])
            _check_row(config, name, shared, made, self.paper_generator)
            if rows.ROWS[name].paper_generator:
                begun_by = rows.row_config(config, rows.ROWS[name], self.paper_generator)
                attempts.check_place(self.out / results.PAPER / "ddg", "ddg", begun_by)
        if not results.has_students(self.out, names):
            rows.check_shared(config)
            check_config_values(config, shared, finished=("student",))  # the paper's rows have another `ddg`
        check_devices(config, shared)
        return Study(config, self.out, names, series, self.workers, left_out, self.paper_generator)


@dataclass(frozen=True)
class StudyCauses:
    """Where a policy loses, by cause: the development rig with one change at a time, the same trials."""

    policy: Path
    """ONNX file that `ddgrasp export` wrote."""
    rows: tuple[str, ...] = ("all",)
    """all, or of: ideal, holes, small_holes, large_holes, values, ripple, mismatches, generator,
    generator_holes, generator_values, full_size, meshes, off_2mm, off_10mm, furniture, dark_table,
    other_tables, spring, fr3, test_rig. What they are compared with is tried too."""
    objects: tuple[str, ...] = ("all",)
    """Names (`ddgrasp objects list`), or all: the paper's twelve."""
    trials: Count = 10
    """How many with every object, the same for every row."""
    number: Annotated[int, Range(0, 999)] = 0
    """Which development seed."""
    seconds: Annotated[float, Range(0.5, 60)] = contract.TRIAL_S
    """A trial ends with success, or after this."""
    preset: str | None = None
    """Configuration of camera and loop; without it that of the run that the policy lies in."""
    config_file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """YAML file to take instead of --preset: a copy of a run's config.yaml, or a preset's name and what
    differs from it. Another camera (record.stereo), many tables (record.other_tables)."""
    generator: Path = Path("pretrained/ddg/generator.onnx")
    """What `ddgrasp ddg export` wrote, for the rows with a generator's errors."""
    workers: Annotated[int, Range(1, 64)] = 2
    """Rigs that run side by side."""
    out: Path = Path("runs/causes")
    """Folder for causes.json, causes.md and a folder for every row; trials that it has are not run again."""

    def run(self) -> None:
        """Runs what is missing and prints the table."""
        from app.commands.student import config_of, unknown_origin
        from evaluation import causes
        from evaluation.rig_trials import Series

        rows = causes.chosen(self.rows)
        series = Series("development", self.objects, self.trials, "development", self.number)
        series = replace(series, seconds=self.seconds)
        series.names()
        if any(causes.ROWS[name].needs for name in rows):
            check_tried(there := replace(series, rig="fr3"))
            there.names()
        check_folder("--out", self.out)
        config = config_of(self.policy, self.preset, self.config_file)
        if note := unknown_origin(self.policy, self.preset, self.config_file):
            print(note, file=sys.stderr)
        causes.run(config, self.policy, rows, series, self.out, self.workers, self.generator)
        print(self.out / causes.JSON_FILE, self.out / causes.TABLE_FILE, sep="\n")
        print((self.out / causes.TABLE_FILE).read_text(encoding="utf-8"))


def _check_paper_generator(config: DDGConfig, given: str, made: Path) -> None:
    """UserError if `given` holds no generator with the paper's loss, or the study's, `made`, is another.

    Whether its network fits is checked with the row.
    """
    from ddg_jax import start

    if artifacts.is_finished(made):
        was = artifacts.read_manifest(made).config["ddg"]["init_from"]
        if was != given:
            how = f"--paper-generator {was}" if was else "fitted here"
            raise UserError(
                f"--paper-generator is {given!r}, and {made} was made otherwise ({how}): give the same "
                "again, or choose another --out."
            )
        return
    check_start("ddg", "--paper-generator", given)
    if given:
        source = start.folder(replace(config, init_from=given))
        artifacts.check_stage("--paper-generator", source, "ddg")
        fitted = artifacts.read_manifest(source).config["ddg"]
        if (weight := fitted["training"]["loss_weight"]) != UNIFORM:
            raise UserError(
                f"--paper-generator is {given!r}, fitted with ddg.training.loss_weight {weight!r}; the "
                f"paper's is {UNIFORM!r}: give another, or leave it out to have one fitted."
            )


def _check_row(
    config: Config, name: str, shared: Path, finished: Collection[str], paper_from: str = ""
) -> None:
    """UserError if the row cannot be made; nothing is asked of the starts of stages that are `finished`."""
    from evaluation.table2.rows import ROWS, row_config
    from evaluation.treatments import make_treatment

    check_config_values(row_config(config, ROWS[name], paper_from), finished=finished)
    make_treatment(ROWS[name].depth, config)
    if ROWS[name].source == "rig" and artifacts.is_finished(shared / "demos"):
        from demos.store import STORE, EpisodeStore
        from student_jax.depth_source import check_views

        check_views(EpisodeStore(shared / "demos" / STORE))


def _impossible(config: Config, names: tuple[str, ...], shared: Path) -> dict[str, str]:
    """Rows whose network has no weights or colour here, or whose camera no scenes, and why: a table is made
    without."""
    from evaluation.table2.rows import ROWS

    why = {}
    for name in names:
        if ROWS[name].source in ("monocular", "rig"):
            try:
                _check_row(config, name, shared, CHECKPOINTS)  # the starts are those of the other rows
            except UserError as error:
                why[name] = str(error)
    return why
