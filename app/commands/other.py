"""ddgrasp weights, objects, report."""

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from app.commands.checks import check_file, check_folder, is_shipped
from ddgrasp import contract, tables
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes
from foundation.store import WEIGHTS_DIR

if TYPE_CHECKING:
    from evaluation.report.trials_page import Trials


@dataclass(frozen=True)
class WeightsConvert:
    """Convert a published checkpoint (.pth, .safetensors) of a depth network, ResNet-18 or FID Inception."""

    file: tyro.conf.Positional[Path]
    """File as `ddgrasp weights list` names it; what is pickled in it is not run."""
    out: Path = WEIGHTS_DIR
    """Folder of converted weights; each network gets a folder in it."""

    def run(self) -> None:
        """Converts one file and prints what it is."""
        check_folder("--out", self.out)
        from foundation import store

        directory = store.convert_file(self.file, self.out)
        manifest = store.read_manifest(directory)
        print(
            f"{directory}: {manifest.network}, {manifest.parameters:,} numbers\nLicence: {manifest.licence}"
        )


@dataclass(frozen=True)
class WeightsList:
    """List networks with published weights: where to get them, their licence, what is installed."""

    out: Path = WEIGHTS_DIR
    """Folder of converted weights to look in."""

    def run(self) -> None:
        """Prints an entry per network."""
        from foundation import catalog, store

        there, damaged = store.installed(self.out), store.unreadable(self.out)
        for name, entry in catalog.ENTRIES.items():
            manifest = there.get(name)
            place = self.out / name
            state = f"installed in {place}, from {manifest.source_file}" if manifest else "not installed"
            state = damaged.get(name, state)
            lines = {"file": entry.file, "published": entry.published, "licence": entry.licence}
            lines |= {"used for": entry.used_for, "here": state}
            print(name, *(f"  {title:<10} {text}" for title, text in lines.items()), "", sep="\n")


@dataclass(frozen=True)
class Report:
    """Write the report of a run, of trials or of deployments; of several runs or trials, what differs."""

    out: tyro.conf.Positional[Path]
    """Directory of a run, or of trials (`deploy trials`); or a deployment's, or that of all deployments."""
    others: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Others of its kind to set beside it."""

    def run(self) -> None:
        """Writes the files and prints their places and the table."""
        if self.others:
            _compare((self.out, *self.others))
            return
        from evaluation.report import deployments, trials_page

        if trials := trials_page.find(self.out):
            print(f"{trials_page.write(trials)}\n\n{trials_page.verdict(trials)}")
            return
        if found := deployments.find(self.out):
            print(f"{deployments.write(self.out, found)}\n\n{deployments.verdict(found)}")
            return
        from evaluation.report.stage import write_report
        from evaluation.report.summary import build_report, print_summary

        if is_shipped(self.out):
            report = build_report(self.out)
            print(_NO_PAGE.format(self.out))
        else:
            report = write_report(self.out)
            print(f"{self.out / 'report.json'}\n{self.out / 'report.html'}\n")
        print_summary(report)


_NO_PAGE = "{} comes with the project: nothing is written there; copy it to have pages.\n"
"""For runs; trials that come with the project may have pages: git ignores them."""


def _compare(runs: Sequence[Path]) -> None:
    from evaluation.report import comparison, trials_page
    from evaluation.report.summary import build_report

    tried = [trials_page.find(run) for run in runs]
    if any(tried):
        _compare_trials(runs, [trials for trials in tried if trials is not None])
        return
    reports = [build_report(run) for run in runs]
    written = _NO_PAGE.format(runs[0]) if is_shipped(runs[0]) else f"{comparison.write(runs, reports)}\n"
    print(written)
    for title, rows in zip(
        ("configured otherwise", "measured"), comparison.differences(reports), strict=True
    ):
        _print_table((title, *told_apart(runs)), rows)


def _compare_trials(runs: Sequence[Path], tried: Sequence["Trials"]) -> None:
    from evaluation.report import trials_page

    if len(tried) < len(runs):
        others = [str(run) for run in runs if trials_page.find(run) is None]
        raise UserError(f"{', '.join(others)}: no finished trials to set beside {tried[0].folder}.")
    print(f"{trials_page.write_comparison(tried)}\n")
    _, rows = trials_page.compare(tried)
    _print_table(("", *told_apart(runs)), rows)


def told_apart(folders: Sequence[Path]) -> list[str]:
    """What of each folder's path the others do not share, for the heading of a narrow column."""
    parts = [folder.parts for folder in folders]
    spare = max(0, min(map(len, parts)) - 1)  # a part is left of each
    before = _shared(parts, spare)
    behind = _shared([path[::-1] for path in parts], spare - before)
    return [str(Path(*path[before : len(path) - behind])) for path in parts]


def _shared(paths: Sequence[tuple[str, ...]], most: int) -> int:
    """How many parts all paths begin with, at most so many."""
    alike = (len(set(column)) == 1 for column in zip(*paths, strict=False))
    return min(most, len(list(itertools.takewhile(bool, alike))))


def _print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.table import Table

    shown = Table(box=None)
    for title in header:
        shown.add_column(title, overflow="fold")
    for row in rows:
        shown.add_row(*row)
    tables.console(width=None if "COLUMNS" in os.environ else 140).print(shown)


@dataclass(frozen=True)
class ObjectsList:
    """Name objects, and plain shapes to train on besides: category, size, mass, friction, sources."""

    meshes: bool = False
    """Those of the test rig, which are meshes, instead of those of training."""

    def run(self) -> None:
        """Prints a line per object."""
        from mjx_envs.objects import OBJECTS, SHAPES

        if self.meshes:
            _list_meshes()
            return
        for spec in (*OBJECTS.values(), *SHAPES.values()):
            size = " x ".join(f"{1000 * extent:.0f}" for extent in spec.extents_m())
            numbers = f"{size:>14} mm {1000 * spec.mass_kg:>4.0f} g  friction {spec.friction}"
            print(f"{spec.category_id:>2} {spec.name:<10} {numbers}  {spec.source}")


@dataclass(frozen=True)
class ObjectsSheet:
    """Draw objects as a camera sees them, colour and depth, as one PNG."""

    objects: tuple[str, ...] = ()
    """Names; none draws all of them, those that the paper trains on first."""
    meshes: bool = False
    """Those of the test rig instead: from two sides, their contact parts, and what training has."""
    out: Path = Path("objects.png")
    """The picture's file."""

    def run(self) -> None:
        """Writes the picture and prints where it is."""
        check_file("--out", self.out)
        atomic_write_bytes(self.out, self._mesh_sheet() if self.meshes else self._sheet())
        print(self.out)

    def _sheet(self) -> bytes:
        from evaluation.object_sheet import draw
        from mjx_envs.objects import OBJECTS

        everything = tuple(dict.fromkeys((*contract.SEEN_OBJECTS, *contract.UNSEEN_OBJECTS, *OBJECTS)))
        return draw(self.objects or everything)

    def _mesh_sheet(self) -> bytes:
        from evaluation.mesh_sheet import draw
        from rig.meshes.objects import MESH_OBJECTS

        return draw(self.objects or tuple(MESH_OBJECTS))


def _list_meshes() -> None:
    """Prints a line per mesh object: size at rest, mass, friction, height of the origin, source."""
    from rig.meshes.bodies import make_body
    from rig.meshes.objects import MESH_OBJECTS

    for name, described in MESH_OBJECTS.items():
        body = make_body(name)
        size = " x ".join(f"{1000 * extent:.0f}" for extent in body.extents_m())
        numbers = f"{size:>14} mm {1000 * body.mass_kg:>4.0f} g  friction {body.friction}"
        rests = f"origin {1000 * body.rest_height_m:.0f} mm up"
        print(f"{name:<11} {numbers}  {rests}  {described.source}")
