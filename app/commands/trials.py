"""ddgrasp deploy trials: a policy on a rig, as many times as a figure needs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from app.commands.checks import check_folder, check_tried
from ddgrasp import contract
from ddgrasp.config.checks import Count, Range
from ddgrasp.install import check_fr3


@dataclass(frozen=True)
class DeployTrials:
    """Try an exported policy on a rig: as many trials of every object, success with intervals, films."""

    policy: Path
    """ONNX file that `ddgrasp export` wrote."""
    rig: Literal["fr3", "development"] = "fr3"
    """fr3 (the test rig: another arm behind Franka's protocol, mesh objects, a D455 as it is run) or
    development (the rig that everything was tuned on)."""
    objects: tuple[str, ...] = ("all",)
    """Names (`ddgrasp objects list`, on rig fr3 with --meshes), or all: the paper's twelve, on rig fr3 six
    more."""
    trials: Count = 10
    """How many with every object."""
    split: Literal["development", "test"] = "development"
    """development seeds, or test seeds, which are to be looked at once."""
    number: Annotated[int, Range(0, 999)] = 0
    """Which seed of the split."""
    shapes: Literal["mesh", "primitive"] = "mesh"
    """On rig fr3: mesh objects, or the development rig's primitives."""
    camera: Literal["stereo", "coarse", "ideal", "other_tables"] = "stereo"
    """stereo (the rig's own), ideal (without errors), coarse (on rig fr3: matched at the policy's size), or
    other_tables (stereo, before a table that is light and dark elsewhere in every trial; what stereo means
    where record.other_tables is on)."""
    seconds: Annotated[float, Range(0.5, 60)] = contract.TRIAL_S
    """A trial ends with success, or after this."""
    contact: Annotated[float, Range(1, 100)] | None = None
    """On rig fr3: newtons at the hand, and newton metres there, at which the arm stops itself; without it
    what the configuration has, 30 as deploy begins. The joints' torque is in proportion."""
    depth: Literal["recorded", "inpaint", "monocular"] = "recorded"
    """What the policy sees: recorded, inpaint (holes filled on line), or monocular (a network on
    colour, `ddgrasp weights list`)."""
    retry: bool = True
    """A hand that stands still or has closed on nothing tries again, unless the configuration's deploy.retry
    is off; --no-retry lets the policy alone act."""
    preset: str | None = None
    """Configuration of camera and loop; without it that of the run that the policy lies in."""
    config_file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """YAML file to take instead of --preset: a copy of a run's config.yaml, or a preset's name and what
    differs from it. Another camera (record.stereo), many tables (record.other_tables)."""
    workers: Annotated[int, Range(1, 64)] = 2
    """Rigs that run side by side."""
    record: bool = False
    """Keep every trial's steps and pictures in the folder episodes, for `ddgrasp demos export`."""
    out: Path = Path("runs/trials")
    """Folder for trials.jsonl, table.json and films; trials that it has are not run again."""

    def run(self) -> None:
        """Runs what is missing and prints the table."""
        from app.commands.student import config_of, unknown_origin
        from ddgrasp.progress import Progress
        from ddgrasp.trained import policy_objects
        from evaluation import rig_trials

        if self.rig == "fr3":
            check_fr3("--rig fr3")
        series = rig_trials.Series(
            self.rig,
            self.objects,
            self.trials,
            self.split,
            self.number,
            self.shapes,
            self.camera,
            self.seconds,
            self.contact,
            self.depth,
            None if self.retry else False,
        )
        check_tried(series)
        check_folder("--out", self.out)
        config = config_of(self.policy, self.preset, self.config_file)
        progress = Progress(name="deploy trials")
        if note := unknown_origin(self.policy, self.preset, self.config_file):
            trained = ", ".join(policy_objects(self.policy, config))
            progress.note(f"{note}, and {trained} count as what the policy was trained on")
        table = rig_trials.run(
            config, self.policy, series, self.out, self.workers, progress, record=self.record
        )
        print(rig_trials.describe(table))
