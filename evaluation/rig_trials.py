"""Trials of one exported policy on a rig, as many of every object: where a student's figure comes from."""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from ddgrasp import contract
from ddgrasp.alone import alone_in
from ddgrasp.config import Config, StereoConfig
from ddgrasp.config_hash import config_hashes
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.files import atomic_write_bytes, atomic_write_text, to_json
from ddgrasp.progress import Progress
from ddgrasp.shipped import shipped
from ddgrasp.trained import policy_objects
from deploy.changes import Change
from deploy.fr3_lab import Shapes, stopping_at
from deploy.fr3_trials import Fr3Bench, Sight
from deploy.policy import OnnxPolicy
from deploy.recorded import RecordedBench, episode_folder
from deploy.stage import STAGE
from deploy.treatment import Replacement, Treatment
from deploy.trial_log import CONFIG_HASH, TrialLog, read_log, read_own
from deploy.trials import RULES, Bench, Rig, Trial, TrialResult, keep_results, lasting, run_trials
from evaluation import failure_modes, wilson
from evaluation.treatments import RECORDED, TreatmentName, make_treatment
from rig import seeds
from rig.film import Film, contact_sheet

RigName = Literal["development", "fr3"]
CameraName = Literal[Sight, "other_tables"]
TRIALS_FILE, TABLE_FILE, EPISODES = "trials.jsonl", "table.json", "episodes"
EVERYTHING, FIRST_TRY = "all", "first_try"
_SAME = ("rig", "shapes", "split", "number", "seconds", "ends", "rules")
"""What the headers of two logs agree on where trial i of an object is the same trial, besides `_DRAWS`."""
_DRAWS = "draws_hash"
_TRAINED = "trained"
STEREO = "stereo"
"""What the rig's own camera is set to otherwise than a configuration that says nothing of it."""
_ADDED = ("seconds", _DRAWS, _TRAINED, STEREO)
"""What older headers do not name, those of `study causes` the seconds, and what `config_hash` covers, tells
of the policy or `_DRAWS` stands for: a log goes on without."""


@dataclass(frozen=True)
class Series:
    """Which trials."""

    rig: RigName = "fr3"
    """fr3 (the test rig: another arm, mesh objects, a D455 as it is run) or development."""
    objects: tuple[str, ...] = (EVERYTHING,)
    """Names, or all: the paper's twelve, and on rig fr3 the six that no list of training has. The development
    rig has every object and shape of `ddgrasp objects list` besides."""
    trials: int = 10
    """How many with every object."""
    split: seeds.Split = "development"
    """Seeds that may be looked at again and again, or test seeds, which are looked at once."""
    number: int = 0
    """Which seed of the split."""
    shapes: Shapes = "mesh"
    """On rig fr3: mesh objects, or the development rig's primitives."""
    camera: CameraName = "stereo"
    """stereo (the rig's own), ideal (no errors), coarse (rig fr3: matched at the policy's size), or
    other_tables (stereo, before a table that is light and dark elsewhere in every trial)."""
    seconds: float = contract.TRIAL_S
    """A trial ends with success, or after this."""
    contact: float | None = None
    """On rig fr3: newtons at the hand at which the arm stops itself; None: the configuration's."""

    depth: TreatmentName = RECORDED
    """What the policy sees: depth as recorded, inpaint (holes filled on line), or monocular (a network on
    colour, made metric by recorded depth)."""
    retry: bool | None = None
    """Whether a hand that stands still, or has closed on nothing, tries again; None: as `deploy.retry`."""

    def names(self) -> tuple[str, ...]:
        """The objects. UserError for none or an unknown one, or a choice that the rig does not have."""
        if self.rig == "development" and (self.camera == "coarse" or self.shapes != "mesh"):
            raise UserError("--camera coarse and --shapes are rig fr3's: drop them, or choose --rig fr3.")
        if self.rig == "development" and self.contact is not None:
            raise UserError("--contact is rig fr3's, whose arm stops itself: drop it, or choose --rig fr3.")
        if self.trials > (most := len(seeds.SEEDS[self.split])):
            raise UserError(f"--trials is {self.trials}: an object has {most} places; choose that or less.")
        if not self.objects:
            raise UserError(f"--objects names none: give names, or {EVERYTHING}.")
        known = self.known()
        if len(self.objects) > 1 and EVERYTHING in self.objects:
            raise UserError(f"--objects {EVERYTHING} names every object: drop the others, or {EVERYTHING}.")
        names = self.at_hand() if self.objects == (EVERYTHING,) else self.objects
        for name in names:
            if name not in known:
                raise unknown_name("object", name, (*known, EVERYTHING))
        return tuple(dict.fromkeys(names))

    def plan(self) -> list[Trial]:
        """Object after object; trial i of an object is the same whichever others are asked for."""
        return [self.trial(name, i) for name in self.names() for i in range(self.trials)]

    def trial(self, name: str, i: int) -> Trial:
        """Trial i of the object of that name, one of `known`."""
        return Trial(self.known().index(name) * len(seeds.SEEDS[self.split]) + i, name)

    def before(self, config: Config) -> "Series":
        """With the tables that `config` has the rig's own camera stand before."""
        if self.camera == "stereo" and config.record.other_tables:
            return replace(self, camera="other_tables")
        return self

    def configured(self, config: Config, policy: Path) -> Config:
        """`config` with the trials' length, seed, objects and the arm's limits. UserError if `policy` is no
        policy that can be run, or a limit not one that an arm has."""
        OnnxPolicy(policy, noise=config.deploy.noise, execute_steps=config.deploy.execute_steps or None)
        world = replace(config.world, objects=self.at_hand() if self.rig == "development" else _listed())
        deploy = config.deploy if self.retry is None else replace(config.deploy, retry=self.retry)
        if self.contact is not None:
            deploy = stopping_at(deploy, self.contact)
        config = replace(config, seed=seeds.seed(self.split, self.number), world=world, deploy=deploy)
        return lasting(config, self.seconds)

    def make(
        self, config: Config, treatment: Treatment | Replacement | None = None
    ) -> Callable[[Config, Path], Bench]:
        """What makes a bench in every worker; `treatment` takes the place of what `depth` names. UserError
        where a network's weights are missing."""
        treatment = treatment or make_treatment(self.depth, config)
        if self.rig == "fr3":
            tables = self.camera == "other_tables"
            sight = "stereo" if self.camera == "other_tables" else self.camera
            return Fr3Bench(self.shapes, sight, treatment, other_tables=tables)
        if self.camera == "other_tables":
            return partial(Rig, change=Change("other tables"), treatment=treatment)
        change = Change(sight="ideal" if self.camera == "ideal" else "stereo")
        return partial(Rig, change=change, treatment=treatment)

    def known(self) -> tuple[str, ...]:
        """Every object that the rig may have, the paper's first; a trial's number counts in this order."""
        if self.rig == "development":
            from mjx_envs.objects import OBJECTS, SHAPES

            return tuple(dict.fromkeys((*_listed(), *SHAPES, *OBJECTS)))
        if self.shapes == "primitive":
            return _listed()
        from rig.meshes.objects import MESH_OBJECTS

        return (*_listed(), *(name for name in MESH_OBJECTS if name not in _listed()))

    def at_hand(self) -> tuple[str, ...]:
        """The objects that the rig has in these trials: on the development rig, whose scene grows with them,
        the paper's and what is asked for besides."""
        if self.rig != "development":
            return self.known()
        asked = [name for name in self.known() if name in self.objects]
        return tuple(dict.fromkeys((*_listed(), *asked)))


def run(
    config: Config, policy: Path, series: Series, out: Path, workers: int, progress: Progress,
    failures: float = math.inf, record: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """The table of `series`; trials that `out` has already are not run again.

    Leaves trials.jsonl, table.json and films in `out`: each object's first success, its first `failures`;
    with `record` a folder in `EPISODES` for every trial, as a deployment leaves it.
    """
    series = series.before(config)
    header = _header(config, policy, series)
    config = series.configured(config, policy)
    if STEREO in header:
        progress.note(f"camera {series.camera}, its {describe_stereo(header[STEREO])}")
    make = series.make(config)
    if record:
        _check_recorded(out)
        about = {"robot": f"rig {series.rig}", "camera": series.camera}
        about |= {"depth": series.depth} if series.depth != RECORDED else {}
        make = RecordedBench(make, out / EPISODES, about)
    asked = run_missing(config, policy, series.plan(), make, header, out, workers, progress, failures)
    as_begun, done = read_log(out / TRIALS_FILE)
    numbers = {result.index for result in asked}
    before = [result for result in done if result.index not in numbers]  # `report` counts them, too
    if before:
        progress.note(f"{len(before)} trials that {out} has besides are counted as well")
    table = tabulate([*asked, *before], trained_on(as_begun))
    atomic_write_text(out / TABLE_FILE, json.dumps({"asked": asdict(series), **table}, indent=1) + "\n")
    return table


def run_missing(
    config: Config, policy: Path, trials: Sequence[Trial], make: Callable[[Config, Path], Bench],
    header: dict[str, Any], out: Path, workers: int, progress: Progress, failures: float = math.inf,
) -> list[TrialResult]:  # fmt: skip
    """Results of `trials` in their order; those that `out` has are not run again. Films as in `run`.

    Args:
      make: what makes a bench in every worker.
      header: what the trials belong to. UserError if `out` has trials of something else, or another process
        is at work there.
    """
    out.mkdir(parents=True, exist_ok=True)
    with alone_in(out):
        log = TrialLog(out / TRIALS_FILE, _as_begun(out, header))
        _check_objects(out, trials, log.results)
        todo = [trial for trial in trials if (trial.index, False) not in log.results]
        with progress.task("trials", len(trials)) as task:
            task.start_at(len(trials) - len(todo))

            def keep(result: TrialResult, film: Film) -> None:
                alike = [(r.object_name, r.success) for r in log.results.values()]
                shown = alike.count((result.object_name, result.success))
                log.append(result)
                if film.steps and shown < (1 if result.success else failures):
                    _keep(out, result, film)
                task.advance(success=sum(r.success for r in log.results.values()) / len(log.results))

            keep_results(run_trials(config, policy, todo, workers, make), keep)
    return [log.results[trial.index, False] for trial in trials]


def _check_objects(out: Path, trials: Sequence[Trial], done: Mapping[tuple[int, bool], TrialResult]) -> None:
    """UserError if one of `trials` has been of another object: the list that numbers them has changed."""
    for trial in trials:
        had = done.get((trial.index, False))
        if had is not None and had.object_name != trial.object_name:
            raise UserError(
                f"{out} has trial {trial.index} of {had.object_name!r}, a number that {trial.object_name!r} "
                "has now: objects were added since; choose another --out."
            )


def check_place(config: Config, policy: Path, series: Series, out: Path) -> None:
    """UserError if `out` has trials of something else than `run` would add to them. Writes nothing."""
    check_log(out, _header(config, policy, series.before(config)))


def check_log(out: Path, header: dict[str, Any]) -> None:
    """UserError if `out` has trials that belong to something else than `header` says. Writes nothing."""
    read_own(out / TRIALS_FILE, _as_begun(out, header))


def _as_begun(out: Path, header: dict[str, Any]) -> dict[str, Any]:
    """`header` without what that of `out`'s log, begun before, does not name yet; what the policy was trained
    on is not told anew."""
    had, results = read_log(out / TRIALS_FILE)
    header = header | {key: had[key] for key in (_TRAINED,) if results and key in had}
    return {key: value for key, value in header.items() if not results or key in had or key not in _ADDED}


def _check_recorded(out: Path) -> None:
    """UserError if `out` has trials that were run without being recorded: they are not run again."""
    for done in read_log(out / TRIALS_FILE)[1]:
        if not episode_folder(out / EPISODES, done.index, done.object_name).is_dir():
            raise UserError(
                f"{out} has trials that were not recorded, and trials that it has are not run again: choose "
                "another --out, or leave out --record."
            )


def _keep(out: Path, result: TrialResult, film: Film) -> None:
    outcome = "success" if result.success else "failure"
    title = f"{result.object_name}, trial {result.index}: {outcome} {' '.join(result.events[-1:])}"
    sheet = contact_sheet(film, title)
    atomic_write_bytes(out / f"{result.object_name}-{result.index}-{outcome}.png", sheet)


def trained_on(header: Mapping[str, Any]) -> tuple[str, ...]:
    """The objects that a log's policy was trained on; headers of before 2026-11-28 do not say, and are taken
    for those of the paper's."""
    return tuple(header.get(_TRAINED, contract.SEEN_OBJECTS))


def tabulate(
    results: Sequence[TrialResult], trained: Sequence[str] = contract.SEEN_OBJECTS
) -> dict[str, Any]:
    """Success with Wilson intervals by object and in total; failures by mode
    (`evaluation.failure_modes.count`).

    Totals are of all objects, of seen ones, which are those `trained` on, of the paper's other ones (unseen)
    and of those that no list has (other); `first_try` is of all, those that succeeded with no rule of the
    loop acting.
    """
    names = tuple(dict.fromkeys(result.object_name for result in results))
    new = [name for name in names if name not in trained]
    groups = {
        "seen": trained,
        "unseen": [name for name in new if name in _listed()],
        "other": [name for name in new if name not in _listed()],
        "all": names,
    }
    rows = {
        group: _success(r for r in results if r.object_name in members) for group, members in groups.items()
    }
    return {
        "objects": {name: _success(r for r in results if r.object_name == name) for name in names},
        **{group: row for group, row in rows.items() if row["n"]},
        FIRST_TRY: _counted(result.at_first_try for result in results),
        "faults": sum(bool(result.fault) for result in results),
        "failures": failure_modes.count(results),
    }


def shown_rows(table: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Name -> success, of every object and total of `tabulate`, as people read them."""
    totals = {name: table[name] for name in ("seen", "unseen", "other", "all") if name in table}
    first = {"first try": table[FIRST_TRY]} if FIRST_TRY in table else {}
    return {**table["objects"], **totals, **first}


def describe(table: dict[str, Any]) -> str:
    """The table as text."""
    lines = [f"{name:<12} {wilson.describe(row)}" for name, row in shown_rows(table).items()]
    return "\n".join([*lines, f"failures: {failure_modes.describe(table['failures'])}"])


def _listed() -> tuple[str, ...]:
    """The paper's twelve objects, seen and unseen."""
    return (*contract.SEEN_OBJECTS, *contract.UNSEEN_OBJECTS)


def _success(results: Iterable[TrialResult]) -> dict[str, Any]:
    return _counted(result.success for result in results)


def _counted(outcomes: Iterable[bool]) -> dict[str, Any]:
    return wilson.success(**contract.counted(list(outcomes)))


def _header(config: Config, policy: Path, series: Series) -> dict[str, Any]:
    """What the trials belong to; how many of which objects may grow.

    Args:
      config: of camera and loop.
    """
    trained, config = policy_objects(policy, config), series.configured(config, policy)
    left_out = {"objects", "trials"} | ({"depth"} if series.depth == RECORDED else set())
    bench = {key: value for key, value in asdict(series).items() if key not in left_out}
    if series.camera != "ideal" and (set_to := stereo_set_to(config)):
        bench[STEREO] = set_to
    deploy = config.deploy
    return made_with(config, policy, trained) | bench | {
        "contact": deploy.franka.contact_force_n, "retry": deploy.retry,
    }  # fmt: skip


def stereo_set_to(config: Config) -> list[str]:
    """Settings of `record.stereo` that are not its defaults, each as "exposure_target 0.7"."""
    given, usual = config.record.stereo, StereoConfig()
    return [f"{k} {v}" for k, v in asdict(given).items() if v != getattr(usual, k)]


def describe_stereo(set_to: Sequence[str]) -> str:
    """`stereo_set_to` as people read it."""
    return f"record.stereo set to {', '.join(set_to)}"


def shown(header: Mapping[str, Any]) -> dict[str, Any]:
    """What a log's header tells people: not of the FR3's meshes and thresholds where the rig has neither."""
    other = ("shapes", "contact") if header.get("rig") == "development" else ()
    return {name: value for name, value in header.items() if name not in other}


def differing(one: Mapping[str, Any], other: Mapping[str, Any], alike: Sequence[str] = ()) -> list[str]:
    """What tells the trials of two logs apart, by their headers: "rules is 1, not 2"; empty where trial i of
    an object is the same trial in both.

    Policy, camera, contact limit, retry and treatment are what logs are compared for, unless `alike` names
    them. A header of before, which does not name what trials are drawn from, may be of any; nor need it name
    the seconds where `alike` names the configuration's hash, which covers them.
    """
    one, other = shown(one), shown(other)
    known = (_DRAWS,) if _DRAWS in one and _DRAWS in other else ()
    if known and one[_DRAWS] != other[_DRAWS]:  # says it in words, where a header does
        known = (*known, STEREO)
    covered = ("seconds",) if CONFIG_HASH in alike else ()
    keys = [key for key in (*_SAME, *known, *alike) if key not in covered]
    pairs = {key: (one.get(key), other.get(key)) for key in keys}
    return [f"{key} is {here}, not {there}" for key, (here, there) in pairs.items() if here != there]


def made_with(config: Config, policy: Path, trained: Sequence[str]) -> dict[str, Any]:
    """Policy, what it was `trained` on, configuration and rule in the header of a log of trials, to which
    other objects may be added: which ones the rig has counts for nothing."""
    config = replace(config, world=replace(config.world, objects=_listed()))
    return {
        "policy_sha256": hashlib.sha256(shipped(policy).read_bytes()).hexdigest(),
        CONFIG_HASH: config_hashes(config, STAGE),
        _DRAWS: _draws_hash(config),
        _TRAINED: list(trained),
    } | RULES


def _draws_hash(config: Config) -> str:
    """Stands for what trials are drawn from: where camera, joints and object are, sizes, camera noise; not
    for the tables, which the camera's name tells."""
    drawn_from = to_json((config.world.random, config.record.stereo))
    return hashlib.sha256(json.dumps(drawn_from, sort_keys=True).encode()).hexdigest()[:8]
