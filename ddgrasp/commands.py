"""The commands of `ddgrasp`, one dataclass each: its fields are the options, `run` does the work.

Stages are imported inside `run`, so that `--help` starts without JAX.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Protocol

import tyro

from ddgrasp import artifacts, contract, pipeline
from ddgrasp.config import (
    Config,
    DepthFeatureConfig,
    HostsConfig,
    RecordConfig,
    ScoreConfig,
    StereoConfig,
    WorldConfig,
)
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.presets import get_preset

DEFAULT_PRESET = "demo"


class Command(Protocol):
    """What a parsed command line is."""

    def run(self) -> None:
        """Does the work; raises UserError for wrong input."""
        ...


@dataclass(frozen=True)
class _FromPreset:
    config: Annotated[Config, tyro.conf.arg(name="")]
    """Values of the preset; any of them can be given on its own, for example --seed 1."""
    out: Path
    """Directory of the run."""
    resume: bool = False
    """Continue what is there; finished stages are not redone."""


@dataclass(frozen=True)
class Run(_FromPreset):
    """The whole flow: teacher, demos, record, ddg, student, export, deploy, report."""

    def run(self) -> None:
        from evaluation.report import print_summary

        check_config_values(self.config)
        _check_devices(self.config, self.out)
        report = pipeline.run(self.config, self.out, resume=self.resume)
        print(f"{self.out / 'report.json'}\n{self.out / 'report.html'}\n")
        print_summary(report)


class _OneStage(_FromPreset):
    stage: str

    def run(self) -> None:
        stage = pipeline.get_stage(self.stage)
        pipeline.run_stage(stage, check_config_values(self.config), self.out, resume=self.resume)


@dataclass(frozen=True)
class TeacherTrain(_OneStage):
    """Train the privileged teacher by PPO, on every device there is, on one host or several."""

    hosts: HostsConfig = field(default_factory=HostsConfig)
    """Several hosts: start the same command on each, with an --out that all of them share."""

    stage = "teacher"

    def run(self) -> None:
        from ppo import hosts

        hosts.connect(self.hosts)
        check_config_values(self.config)
        _check_devices(self.config, self.out)
        stage = pipeline.get_stage(self.stage)
        pipeline.run_stage(stage, self.config, self.out, resume=self.resume, leads=hosts.leads())


@dataclass(frozen=True)
class TeacherEval:
    """Measure a trained teacher again, per object: success, motion, what the camera sees, a contact sheet."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or pretrained folder."""
    world: WorldConfig
    """Objects, seen or not, and randomisation; by default those that the teacher was trained on."""
    trials: int = 200
    """Episodes of each object."""
    watched: int = 8
    """How many of them are drawn, to count the object's visible pixels."""
    seed: int = 0
    """Of the episodes."""
    out: Path | None = None
    """Where trials.json and pictures/episodes.png go; by default beside the teacher, for the report."""

    def run(self) -> None:
        from ddgrasp.progress import Progress
        from evaluation import teacher_trials
        from mjx_envs.grasp_env import GraspEnv
        from ppo import trials
        from ppo.policy import load_policy
        from ppo.visible import MOMENTS

        _check_count("--trials", self.trials)
        _check_count("--watched", self.watched)
        check_objects(self.world)
        directory = self.run_dir / "teacher"
        teacher = artifacts.read_artifact(directory).hash
        env, policy = GraspEnv(self.world), load_policy(directory)
        progress = Progress(name="teacher eval")
        result, pictures = trials.measure(env, policy, self.trials, self.watched, self.seed, progress)
        summary = teacher_trials.summarise(result, teacher, self.world, self.seed)
        teacher_trials.print_summary(summary)
        for path in teacher_trials.save(self.out or directory, summary, pictures, MOMENTS):
            print(path)


@dataclass(frozen=True)
class TeacherCompare:
    """Measure a trained teacher on several physics backends; the run's report shows what it loses."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run."""
    backends: tuple[str, ...] = ("cpu", "jax")
    """Physics backends: cpu, jax, warp."""
    trials: int | None = None
    """Episodes per backend; by default 1000, on jax 200 (without a GPU it compiles for minutes)."""
    seed: int = 0
    """Of the episodes."""

    def run(self) -> None:
        if self.trials is not None:
            _check_count("--trials", self.trials)
        from evaluation import backends as measured
        from evaluation import wilson
        from ppo.backends import evaluate_backends
        from ppo.policy import load_policy

        config = load_config(self.run_dir, "teacher")
        directory, results = self.run_dir / "teacher", {}
        policy = load_policy(directory)
        for name, result in evaluate_backends(config.world, policy, self.backends, self.trials, self.seed):
            success = wilson.success(result["success"]["successes"], result["success"]["n"])
            print(f"{name:<6} {wilson.describe(success)}", flush=True)
            results[name] = result
            measured.save(directory, results, self.seed)
        print(f"{directory / measured.BACKENDS_FILE}: `ddgrasp report {self.run_dir}` shows it.")


@dataclass(frozen=True)
class StudentEval:
    """Measure a trained student again, closed loop in simulation: clean and generated depth, same seeds."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run."""
    trials: int = 200
    """Episodes per kind of depth."""
    seed: int = 1
    """Of the episodes."""

    def run(self) -> None:
        from ddg_jax.sample import Generator
        from ddgrasp.progress import Progress
        from evaluation import wilson
        from ppo.policy import load_policy
        from student_jax.evaluate import closed_loop
        from student_jax.policy import PARAMS_FILE

        _check_count("--trials", self.trials)
        config = load_config(self.run_dir, "student")
        evaluation = replace(config.evaluation, student_trials=self.trials)
        config = replace(config, seed=self.seed, evaluation=evaluation)
        params = artifacts.load_params(self.run_dir / "student" / PARAMS_FILE)
        generator = Generator.load(self.run_dir / "ddg")
        teacher = load_policy(self.run_dir / "teacher")
        result = closed_loop(config, teacher, generator, params, Progress(name="student eval"))
        for name, counts in result.items():
            success = counts["success"]
            print(f"{name:<14} {wilson.describe(wilson.success(success['successes'], success['n']))}")


@dataclass(frozen=True)
class DemosCollect(_OneStage):
    """Collect successful teacher episodes with clean depth."""

    stage = "demos"


@dataclass(frozen=True)
class Record(_OneStage):
    """Record RGB-D from the pseudo-real rig, moved by the teacher."""

    stage = "record"


@dataclass(frozen=True)
class RecordImport:
    """Turn RealSense .bag files or folders of colour and depth pictures into recordings."""

    source: tyro.conf.Positional[Path]
    """A .bag, a folder of them, a folder with depth/ and color/ (or rgb/), or a folder of such folders."""
    out: Path = Path("recordings")
    """Each source becomes a folder in it."""
    depth_unit_m: float = 0.0
    """Metres per unit of depth; 0 takes a .bag's own, 0.001 for integer pictures, 1 for floats."""
    sensor: str = ""
    """Camera model, for example D455; a .bag names its own."""
    fx_px: float = 0.0
    """Focal length of the depth pictures in pixels; 0 if unknown."""
    baseline_m: float = 0.0
    """Distance between the imagers; 0 if unknown."""
    consecutive: bool = False
    """The pictures follow each other in time (a .bag's do)."""

    def run(self) -> None:
        from sensors import importers

        if not 0 <= self.depth_unit_m <= 1:
            raise UserError(f"--depth-unit-m is {self.depth_unit_m}; expected 0 (known) or up to 1 (metres).")
        known = {"sensor": self.sensor, "fx_px": self.fx_px, "baseline_m": self.baseline_m}
        meta = {name: value for name, value in known.items() if value}
        if self.consecutive:
            meta["consecutive_frames"] = True
        sources = importers.find_sources(self.source, self.depth_unit_m, meta)
        print(importers.summary(*importers.import_all(sources, self.out)))


@dataclass(frozen=True)
class DDGFit(_OneStage):
    """Fit the depth noise model on recordings: the run's own, or any in --data."""

    data: Path | None = None
    """A recording, or a folder of them (color/, depth/, meta.json); none takes the run's recordings."""

    stage = "ddg"

    def run(self) -> None:
        if self.data is None:
            super().run()
            return
        config, data, directory = check_config_values(self.config), self.data, self.out / self.stage
        stage = pipeline.get_stage(self.stage)

        def work(progress):
            from ddg_jax.stage import fit_folder

            return fit_folder(config, data, directory, progress=progress)

        inputs = {"data": str(data.resolve())}
        pipeline.make(stage, config, self.out, work, resume=self.resume, inputs=inputs)


@dataclass(frozen=True)
class DDGSample:
    """Draw recorded frames beside what a fitted noise model makes of them, as a PNG."""

    model: Path
    """Stage directory of a fitted model, for example runs/demo/ddg."""
    data: Path
    """A recording, or a folder of them."""
    out: Path = Path()
    """Where samples.png goes."""
    count: int = 4
    """Frames to draw."""
    seed: int = 0
    """Of the noise."""

    def run(self) -> None:
        from ddg_jax.stage import sample_folder

        _check_count("--count", self.count)
        print(sample_folder(self.model, self.data, self.out, seed=self.seed, count=self.count))


@dataclass(frozen=True)
class _Scoring:
    score: Annotated[ScoreConfig, tyro.conf.arg(name="")]
    """How to score; the rest of the configuration is the run's own."""
    preset: str
    """Preset whose sizes to take."""
    out: Path
    """Directory of the result, a folder in it; usually the run's."""
    run_dir: Path | None = None
    """Run whose teacher and generator to use; none takes --out."""
    seed: int = 0
    """Of trajectories, noise and resampling."""
    resume: bool = False
    """Continue what is there."""

    def _make(self, stage_name: str, work: Callable[[Config, Path, Any], artifacts.Artifact]) -> None:
        """Lets `work` make the stage from the run's teacher and generator, and prints where the result is."""
        source = self.run_dir or self.out
        config = replace(load_config(source, "ddg"), score=self.score, seed=self.seed)
        parents = {name: artifacts.read_artifact(source / name).hash for name in ("teacher", "ddg")}
        pipeline.make(
            pipeline.get_stage(stage_name), config, self.out, lambda progress: work(config, source, progress),
            resume=self.resume, inputs=parents,
        )  # fmt: skip


@dataclass(frozen=True)
class DDGScore(_Scoring):
    """Compare generated depth with recorded depth: the paper's Table I, hole measures, t-SNE."""

    real: Path | None = None
    """Recordings of a real camera: fits on the first frames and scores the last, instead of the rig."""
    fit_frames: int = 80
    """Frames that --real is fitted on."""
    score_frames: int = 40
    """Frames that --real is scored on."""

    def run(self) -> None:
        from evaluation import score
        from evaluation.score_page import print_result

        if self.real is None:
            self._make("score", lambda config, source, p: score.run(config, source, self.out, progress=p))
            print_result(self.out / "score")
            return
        _check_count("--fit-frames", self.fit_frames)
        config = replace(get_preset(self.preset), score=self.score, seed=self.seed)
        root, stage = self.real, pipeline.get_stage("score_real")

        def work(progress):
            return score.run_real(
                config, root, self.fit_frames, self.score_frames, self.out, progress=progress
            )

        inputs = {"frames": f"{root.resolve()} {self.fit_frames} {self.score_frames}"}
        pipeline.make(stage, config, self.out, work, resume=self.resume, inputs=inputs)
        print_result(self.out / stage.name)


@dataclass(frozen=True)
class DDGCurve(_Scoring):
    """Fit and score the generator on 5, 10, 20, ... recorded trajectories: the data-efficiency curve."""

    def run(self) -> None:
        from evaluation import score_curve
        from evaluation.score_page import print_result

        self._make("curve", lambda config, source, p: score_curve.run(config, source, self.out, progress=p))
        print_result(self.out / "curve")


@dataclass(frozen=True)
class DDGFeatures:
    """Train the depth feature extractor that scores use; the frozen one is part of the repository."""

    config: Annotated[DepthFeatureConfig, tyro.conf.arg(name="")] = DepthFeatureConfig()
    out: Path = Path("runs") / "depthfeat"
    """Folder of the extractor; the same command continues what was begun there."""

    def run(self) -> None:
        from foundation.depth_feature_training import train

        manifest = train(self.config, self.out)
        print(json.dumps(manifest["tested_on_new_cameras"], indent=2))


@dataclass(frozen=True)
class DDGDistil:
    """Distil a fitted noise model to few network evaluations per map."""

    model: Path
    """Stage directory of a fitted model, for example runs/demo/ddg."""
    data: Path
    """The recordings it was fitted on: a recording, or a folder of them."""
    out: Path
    """Directory of a run; the distilled model goes to its folder ddg."""
    evaluations: int = 4
    """Network evaluations per map; those passed on the way (4 and 2 before 1) are kept too."""
    steps: int | None = None
    """Optimiser steps per halving; none takes the model's ddg.distil_steps."""
    resume: bool = False
    """Continue what is there."""

    def run(self) -> None:
        fitted = artifacts.read_artifact(self.model)
        config = artifacts.config_from_json(fitted.manifest.config)
        ddg = replace(
            config.ddg,
            init_from=str(self.model.resolve()),
            sampler="progressive",
            sample_steps=self.evaluations,
            distil_steps=config.ddg.distil_steps if self.steps is None else self.steps,
        )
        config = replace(config, ddg=ddg)

        def work(progress):
            from ddg_jax.stage import fit_folder

            return fit_folder(config, self.data, self.out / "ddg", progress=progress)

        inputs = {"data": str(self.data.resolve()), "model": fitted.hash}
        stage = pipeline.get_stage("ddg")
        pipeline.make(stage, config, self.out, work, resume=self.resume, inputs=inputs)


@dataclass(frozen=True)
class DDGGenerate:
    """Give all demos the camera's artefacts: a stream in constant memory, over all devices."""

    model: Path
    """Stage directory of a fitted model, for example runs/demo/ddg."""
    demos: Path
    """Stage directory of collected demos, for example runs/demo/demos."""
    out: Path
    """Directory of a run; the depth goes to its folder noisy."""
    seed: int = 0
    """Of the noise."""
    resume: bool = False
    """Continue what is there."""

    def run(self) -> None:
        inputs = {name: artifacts.read_artifact(getattr(self, name)).hash for name in ("model", "demos")}
        config = artifacts.config_from_json(artifacts.read_manifest(self.model).config)
        config = replace(config, seed=self.seed)

        def work(progress):
            from ddg_jax.generate import generate_store

            return generate_store(self.model, self.demos, self.out / stage.name, config, progress)

        stage = pipeline.Stage("noisy", "ddg_jax", ("demos", "ddg"), "depth of the demos with artefacts")
        made = pipeline.make(stage, config, self.out, work, resume=self.resume, inputs=inputs).manifest
        print(
            "{episodes} episodes, {frames} frames, {invalid_fraction:.1%} of pixels invalid".format(
                **made.metrics
            )
        )


@dataclass(frozen=True)
class DDGThresholds:
    """Holes, flicker and error over thresholds of a fitted noise model's mask: a table, JSON, a PNG."""

    model: Path
    """Stage directory of a fitted model, for example runs/demo/ddg."""
    data: Path
    """A recording, or a folder of them; its last frames are used."""
    out: Path = Path()
    """Where thresholds.json and thresholds.png go."""
    count: int = 180
    """Frames."""
    seed: int = 1
    """Of the noise."""

    def run(self) -> None:
        from ddg_jax import thresholds
        from ddgrasp.progress import Progress

        _check_count("--count", self.count)
        progress = Progress(name="thresholds")
        rows = thresholds.analyse(self.model, self.data, self.out, progress, count=self.count, seed=self.seed)
        print(f"{thresholds.table(rows)}\n{self.out / thresholds.FILE}.png")


@dataclass(frozen=True)
class StudentTrain(_OneStage):
    """Train the depth-only student on noisy demonstrations."""

    stage = "student"


@dataclass(frozen=True)
class Export(_OneStage):
    """Write the student as one ONNX file and check it against JAX."""

    stage = "export"


@dataclass(frozen=True)
class Deploy:
    """Run an exported policy on a robot and a camera at 10 Hz."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    """Without --preset: the configuration of the run that the policy lies in."""
    policy: Path
    """ONNX file that `ddgrasp export` wrote."""
    robot: str = "sim"
    """sim (the pseudo-real rig) or franka."""
    camera: str = "stereo"
    """stereo (the rig's own), realsense, or replay (a recording)."""
    recording: Path | None = None
    """Recording for camera replay."""
    object_name: str = ""
    """Object on the rig's table; empty takes the first configured one."""
    seconds: float = 6.0
    """How long to run; inf runs until Ctrl-C."""

    def run(self) -> None:
        from deploy.session import SessionOptions, deploy, describe

        options = SessionOptions(self.robot, self.camera, self.recording, self.object_name, self.seconds)
        print(describe(deploy(self.config, self.policy, options)))


@dataclass(frozen=True)
class WeightsConvert:
    """Convert a published checkpoint (.pth, .safetensors) of a depth network, ResNet-18 or FID Inception."""

    file: tyro.conf.Positional[Path]
    """File as `ddgrasp weights list` names it; what is pickled in it is not run."""
    out: Path = Path("weights")
    """Folder of converted weights; each network gets a folder in it."""
    max_depth_m: float = 0.0
    """Range of a metric depth model in metres (20 indoor, 80 outdoor); 0 for the relative ones."""

    def run(self) -> None:
        from foundation import store

        directory = store.convert_file(self.file, self.out, self.max_depth_m)
        manifest = store.read_manifest(directory)
        print(
            f"{directory}: {manifest.network}, {manifest.parameters:,} numbers\nLicence: {manifest.licence}"
        )


@dataclass(frozen=True)
class WeightsList:
    """List networks with published weights: where to get them, their licence, what is installed."""

    out: Path = Path("weights")
    """Folder of converted weights."""

    def run(self) -> None:
        from foundation import catalog, store

        there = store.installed(self.out)
        for name, entry in catalog.ENTRIES.items():
            manifest = there.get(name)
            state = (
                f"installed in {self.out / name}, from {manifest.source_file}"
                if manifest
                else "not installed"
            )
            lines = {"file": entry.file, "published": entry.published, "licence": entry.licence}
            lines |= {"used for": entry.used_for, "here": state}
            print(name, *(f"  {title:<10} {text}" for title, text in lines.items()), "", sep="\n")


@dataclass(frozen=True)
class Report:
    """Write report.json and report.html of a run anew, and print the table."""

    out: tyro.conf.Positional[Path]
    """Directory of the run."""

    def run(self) -> None:
        from evaluation.report import print_summary
        from evaluation.stage import write_report

        report = write_report(self.out)
        print(f"{self.out / 'report.json'}\n{self.out / 'report.html'}\n")
        print_summary(report)


@dataclass(frozen=True)
class ObjectsList:
    """Name the objects: category, size, mass, friction, where the numbers come from."""

    def run(self) -> None:
        from mjx_envs.objects import OBJECTS

        for spec in OBJECTS.values():
            size = " x ".join(f"{1000 * extent:.0f}" for extent in spec.extents_m())
            numbers = f"{size:>14} mm {1000 * spec.mass_kg:>4.0f} g  friction {spec.friction}"
            print(f"{spec.category_id:>2} {spec.name:<10} {numbers}  {spec.source}")


@dataclass(frozen=True)
class ObjectsSheet:
    """Draw objects as a camera sees them, colour and depth, as one PNG."""

    objects: tuple[str, ...] = ()
    """Names; none draws all of them, those that the paper trains on first."""
    out: Path = Path("objects.png")
    """The picture's file."""

    def run(self) -> None:
        from evaluation.object_sheet import draw
        from mjx_envs.objects import OBJECTS

        everything = tuple(dict.fromkeys((*contract.SEEN_OBJECTS, *contract.UNSEEN_OBJECTS, *OBJECTS)))
        artifacts.atomic_write_bytes(self.out, draw(self.objects or everything))
        print(self.out)


@dataclass(frozen=True)
class SensorsCompare:
    """Set the rig's stereo camera beside real D4xx cameras: holes, noise, flicker, as table, JSON and PNG."""

    stereo: StereoConfig = field(default_factory=StereoConfig)
    """The rig's camera."""
    camera_scale: float = 0.25
    """Size of its picture relative to 1280 x 720."""
    real: Path | None = None
    """A recording of a real camera, or a folder of them; none takes the figures measured before."""
    out: Path = Path()
    """Where sensors.json and sensors.png go."""
    scenes: int = 1
    """Standing scenes per object."""
    frames: int = 6
    """Frames per scene."""
    seed: int = 0
    """Of the scenes."""

    def run(self) -> None:
        from ddgrasp.progress import Progress
        from sensors import compare

        if not 0.1 <= self.camera_scale <= 1.0:
            raise UserError(f"--camera-scale is {self.camera_scale}; expected 0.1 to 1.")
        _check_count("--scenes", self.scenes)
        if self.frames < 2:
            raise UserError(f"--frames is {self.frames}; expected at least 2, for noise over time.")
        result = compare.compare(
            RecordConfig(stereo=self.stereo),
            contract.D455.scaled(self.camera_scale),
            self.real,
            per_object=self.scenes,
            frames=self.frames,
            seed=self.seed,
            progress=Progress(name="sensors compare"),
        )
        compare.print_tables(result)
        print(*compare.write(result, self.out), sep="\n")


COMMANDS: dict[str, type] = {
    "run": Run,
    "teacher train": TeacherTrain,
    "teacher eval": TeacherEval,
    "teacher compare": TeacherCompare,
    "demos collect": DemosCollect,
    "record": Record,
    "record import": RecordImport,
    "ddg fit": DDGFit,
    "ddg sample": DDGSample,
    "ddg score": DDGScore,
    "ddg curve": DDGCurve,
    "ddg features": DDGFeatures,
    "ddg distil": DDGDistil,
    "ddg generate": DDGGenerate,
    "ddg thresholds": DDGThresholds,
    "student train": StudentTrain,
    "student eval": StudentEval,
    "export": Export,
    "deploy": Deploy,
    "weights convert": WeightsConvert,
    "weights list": WeightsList,
    "report": Report,
    "objects list": ObjectsList,
    "sensors compare": SensorsCompare,
    "objects sheet": ObjectsSheet,
}


def parse(name: str, args: Sequence[str]) -> Command:
    """The command `name` with its options; prints help or usage and raises SystemExit as tyro does."""
    cls = COMMANDS[name]
    options: dict[str, Any] = {}
    if issubclass(cls, _FromPreset):
        preset = get_preset(_option(args, "--preset") or DEFAULT_PRESET)
        options["default"] = cls(config=preset, out=Path("runs") / preset.preset)
    elif issubclass(cls, _Scoring):
        preset = get_preset(_option(args, "--preset") or DEFAULT_PRESET)
        options["default"] = cls(preset.score, preset.preset, Path("runs") / preset.preset)
    elif cls is Deploy:
        policy = Path(_option(args, "--policy") or Path("runs") / DEFAULT_PRESET / "export" / "policy.onnx")
        options["default"] = Deploy(config=_config_of(policy, _option(args, "--preset")), policy=policy)
    elif cls is TeacherEval:
        options["default"] = _teacher_eval(Path(args[0]) if args and args[0][0] != "-" else None)
    return tyro.cli(
        cls,
        prog=f"ddgrasp {name}",
        args=list(args),
        config=(tyro.conf.FlagCreatePairsOff,),
        **options,
    )


def describe_commands(group: str = "") -> str:
    """The list that `ddgrasp --help` (or `ddgrasp teacher`) prints."""
    names = [name for name in COMMANDS if not group or name.split()[0] == group]
    lines = [f"  {name:<16} {(COMMANDS[name].__doc__ or '').splitlines()[0]}" for name in names]
    return "\n".join(
        ["usage: ddgrasp COMMAND [options]   (each command has --help)", "", *lines, "", *_PRESET_HELP]
    )


_PRESET_HELP = (
    "Presets (--preset): debug (tests), demo (24 minutes on two cores), laptop (all from nothing, 40 minutes",
    "on two cores), paper (one GPU). Any value of a preset can be given, for example --teacher.num-envs 64.",
)


CHECKPOINTS = {"teacher": "policy.msgpack", "ddg": "params.msgpack", "student": "params.msgpack"}
"""File that `<stage>.init_from` must hold, itself or in a folder named after the stage. Named here too, since
the stages' own modules import JAX."""


def check_config_values(config: Config) -> Config:
    """`config` if the names and files in it exist; UserError with the remedy otherwise."""
    from ddg_jax.depth_prior import IN_SIMULATION
    from ddg_jax.prior import make_prior
    from export.metadata import check_depth_dtype

    check_objects(config.world)
    for stage, file in CHECKPOINTS.items():
        _check_start(stage, getattr(config, stage).init_from, file)
    if config.ddg.prior_in_sim not in IN_SIMULATION:
        raise unknown_name("ddg.prior_in_sim", config.ddg.prior_in_sim, IN_SIMULATION)
    make_prior(config.ddg)
    check_depth_dtype(config.export.depth_dtype)
    if config.student.encoder_weights:
        from student_jax import pretrained_encoder

        pretrained_encoder.source(config.student)
    return config


def check_objects(world: WorldConfig) -> None:
    """UserError unless `world` has objects, all of them known."""
    from mjx_envs.objects import OBJECTS, get_object

    if not world.objects:
        raise UserError(f"world.objects is empty; expected at least one of {', '.join(OBJECTS)}.")
    for name in world.objects:
        get_object(name)


def _check_devices(config: Config, run_dir: Path) -> None:
    """UserError if the teacher, unless it is finished, cannot be trained on the devices present."""
    if not artifacts.is_finished(run_dir / "teacher"):
        from ppo.stage import check

        check(config)


def _check_start(stage: str, init_from: str, file: str) -> None:
    """UserError unless `init_from` is empty or holds the checkpoint `file`."""
    source = Path(init_from)
    if not init_from or any(path.is_file() for path in (source / file, source / stage / file)):
        return
    pretrained = source.parts[:1] == ("pretrained",)
    remedy = (
        "run it from the repository root" if pretrained else "give a run or pretrained folder, or nothing"
    )
    trouble = f"holds no {file}" if source.exists() else "does not exist"
    raise UserError(f"{stage}.init_from is {init_from!r}, which {trouble}: {remedy}.")


def _check_count(option: str, value: int) -> None:
    if value < 1:
        raise UserError(f"{option} is {value}; expected at least 1.")


def load_config(run_dir: Path, stage: str) -> Config:
    """The configuration that made the finished `stage` of a run."""
    return artifacts.config_from_json(artifacts.read_manifest(run_dir / stage).config)


def _teacher_eval(run_dir: Path | None) -> TeacherEval:
    """The command with the world of the run in `run_dir`, where there is one."""
    run_dir = run_dir or Path("runs") / DEFAULT_PRESET
    there = artifacts.is_finished(run_dir / "teacher")
    config = load_config(run_dir, "teacher") if there else get_preset(DEFAULT_PRESET)
    return TeacherEval(run_dir=run_dir, world=config.world)


def _config_of(policy: Path, preset: str | None) -> Config:
    """The named preset; else what made the artefact beside `policy`; else the default preset."""
    if preset is None and artifacts.is_finished(policy.parent):
        return artifacts.config_from_json(artifacts.read_manifest(policy.parent).config)
    return get_preset(preset or DEFAULT_PRESET)


def _option(args: Sequence[str], name: str) -> str | None:
    """Value of `--name value` or `--name=value` among `args`."""
    for index, arg in enumerate(args):
        if arg == name and index + 1 < len(args):
            return args[index + 1]
        if arg.startswith(f"{name}="):
            return arg.split("=", 1)[1]
    return None
