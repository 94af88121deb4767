"""Where an earlier result is that somebody names: in `pretrained/`, of a clone or of an installed wheel, in a
run, or in a folder of its own."""

from pathlib import Path

NAME = "pretrained"
_IN_WHEEL, _IN_CLONE = Path(__file__).with_name(NAME), Path(__file__).parents[1] / NAME
PRETRAINED = _IN_WHEEL if _IN_WHEEL.is_dir() else _IN_CLONE
"""Checkpoints, a folder each."""


def shipped(path: Path | str) -> Path:
    """`path`; where nothing is there and it begins with `pretrained/`, what comes with this project.

    So `pretrained/teacher` names the same in the top folder of a clone and in any folder of a computer that
    has the wheel alone.
    """
    path = Path(path)
    if path.parts[:1] != (NAME,) or path.exists():
        return path
    return PRETRAINED.joinpath(*path.parts[1:])


def holding(path: Path | str, file: str, stage: str) -> Path | None:
    """The folder with `file`: `path`, or else the folder of `stage` in the run `path`; None without one."""
    source = shipped(path)
    return next((folder for folder in (source, source / stage) if (folder / file).is_file()), None)
