"""What an installation lacks, in one line: which extra of pyproject.toml brings what is not there."""

import importlib.metadata
import re
from importlib.util import find_spec

from ddgrasp.errors import UserError
from ddgrasp.install import PROJECT, pip_install

OTHERWISE_NAMED = {
    "cv2": "opencv-python-headless",
    "franky": "franky-control",
    "mujoco_playground": "playground",
    "orbax": "orbax-checkpoint",
    "rerun": "rerun-sdk",
    "sklearn": "scikit-learn",
    "warp": "warp-lang",
    "yaml": "pyyaml",
}
"""Import name -> name on the package index, where they differ by more than a hyphen."""
TRAIN = "train"
NEEDS: dict[str, tuple[str, ...]] = {
    "play": ("sim",),
    "deploy trials": ("sim",),
    "objects list": ("sim",),
    "rig fr3": ("fr3",),
    "rig pictures": ("fr3",),
    "record fr3": ("fr3",),
    "calibrate": ("franka", "realsense"),
    "calibrate board": ("franka", "realsense"),
    "record realsense": ("realsense",),
    "record import": (),
    "deploy": (),
}
"""Command -> the extras without which it never works; all others need TRAIN. What an option needs besides is
told when its module is imported."""
TELLS = {"sim": "mujoco", "realsense": "cv2", "franka": "scipy", "fr3": "trimesh", TRAIN: "jax"}
"""Extra -> a module that it brings, and that commands which need it import."""
_REQUIREMENT = re.compile(r"""(?P<name>[\w.-]+)[^;]*;.*\bextra == ['"](?P<extra>[\w-]+)['"]""")


def distribution(module: str) -> str:
    """The package index's name of what `module` is a part of."""
    top = module.partition(".")[0]
    return OTHERWISE_NAMED.get(top, top.replace("_", "-"))


def bringing(module: str) -> list[str]:
    """The extras of the installed project that name what brings `module`, dev's own aside."""
    found = map(_REQUIREMENT.match, importlib.metadata.requires(PROJECT) or ())
    wanted = distribution(module).lower()
    return [m["extra"] for m in found if m and m["name"].lower() == wanted and m["extra"] != "dev"]


def check(command: str) -> None:
    """UserError if the extras that `command` needs are not installed."""
    needed = NEEDS.get(command, (TRAIN,))
    if any(find_spec(TELLS[extra]) is None for extra in needed):
        more = pip_install(",".join(needed))
        raise UserError(f"`ddgrasp {command}` needs more than is installed: {more}.")


def remedy(missing: str | None) -> str | None:
    """One line for an absent module of that name; None if no extra brings it."""
    if not missing or not (extras := bringing(missing)):
        return None
    return f"{distribution(missing)} is not installed: {' or '.join(map(pip_install, extras))}."
