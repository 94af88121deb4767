"""Trials that leave behind what a deployment does: every step, a picture of each, how it ended."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ddgrasp import contract
from ddgrasp.config import Config
from ddgrasp.errors import Trouble
from deploy.interfaces import Filmed
from deploy.loop_report import Step
from deploy.policy import OnnxPolicy
from deploy.record import DeploymentRecord
from deploy.trials import Bench, Trial, TrialResult, Watch
from rig.film import Film


@dataclass(frozen=True)
class RecordedBench:
    """Makes a `RecordingBench` in every worker."""

    make: Callable[[Config, Path], Bench]
    """Makes what the trials are run on."""
    folder: Path
    """Each trial becomes a folder in it."""
    about: Mapping[str, str]
    """For every report: robot, camera."""

    def __call__(self, config: Config, policy_path: Path) -> "RecordingBench":
        return RecordingBench(self, config, policy_path)


class RecordingBench:
    """Runs trials on another bench and keeps them."""

    def __init__(self, what: RecordedBench, config: Config, policy_path: Path):
        self._what, self._policy_path = what, policy_path
        self._profile = OnnxPolicy(policy_path).info.profile
        self._bench = what.make(config, policy_path)

    def run(self, trial: Trial, watch: Watch | None = None) -> tuple[TrialResult, Film]:
        """See Bench. A colour picture is drawn in every step, which takes time that is not the robot's."""
        folder = episode_folder(self._what.folder, trial.index, trial.object_name)
        about = {**self._what.about, "policy": str(self._policy_path), "object": trial.object_name}
        kept: list[DeploymentRecord] = []
        with ExitStack() as frames:

            def look(step: Step, camera: Filmed) -> bool | None:
                if step.index == 0:  # also where a trial is run again
                    frames.close()
                    kept[:] = [DeploymentRecord(camera, self._profile, _sensor(about), 1)]
                    frames.enter_context(kept[0].into(folder))
                kept[0].look(step)
                return None if watch is None else watch(step, camera)

            result, film = self._bench.run(trial, look)
        for record in kept:
            record.finish(folder, _report(result), result.success, about)
            if record.lost:  # not logged, so that the same command runs it again
                raise Trouble(f"{folder}: pictures are not kept ({record.lost}): give the command again.")
        return result, film

    def close(self) -> None:
        """See Bench."""
        self._bench.close()


def _sensor(about: Mapping[str, Any]) -> str:
    """What recordings call the camera: one whose depth was treated is another."""
    treated = f", depth {about['depth']}" if "depth" in about else ""
    return f"{about['camera']}, D455 profile{treated}"


def episode_folder(folder: Path, index: int, object_name: str) -> Path:
    """Where trial `index` is kept in `folder`."""
    return folder / f"{index:04d}-{object_name}"


def _report(result: TrialResult) -> dict[str, Any]:
    """What `LoopReport.as_dict` says of a deployment, as far as a trial's result knows it."""
    return {
        "steps": result.steps,
        "holds": result.holds,
        "fault": result.fault,
        "interrupted": False,
        "safety": result.safety,
        "events": result.events,
        **result.timings.summary(contract.CONTROL_DT_S),
    }
