"""Writes episodes as a LeRobot dataset, format v3, with the package `lerobot` itself."""

import contextlib
import importlib
import os
import platform
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from app.lerobot import card
from app.lerobot.card import Contents
from app.lerobot.episode import Episode, Source
from app.lerobot.steps import COLOUR, DEPTH, Features, Storage, features, frames
from ddgrasp import contract
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_text, new_folder
from ddgrasp.install import pip_install
from ddgrasp.progress import Progress

FARTHEST_MM = 4095
"""LeRobot's depth videos have 12 bits; spread evenly over so many millimetres, each value is one of them."""


def write(
    source: Source, out: Path, *, storage: Storage, task: str, licence: str, command: str, progress: Progress
) -> Contents:
    """Makes the dataset `out` of all episodes of `source`; it appears there once it is whole.

    Args:
      source: the episodes.
      out: folder that does not exist yet.
      storage: pictures as videos, or an image file for every step, which takes more room.
      task: sentence for every episode; empty takes each episode's own.
      licence: identifier for the card.
      command: what the user typed, for the card.
      progress: shows a bar.

    Raises:
      UserError: `out` exists, lerobot is absent or too old, an episode is damaged or has other sizes.
    """
    check_free(out)
    library = load_lerobot()
    with new_folder(out) as folder:
        with _Writer(library, source.robot, folder, out.name, storage) as writer:
            for read in progress.track(source.episodes, "episodes"):
                episode = read()
                writer.add(episode, task or episode.task)
        contents = writer.contents
        _note_outcomes(folder, contents.outcomes)
        shutil.rmtree(folder / "images", ignore_errors=True)  # where pictures waited: empty now
        text = card.render(source, contents, name=out.name, storage=storage, licence=licence, command=command)
        atomic_write_text(folder / "README.md", text)
    return contents


def check_free(out: Path) -> None:
    """UserError if there is something at `out` already."""
    if os.path.lexists(out):
        raise UserError(f"{out} exists: choose another --out, or delete it.")


def load_lerobot() -> Any:
    """The package with its datasets and configs. Raises UserError if it is absent or too old."""
    try:
        library = importlib.import_module("lerobot")
        for name in ("lerobot.datasets", "lerobot.configs"):
            importlib.import_module(name)
        if not hasattr(library.configs, "DepthEncoderConfig"):
            raise ImportError("this one knows no depth")
        _silence()
    except ImportError as error:
        here, remedy = platform.python_version(), pip_install("lerobot")
        if sys.version_info < (3, 12):  # the extra is empty there
            remedy = f"this is {here}; make an environment of a newer one (`make setup PYTHON=python3.12`)"
        raise UserError(
            f"LeRobot datasets need lerobot 0.6 or newer, on Python 3.12 or newer ({error}): {remedy}."
        ) from error
    return library


def _silence() -> None:
    """Nothing is drawn or told for every episode: progress bars, encoders."""
    importlib.import_module("datasets").disable_progress_bars()
    os.environ.setdefault("SVT_LOG", "1")
    logging = importlib.import_module("av.logging")
    logging.set_libav_level(logging.ERROR)


class _Writer:
    """An open dataset; it is made when the first episode says how large pictures are."""

    def __init__(self, library: Any, robot: str, folder: Path, name: str, storage: Storage):
        self._library, self._robot = library, robot
        self._storage: Storage = storage
        self._folder, self._name = folder, name
        self._dataset: Any = None
        self._features: Features = {}
        self.contents = Contents()

    def __enter__(self) -> "_Writer":
        return self

    def __exit__(self, kind: Any, value: Any, traceback: Any) -> None:
        if self._dataset is None:
            return
        # Also after an error: else it would write what it still holds into a folder that is gone by then.
        with contextlib.suppress(Exception) if kind else contextlib.nullcontext():
            self._dataset.finalize()

    def add(self, episode: Episode, task: str) -> None:
        self._open(episode)
        farther = 0
        for frame in frames(episode, task):
            if self._storage == "video":
                far = frame[DEPTH] > FARTHEST_MM
                farther += int(np.count_nonzero(far))
                frame[DEPTH] = np.where(far, np.uint16(FARTHEST_MM), frame[DEPTH])
            self._dataset.add_frame(frame)
        # Not side by side: that forks a process in which threads of other libraries may hold locks.
        self._dataset.save_episode(parallel_encoding=False)
        self.contents.count(episode, farther)

    def _open(self, episode: Episode) -> None:
        """Makes the dataset for the first episode; UserError if a later one has pictures of another size."""
        described = _described(episode, self._storage)
        if self._dataset is None:
            self._dataset, self._features = self._create(described), described
            self.contents.keys = tuple(described)
        elif described != self._features:
            sizes = [
                {key: form[key]["shape"] for key in (DEPTH, COLOUR) if key in form}
                for form in (described, self._features)
            ]
            raise UserError(
                f"{episode.name} has pictures of {sizes[0]}, those before it of {sizes[1]}: a dataset has "
                "one size; put each into a folder of its own."
            )

    def _create(self, described: Features) -> Any:
        depth_encoder = self._library.configs.DepthEncoderConfig(
            depth_min=0.0,
            depth_max=FARTHEST_MM * contract.DEPTH_UNIT_M,
            use_log=False,
            extra_options={"x265-params": "lossless=1:log-level=none"},
        )
        return self._library.datasets.LeRobotDataset.create(
            repo_id=self._name,
            root=self._folder,
            fps=round(contract.CONTROL_HZ),
            features=described,
            robot_type=self._robot,
            use_videos=self._storage == "video",
            depth_encoder=depth_encoder,
        )


def _note_outcomes(folder: Path, outcomes: Sequence[bool]) -> None:
    """Adds a column `success` to the table of episodes, by which they can be chosen."""
    pyarrow, parquet = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    for path in (folder / "meta" / "episodes").rglob("*.parquet"):
        table = parquet.read_table(path)
        column = [outcomes[index] for index in table["episode_index"].to_pylist()]
        parquet.write_table(table.append_column("success", pyarrow.array(column)), path)


def _described(episode: Episode, storage: Storage) -> Features:
    depth_mm, rgb = next(iter(episode.pictures()))
    rows, columns = depth_mm.shape
    colour = None if rgb is None else (rgb.shape[0], rgb.shape[1])
    pose, by = episode.T_world_cam is not None, episode.by is not None
    return features((rows, columns), colour, pose, storage, by)
