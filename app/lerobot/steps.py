"""What every step of a dataset has, and how LeRobot calls it."""

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np

from app.lerobot.episode import Episode
from ddgrasp.layout import ACTION, STATE

CAMERA = "front"
"""What LeRobot calls a camera that looks at the robot."""
COLOUR, DEPTH = f"observation.images.{CAMERA}", f"observation.images.{CAMERA}_depth"
STATE_KEY, ACTION_KEY = "observation.state", "action"
DONE, SUCCESS = "next.done", "next.success"
BY_POLICY, POSE = "by_policy", "camera.T_world_cam"
"""No `observation` in front, nor `action`: that would make them inputs or outputs of LeRobot's policies."""
JOINTS = tuple(f"joint{i}" for i in range(1, 8))
STATE_NAMES = [*(f"{joint}.pos" for joint in JOINTS), "gripper.width"]
ACTION_NAMES = [*(f"{joint}.delta" for joint in JOINTS), "gripper.close"]

Storage = Literal["video", "images"]
Features = dict[str, dict[str, Any]]


def features(
    depth: tuple[int, int], colour: tuple[int, int] | None, pose: bool, storage: Storage, by: bool = False
) -> Features:
    """Key -> type, shape and names, as `LeRobotDataset.create` takes them.

    Args:
      depth: rows and columns.
      colour: rows and columns; None without colour.
      pose: whether the camera's pose is known.
      storage: pictures as videos, or an image file for every step.
      by: whether a loop drove, in which not every action is the policy's.
    """
    picture = {"dtype": "video" if storage == "video" else "image", "names": ["height", "width", "channels"]}
    flag = {"dtype": "bool", "shape": (1,), "names": None}
    made = {
        STATE_KEY: {"dtype": "float32", "shape": (STATE.size,), "names": STATE_NAMES},
        ACTION_KEY: {"dtype": "float32", "shape": (ACTION.size,), "names": ACTION_NAMES},
        DEPTH: {**picture, "shape": (*depth, 1), "info": {"is_depth_map": True, "depth_unit": "mm"}},
    }
    if colour is not None:
        made[COLOUR] = {**picture, "shape": (*colour, 3), "info": {"is_depth_map": False}}
    if pose:
        made[POSE] = {"dtype": "float32", "shape": (4, 4), "names": None}
    if by:
        made[BY_POLICY] = dict(flag)
    return {**made, DONE: flag, SUCCESS: dict(flag)}


def frames(episode: Episode, task: str) -> Iterator[dict[str, Any]]:
    """What `LeRobotDataset.add_frame` takes, step after step."""
    last = len(episode.state) - 1
    steps = zip(episode.state, episode.action, episode.pictures(), strict=True)
    for step, (state, action, (depth_mm, rgb)) in enumerate(steps):
        frame = {
            "task": task,
            STATE_KEY: state,
            ACTION_KEY: action,
            DEPTH: depth_mm[..., None],
            DONE: np.array([step == last]),
            SUCCESS: np.array([step == last and episode.success]),
        }
        if rgb is not None:
            frame[COLOUR] = rgb
        if episode.by is not None:
            frame[BY_POLICY] = np.array([episode.by[step] == "policy"])
        if episode.T_world_cam is not None:
            frame[POSE] = episode.T_world_cam
        yield frame
