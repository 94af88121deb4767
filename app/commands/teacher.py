"""ddgrasp teacher ..."""

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from app import pipeline
from app.commands.base import DEFAULT_PRESET, OneStage, load_config
from app.commands.checks import (
    check_config_values,
    check_devices,
    check_folder,
    check_objects,
    is_shipped,
    stage_folder,
)
from ddgrasp import artifacts
from ddgrasp.config import Backend, HostsConfig, WorldConfig
from ddgrasp.config.checks import Count, Seed
from ddgrasp.errors import UserError
from ddgrasp.files import to_json
from ddgrasp.presets import get_preset
from ddgrasp.shipped import holding
from ddgrasp.stages import get_stage


@dataclass(frozen=True)
class TeacherTrain(OneStage):
    """Train the privileged teacher by PPO, on every device there is, on one host or several.

    The value teacher.start says what it begins from: nothing, a scripted guide, or a checkpoint.
    """

    hosts: HostsConfig = field(default_factory=HostsConfig)
    """Several hosts: start the same command on each, with an --out that all of them share."""

    stage = "teacher"

    def run(self) -> None:
        """Trains with every process that --hosts names."""
        stage = get_stage(self.stage)
        check_config_values(self.config, self.out)
        pipeline.check_place(self.config, self.out, resume=self.resume, stages=[stage])
        from ppo import hosts

        hosts.connect(self.hosts)
        check_devices(self.config, self.out)
        pipeline.make(stage, self.config, self.out, resume=self.resume, leads=hosts.leads())


@dataclass(frozen=True)
class TeacherEval:
    """Measure a trained teacher again, per object: success, motion, what the camera sees, a contact sheet."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or pretrained folder."""
    world: WorldConfig
    """Objects, seen or not, and randomisation; by default those that the teacher was trained on."""
    trials: Count = 200
    """Episodes of each object."""
    watched: Count = 8
    """How many of them are drawn, to count the object's visible pixels."""
    seed: Seed = 0
    """Seed of the episodes."""
    out: Path | None = None
    """Where trials.json and pictures/episodes.png go; by default beside the teacher, for the report."""

    def run(self) -> None:
        """Runs the trials, prints a row per object, keeps figures and pictures."""
        check_objects(self.world)
        directory = stage_folder("RUN-DIR", self.run_dir, "teacher")
        from evaluation import teacher_trials

        teacher = artifacts.read_artifact(directory)
        if self.out is None:
            _check_own(directory, "give --out FOLDER")
            if not teacher_trials.is_its_world(teacher, to_json(self.world)):
                raise UserError(
                    f"{directory} was trained in another world than --world.* says, so that its report would "
                    "not show the figures: give --out FOLDER."
                )
        check_folder("--out", self.out or directory)
        from ddgrasp.progress import Progress
        from mjx_envs.grasp_env import GraspEnv
        from ppo import policy as teacher_policy
        from ppo import trials
        from ppo.visible import MOMENTS

        env, policy = GraspEnv(self.world), teacher_policy.load(directory)
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
    backends: tuple[Backend, ...] = ("cpu", "jax")
    """Physics backends: cpu, jax, warp."""
    trials: Count | None = None
    """Episodes per backend; by default 1000, on jax 200."""
    seed: Seed = 0
    """Seed of the episodes."""

    def run(self) -> None:
        """Measures every backend, printing and keeping each result as it comes."""
        config = load_config(self.run_dir, "teacher")
        directory, results = self.run_dir / "teacher", {}
        _check_own(directory, "copy it and name the copy")
        from evaluation import backends as measured
        from evaluation import wilson
        from ppo import policy as teacher_policy
        from ppo.backends import evaluate_backends

        policy = teacher_policy.load(directory)
        for name, result in evaluate_backends(config.world, policy, self.backends, self.trials, self.seed):
            success = wilson.success(result["success"]["successes"], result["success"]["n"])
            dropped = f"{result['contacts_dropped']:,} contacts dropped"
            print(f"{name:<6} {wilson.describe(success)}, {dropped}", flush=True)
            results[name] = result
            measured.save(directory, results, self.seed)
        print(f"{directory / measured.BACKENDS_FILE}: `ddgrasp report {self.run_dir}` shows it.")


def _check_own(directory: Path, remedy: str) -> None:
    """UserError for a folder that comes with the project: what was measured of it is not replaced."""
    if is_shipped(directory):
        raise UserError(f"{directory} comes with the project, with its own measurements: {remedy}.")


def with_world_of(run_dir: Path | None) -> TeacherEval:
    """The command with the world of the run in `run_dir`, where there is one."""
    run_dir = run_dir or Path("runs") / DEFAULT_PRESET
    found = holding(run_dir, artifacts.MANIFEST, "teacher")
    config = (
        artifacts.config_from_json(artifacts.read_manifest(found).config)
        if found
        else get_preset(DEFAULT_PRESET)
    )
    return TeacherEval(run_dir=run_dir, world=config.world)
