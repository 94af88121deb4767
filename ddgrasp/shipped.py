"""What comes with this project beside its code: `pretrained/`, of a clone or of an installed wheel."""

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
