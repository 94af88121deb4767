"""Deployments and recorded trials, folders of steps and pictures, as episodes."""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from app.lerobot.episode import Episode, Picture, Source
from app.lerobot.steps import BY_POLICY
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.files import DAMAGED_JSON
from ddgrasp.gripper import CLOSE
from ddgrasp.layout import ACTION, STATE
from deploy.record import STEPS_FILE
from evaluation.report.deployments import Deployment
from evaluation.treatments import RECORDED
from sensors.recordings.recording import Recording, is_recording

OBJECT = "object"
"""Where a report names what was to be grasped."""
_NEEDED = ("q_rad", "width_m", "action")
Sizes = tuple[tuple[int, ...], tuple[int, ...]]
"""Shapes of an episode's depth and colour."""
OPEN = -1.0
"""The gripper's command before the first action: the hand starts open."""


def read(found: Sequence[Deployment], objects: Sequence[str] = (), most: int = 0) -> Source:
    """Those of `found` that can be used as episodes; the others are named with the reason.

    With `objects` only those whose report names one of them; the first `most`, 0 for all. Raises UserError if
    none is left, or two have pictures of different sizes.
    """
    if objects:
        noted = {str(deployment.report.get(OBJECT, "")) for deployment in found} - {""}
        if unknown := next((name for name in objects if name not in noted), None):
            raise unknown_name("object", unknown, noted)
        found = [deployment for deployment in found if deployment.report.get(OBJECT) in objects]
    taken, episodes, left_out, sizes = [], [], [], {}
    for deployment in found:
        if most and len(taken) == most:  # what is said of them is of these alone
            break
        try:
            episode = _read(deployment, _pictures(deployment))
            sizes.setdefault(_sizes(episode), episode.name)
            episodes.append(partial(_as_it_is, episode))
            taken.append(deployment)
        except UserError as error:
            left_out.append(f"{deployment.folder.name}: {error}")
    if not taken:
        raise UserError(f"{found[0].folder.parent}: no episode can be used ({'; '.join(left_out)}).")
    _check_one_size(sizes)
    about = {
        "Robot": f"Franka arm; driver or rig: {_each(taken, 'robot')}.",
        "Camera": "; ".join(dict.fromkeys(_seen(deployment) for deployment in taken)) + ".",
        "How it was made": f"A depth-only policy ({_each(taken, 'policy')}) moved the arm, and at times the "
        "control loop's rules for trying again in its place (deploy/retry.py). `action` is what either asked "
        f"for, before the safety filter, or what a slow arm lacked of that; `{BY_POLICY}` says where it is "
        "the policy's. Success is what the rig knows or a person answered.",
    }
    return Source("deployments", "franka", about, episodes, left_out)


def _sizes(episode: Episode) -> Sizes:
    depth_mm, rgb = next(iter(episode.pictures()))
    return depth_mm.shape, () if rgb is None else rgb.shape


def _check_one_size(sizes: Mapping[Sizes, str]) -> None:
    """UserError for more than one of `sizes` (-> an episode that has it): a dataset has one, and all episodes
    before the first of another size would be encoded in vain."""
    (first, one), *others = sizes.items()
    if others:
        other, another = others[0]
        raise UserError(
            f"{another} has depth of {other[0]} and colour of {other[1]}, {one} of {first[0]} and "
            f"{first[1]}: a dataset has one size; put each into a folder of its own."
        )


def _as_it_is(episode: Episode) -> Episode:
    return episode


def _each(deployments: Sequence[Deployment], key: str) -> str:
    return ", ".join(dict.fromkeys(str(deployment.report.get(key, "unknown")) for deployment in deployments))


def _seen(deployment: Deployment) -> str:
    """The camera, and what its depth is."""
    camera, depth = deployment.report.get("camera", "unknown"), deployment.report.get("depth", RECORDED)
    if depth != RECORDED:
        return f"{camera}, across the table; its depth is what the policy saw, treated: {depth}"
    kind = "clean, without a camera's errors" if "ideal" in camera else "raw, with its holes and noise"
    return f"{camera}, across the table; its depth is {kind}"


def _pictures(deployment: Deployment) -> Recording:
    """One for every step. UserError with the reason where it is no episode."""
    report = deployment.report
    if not isinstance(report.get("frames"), int):
        raise UserError("its report.json does not say how many pictures there are (frames)")
    if not deployment.is_driven:
        raise UserError("a dry run: the arm did not do what its steps say")
    if report["success"] is None:
        raise UserError('nobody judged it: set "success" in its report.json')
    if not report["steps"] or report["frames"] != report["steps"]:
        lacks = f"{report['frames']} pictures for {report['steps']} steps"
        raise UserError(f"{lacks}: on a rig deploy with --deploy.film-every 1")
    if not is_recording(deployment.folder):
        raise UserError("its pictures are gone")
    recording = Recording.open(deployment.folder)
    if recording.skipped:
        raise UserError(recording.skipped_summary())
    return recording


def _read(deployment: Deployment, recording: Recording) -> Episode:
    folder = deployment.folder
    rows = _steps(folder / STEPS_FILE)
    if len(recording) != len(rows):
        raise UserError(
            f"{folder} is damaged ({len(recording)} pictures for {len(rows)} steps): move it elsewhere."
        )

    def pictures() -> Iterator[Picture]:
        for rgb, depth_mm in recording.frames():
            yield depth_mm, rgb

    return Episode(
        name=folder.name,
        object_name=str(deployment.report.get(OBJECT, "")),
        success=bool(deployment.report["success"]),
        state=states(rows),
        action=actions(rows),
        pictures=pictures,
        held=np.array([row["action"] is None for row in rows]),
        by=[row.get("by") or "" for row in rows],  # steps of before 2026-11-28 have none
        missed=int(deployment.report.get("missed_deadlines", 0)),
        color_aligned=recording.color_aligned,
    )


def _steps(path: Path) -> list[dict[str, Any]]:
    """The lines of a steps.jsonl. Raises UserError for a damaged one."""
    try:
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        if lacking := next((name for row in rows for name in _NEEDED if name not in row), ""):
            raise ValueError(f"a step lacks {lacking}")
    except (*DAMAGED_JSON, OSError, TypeError) as error:
        raise UserError(f"{path} is damaged ({error}): move its folder elsewhere.") from None
    return rows


def states(rows: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """(T, 8) float32 joints (rad) and opening (m). Raises UserError for a step of which the robot told no
    whole state: the loop held the arm there, and a dataset has no room for what is not known."""
    told = [[*_listed(row["q_rad"]), row["width_m"]] for row in rows]
    for step, state in enumerate(told):
        if not _are_numbers(state, STATE.size):
            raise UserError(f"in step {step} the robot told no whole state (seven joints and the opening)")
    return np.array(told, np.float32).reshape(-1, STATE.size)


def actions(rows: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """(T, 8) float32; a step that was held is what holding does: no joint step, the gripper as before.

    Raises UserError for an action of another size.
    """
    made = np.zeros((len(rows), ACTION.size), np.float32)
    gripper = OPEN
    for step, (action, row) in enumerate(zip(made, rows, strict=True)):
        if row["action"] is not None:
            if not _are_numbers(_listed(row["action"]), ACTION.size):
                raise UserError(
                    f"in step {step} the action is {row['action']!r}; expected {ACTION.size} numbers"
                )
            action[:] = row["action"]
            gripper = action[ACTION.gripper.start]
        if "close" in row:  # the fingers wait for a slow hand
            gripper = CLOSE if row["close"] else OPEN
        action[ACTION.gripper] = gripper
    return made


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _are_numbers(values: Sequence[Any], count: int) -> bool:
    return len(values) == count and all(isinstance(value, int | float) for value in values)
