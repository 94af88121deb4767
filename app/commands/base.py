"""What commands have in common, and how their defaults are found."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Protocol

import tyro

from app import pipeline
from app.commands.checks import check_config_values, tell_needs
from ddgrasp import artifacts
from ddgrasp.config import Config
from ddgrasp.stages import get_stage

DEFAULT_PRESET = "demo"


def say(text: str) -> None:
    """Prints a line at once: a pipe or a file would have it when the buffer is full, or at the end."""
    print(text, flush=True)


class Command(Protocol):
    """What a parsed command line is."""

    def run(self) -> None:
        """Does the work; raises UserError for wrong input."""
        ...


@dataclass(frozen=True)
class FromPreset:
    """A command whose options are those of a preset, each of which can be given on its own."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    """Values of the preset; any of them can be given on its own, for example --seed 1."""
    out: Path
    """Directory of the run: what is needed of it is read there, and what is made becomes a folder there. Give
    every stage of a run the same --preset, --config and values."""
    resume: bool = False
    """Continue what is there; finished stages are not redone."""
    config_file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """YAML file to take instead of --preset: a preset's name and what differs from it, or all settings, as in
    `config.yaml` of any run. Single values can be given besides."""

    @classmethod
    def default_preset(cls) -> str:
        """Which one without --preset."""
        return DEFAULT_PRESET

    @classmethod
    def default_out(cls, preset: str) -> Path:
        """Where it goes without --out."""
        return Path("runs") / preset


class OneStage(FromPreset):
    """A command that makes one stage of a run."""

    stage: str

    def run(self) -> None:
        """Says what memory the stage will take and makes it from its finished parents in the run."""
        stage = get_stage(self.stage)
        pipeline.check_place(self.config, self.out, resume=self.resume, stages=[stage])
        config = check_config_values(self.config, self.out)
        for name in stage.parents:
            artifacts.require(self.out, name, config)
        tell_needs(config, self.out, (stage.name,))
        pipeline.make(stage, config, self.out, resume=self.resume)


def load_config(run_dir: Path, stage: str) -> Config:
    """The configuration that made the finished `stage` of a run."""
    return artifacts.config_from_json(artifacts.read_manifest(run_dir / stage).config)
