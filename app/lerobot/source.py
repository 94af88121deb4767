"""Finds out what kind of episodes a folder holds."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from app.lerobot import demonstrations, deployments
from app.lerobot.episode import Source
from ddgrasp.errors import UserError
from evaluation.report.deployments import find
from evaluation.rig_trials import EPISODES


def open_source(path: Path, objects: Sequence[str] = (), noisy: Path | None = None, most: int = 0) -> Source:
    """The episodes at `path`, those with `objects` alone if any are named, the first `most`, or all if that
    is 0; `noisy`: generated depth for them.

    Raises:
      UserError: there are none, none with these objects, what is there is damaged, or `noisy` is not theirs.
    """
    if (stage := demonstrations.find(path)) is not None:
        source = demonstrations.read(stage, objects, noisy)
        return replace(source, episodes=source.episodes[:most]) if most else source
    if noisy is not None:
        raise UserError(f"--noisy goes with demonstrations, and {path} has none: leave it out.")
    if found := find(path) or find(path / EPISODES):  # of trials tried with --record
        return deployments.read(found, objects, most)
    raise UserError(
        f"{path} has neither demos/episodes.zarr nor deployments: give a run (runs/demo), a folder of "
        "deployments (runs/deployments), or of trials that were tried with --record."
    )
