"""Jobs for tests that call a stage's `run` as the pipeline would."""

from pathlib import Path
from typing import Any

from ddgrasp import artifacts
from ddgrasp.config import Config
from ddgrasp.job import Job
from ddgrasp.progress import Progress
from ddgrasp.stages import get_stage


def make_job(
    stage: str, config: Config, directory: Path, progress: Progress | None = None, **inputs: Any
) -> Job:
    """A job in `directory`; its parents lie beside it, unless `inputs` take their place."""
    directory.mkdir(parents=True, exist_ok=True)
    parents = {}
    if not inputs:
        names = get_stage(stage).parents
        parents = {name: artifacts.require(directory.parent, name, config) for name in names}
    return Job(get_stage(stage), config, directory, progress or Progress(quiet=True), parents, inputs)
