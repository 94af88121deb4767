"""What a stage is given to do: the one argument of every stage's `run`."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ddgrasp import artifacts, attempts
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.progress import Progress
from ddgrasp.shipped import holding
from ddgrasp.stages import CHECKPOINTS, Stage


@dataclass(frozen=True)
class Job:
    """One stage of one run. A stage reads `config` and `parents`, works in `directory`, ends with `finish`.

    What an interrupted attempt left in `directory` was begun with the same configuration and inputs
    (`attempts.begin`): a stage goes on from it without asking.
    """

    stage: Stage
    config: Config
    directory: Path
    """The stage's own, `<run>/<stage>`; it exists."""
    progress: Progress
    parents: Mapping[str, Artifact] = field(default_factory=dict)
    """The finished stages it is made from, by name; those of the stage's row in `ddgrasp/stages.py`, unless a
    command brought other material in `inputs`."""
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """Material from outside the run, by name: for example the folder of recordings in `data`."""

    def identity(self) -> dict[str, str]:
        """What the stage is made from, as text: an attempt with other material is not continued."""
        given = {name: str(v.resolve() if isinstance(v, Path) else v) for name, v in self.inputs.items()}
        return (
            {name: parent.hash for name, parent in self.parents.items()}
            | given
            | start_of(self.config, self.stage.name)
        )

    def finish(self, metrics: Mapping[str, Any], *, origin: str = "trained") -> Artifact:
        """Writes the manifest, the last file of the stage; `metrics` go to report.json (a success rate as
        {"successes": k, "n": n}). `origin`: "trained", or "loaded" from a checkpoint of another run."""
        return artifacts.finish(
            self.directory, self.stage.name, self.config, seconds=self.progress.seconds, metrics=metrics,
            parents=self.parents.values(), origin=origin,
        )  # fmt: skip


def start_of(config: Config, stage: str) -> dict[str, str]:
    """The checkpoint that `stage` begins with, by its content, since its folder may be filled anew; nothing
    if it begins with none, or none is there any more."""
    if stage not in CHECKPOINTS:
        return {}
    section = getattr(config, stage)
    named = section.init_from if stage != "teacher" else section.start if section.starts_from_file else ""
    found = holding(named, CHECKPOINTS[stage], stage) if named else None
    if found is None:
        return {}
    return {attempts.START: hashlib.sha256((found / CHECKPOINTS[stage]).read_bytes()).hexdigest()[:16]}
