"""ddgrasp student, export, deploy: the policy."""

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from app.commands.base import DEFAULT_PRESET, OneStage, load_config, say
from app.commands.checks import check_folder, check_objects, check_tried, tell_trials
from ddgrasp import artifacts, config_file, contract
from ddgrasp.config import Camera, Config, Robot
from ddgrasp.config.checks import Count, Range, Seed
from ddgrasp.errors import UserError
from ddgrasp.policy_metadata import POLICY_FILE
from ddgrasp.presets import get_preset
from ddgrasp.shipped import NAME, shipped

DEFAULT_POLICY = Path("runs") / DEFAULT_PRESET / "export" / POLICY_FILE


@dataclass(frozen=True)
class StudentTrain(OneStage):
    """Train the depth-only student on noisy demonstrations."""

    stage = "student"


@dataclass(frozen=True)
class StudentEval:
    """Measure a trained student again, closed loop in simulation: clean and sensed depth, same seeds."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run."""
    trials: Count = 200
    """Episodes per kind of depth."""
    seed: Seed = 1
    """Seed of the episodes."""

    def run(self) -> None:
        """Prints success on clean depth and on training's, with Wilson intervals, and perception's error."""
        config = load_config(self.run_dir, "student")
        _tell_of_others(self.run_dir, config)
        from ddgrasp.progress import Progress
        from evaluation import wilson
        from evaluation.report.summary import perceived
        from learning.params import load_params
        from ppo import policy as teacher_policy
        from student_jax.depth_source import make_source
        from student_jax.evaluate import closed_loop
        from student_jax.policy import PARAMS_FILE

        evaluation = replace(config.evaluation, student_trials=self.trials)
        config = replace(config, seed=self.seed, evaluation=evaluation)
        tell_trials(config)
        params = load_params(self.run_dir / "student" / PARAMS_FILE)
        source = make_source(config, self.run_dir / "ddg")
        teacher = teacher_policy.load(self.run_dir / "teacher")
        result = closed_loop(config, teacher, source, params, Progress(name="student eval"))
        for name, counts in result.items():
            success = counts["success"]
            rate = wilson.describe(wilson.success(success["successes"], success["n"]))
            print(f"{name:<14} {rate}{perceived(counts)}")


def _tell_of_others(run_dir: Path, config: Config) -> None:
    """Says on standard error what a student is measured with and its manifest does not name."""
    from student_jax.source_check import LEARNED

    made_of = artifacts.read_manifest(run_dir / "student").parents
    for name in ("teacher", *(("ddg",) if config.student.depth_source in LEARNED else ())):
        if (digest := made_of.get(name)) and artifacts.read_artifact(run_dir / name).hash != digest:
            print(
                f"{run_dir / 'student'} names another {name}, by its manifest, than {run_dir / name}, which "
                "it is measured with.",
                file=sys.stderr,
                flush=True,
            )


@dataclass(frozen=True)
class StudentPerception:
    """Measure what a student perceives on the development rig beside the truth; the run's report shows it."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, with the stages student and export."""
    camera: Literal["stereo", "ideal", "generator", "training"] = "stereo"
    """stereo (the rig's own), ideal (without errors), generator (depth without errors, with those that a
    generator draws), or training: no trials on the rig, but the run's own demonstrations with the errors that
    the student was trained on."""
    generator: Path = Path("pretrained/ddg/generator.onnx")
    """What `ddgrasp ddg export` wrote, for camera generator."""
    objects: tuple[str, ...] = ("all",)
    """Names (`ddgrasp objects list`), or all: the paper's twelve (camera training: the run's, always)."""
    trials: Count = 6
    """How many with every object."""
    number: Annotated[int, Range(0, 999)] = 0
    """Which development seed (not of camera training)."""

    def run(self) -> None:
        """Runs the trials and prints a row for each part of them."""
        config = load_config(self.run_dir, "export")
        from ddgrasp.progress import Progress
        from deploy.changes import Change
        from deploy.generated_camera import digest
        from evaluation import perception, perception_table, training_perception
        from evaluation.rig_trials import Series

        series = Series("development", self.objects, self.trials, number=self.number)
        check_tried(series)
        check_folder("RUN-DIR", self.run_dir / "student")
        progress = Progress(name="student perception")
        camera = self.camera
        if self.camera == "training":
            rows = training_perception.measure(config, self.run_dir, self.trials, progress)
        else:
            if self.camera == "generator":
                camera = f"generator {digest(self.generator, config.world.profile)[:8]}"
            change = Change(sight=self.camera, generator=self.generator)
            rows = perception.measure(config, self.run_dir, series, change, progress)
        print(perception_table.describe(rows))
        print(perception_table.save(self.run_dir / "student", camera, rows))


@dataclass(frozen=True)
class Export(OneStage):
    """Write the student as one ONNX file and check it against JAX."""

    stage = "export"


@dataclass(frozen=True)
class Deploy:
    """Run an exported policy on a robot and a camera at 10 Hz.

    Without --preset the configuration is that of the run that the policy lies in. Of the values seed,
    world.*, record.* and deploy.* count: the policy's own are in its file.
    """

    config: Annotated[Config, tyro.conf.arg(name="")]
    """Values that can be given on their own."""
    policy: Path
    """ONNX file that `ddgrasp export` wrote."""
    robot: Robot = "sim"
    """sim (the development rig) or franka."""
    host: str = ""
    """Address of franka's control unit; empty takes deploy.franka.host, or 127.0.0.1 with camera rig."""
    camera: Camera = "stereo"
    """stereo (the rig's own), realsense, replay (a recording), rig (the FR3 rig at --host), or rig-ideal (the
    same without errors)."""
    recording: Path | None = None
    """Recording for camera replay."""
    object_name: str = ""
    """Object on the rig's table, empty takes the first configured one; before a real arm it is only noted."""
    seconds: float = contract.TRIAL_S
    """How long to run; inf runs until Ctrl-C."""
    dry_run: bool = False
    """Everything but the motion: what would be sent is printed and drawn."""
    yes: bool = False
    """Move without asking first, and do not ask at the end whether it succeeded."""
    out: Path = Path("runs/deployments")
    """Folder that every run leaves its report in."""
    calibration: Path | None = None
    """What `ddgrasp calibrate` wrote, if it is not runs/calibration/calibration.json."""
    config_file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """YAML file to take instead of --preset, as `ddgrasp deploy trials` takes it."""

    def run(self) -> None:
        """Runs the loop until the time is over, Ctrl-C or a fault, and prints how it kept time.

        Raises SystemExit(1) after a fault, and KeyboardInterrupt where it was interrupted, unless that is
        how it was to end: what called it is not to go on to the next trial.
        """
        from deploy.interrupts import ended_late
        from deploy.session import SessionOptions, deploy, describe

        options = SessionOptions(
            self.robot, self.camera, self.recording, self.object_name, self.seconds,
            dry_run=self.dry_run, yes=self.yes, host=self.host, out=self.out, calibration=self.calibration,
        )  # fmt: skip
        if not options.real:  # what else there is to grasp, no configuration knows
            check_objects(self.config.world)
        _check_policy(self.policy)
        check_folder("--out", self.out)
        preset = None if self.config.preset == DEFAULT_PRESET else self.config.preset
        if note := unknown_origin(self.policy, preset, self.config_file):
            say(note)
        report = deploy(self.config, self.policy, options, say)
        say(describe(report))
        if report.fault:
            sys.exit(1)
        if report.interrupted and (math.isfinite(self.seconds) or not report.steps):
            raise KeyboardInterrupt
        if ended_late() and not report.interrupted:  # whoever wanted an end wants no next trial
            raise KeyboardInterrupt


def _check_policy(policy: Path) -> None:
    """UserError that names the student of this project where no policy was given and there is none yet."""
    there = Path(NAME) / "student" / POLICY_FILE
    if policy == DEFAULT_POLICY and not policy.exists() and shipped(there).is_file():
        raise UserError(
            f"--policy is {policy}, which does not exist: make one with `ddgrasp export`, or give --policy "
            f"{there}, which comes with this project."
        )


def config_of(policy: Path, preset: str | None, file: Path | None = None) -> Config:
    """What the YAML `file` says; else the named preset; else what made the artifact beside `policy`; else the
    default preset. UserError if both are given, or the file is none."""
    if file is not None:
        if preset is not None:
            raise UserError(f"--config {file} and --preset {preset} both name a configuration: drop one.")
        return config_file.read(file)
    if preset is None and artifacts.is_finished(policy.parent):
        return artifacts.config_from_json(artifacts.read_manifest(policy.parent).config)
    return get_preset(preset or DEFAULT_PRESET)


def unknown_origin(policy: Path, preset: str | None, file: Path | None) -> str:
    """What is to be said of a policy beside which nothing says what made it, where nobody else does."""
    if preset is not None or file is not None or artifacts.is_finished(policy.parent):
        return ""
    return (
        f"no manifest.json beside {policy}: the configuration is that of preset {DEFAULT_PRESET} (--preset)"
    )
