"""What a student perceives on the development rig beside the truth, while its exported file acts.

Nobody looks at this on a robot: the truth is the rig's. It says whether a lost grasp is perception's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, UInt16

from ddgrasp import artifacts
from ddgrasp.config import Config
from ddgrasp.depth import to_millimetres
from ddgrasp.errors import UserError
from ddgrasp.layout import OBSERVATION
from ddgrasp.policy_metadata import POLICY_FILE
from ddgrasp.progress import Progress
from deploy.changes import Change
from deploy.trials import Rig
from evaluation.failure_modes import LIFTED_M, MOVED_M
from evaluation.rig_trials import Series
from rig.world import RigWorld

if TYPE_CHECKING:
    from student_jax.policy import Aux

FAR_M, NEAR_M = 0.15, 0.08
"""Distance of hand and grasp beyond which the hand is far, and within which it is near."""


@dataclass
class Seen:
    """What one trial's policy was given and what was true then, a row a control step."""

    depth: list[UInt16[np.ndarray, "3 H W"]] = field(default_factory=list)
    state: list[Float[np.ndarray, "9"]] = field(default_factory=list)
    observation: list[Float[np.ndarray, "40"]] = field(default_factory=list)
    grasped: list[bool] = field(default_factory=list)
    """Whether both fingers had the object, as training's label has it."""
    symmetry: int = 2
    """Yaws in a turn by which the object is grasped alike; 0: any."""


def measure(
    config: Config, run_dir: Path, series: Series, change: Change, progress: Progress
) -> list[dict[str, Any]]:
    """Rows of `tabulate`, with the policy in `run_dir`/export acting on the rig with that `change`, whatever
    camera `series` names.

    Raises UserError where the run has no exported policy, or that of an earlier student.
    """
    from student_jax.act import perceive
    from student_jax.policy import load

    exported, student = (artifacts.read_artifact(run_dir / name) for name in ("export", "student"))
    if exported.manifest.parents.get("student", student.hash) != student.hash:
        raise UserError(
            f"{exported.directory} is of an earlier student: delete it, `ddgrasp export` it again."
        )
    policy = exported.directory / POLICY_FILE
    config = series.configured(config, policy)
    rig = Rig(config, policy, change)
    _, params = load(run_dir)
    outcomes, parts = [], []
    plan = series.plan()
    with progress.task("perception", len(plan)) as task:
        for trial in plan:
            seen = Seen()
            rig.watch_policy(partial(_keep, seen))
            result, _ = rig.run(trial)
            outcomes.append(result.success)
            frames = np.stack(seen.depth), np.stack(seen.state)
            parts.append(errors(seen, perceive(config.student, config.world.profile, params, *frames)))
            task.advance(success=sum(outcomes) / len(outcomes))
    return tabulate(parts, outcomes, [trial.object_name for trial in plan])


def _keep(seen: Seen, depth: np.ndarray, state: np.ndarray, world: RigWorld) -> None:
    seen.depth.append(depth if depth.dtype == np.uint16 else to_millimetres(depth))
    seen.state.append(state)
    seen.observation.append(world.observation())
    seen.grasped.append(world.grasped())
    seen.symmetry = world.grasp_symmetry


@dataclass(frozen=True)
class Errors:
    """What perception was off by in the T steps of a trial, and where the hand was."""

    away_m: Float[np.ndarray, "T 3"]
    """Perceived minus true position of the grasp, in the robot's frame."""
    yaw_rad: Float[np.ndarray, " T"]
    """The grasp's, without sign, from the nearest of those that are as good; NaN where any is."""
    held: Float[np.ndarray, " T"]
    """Perceived probability that the object is in the hand."""
    distance_m: Float[np.ndarray, " T"]
    """From the hand to the grasp."""
    touched: Bool[np.ndarray, " T"]
    grasped: Bool[np.ndarray, " T"]
    """What `held` is to be, before the object is carried."""
    carried: Bool[np.ndarray, " T"]


def errors(seen: Seen, aux: "Aux") -> Errors:
    """What `aux` is off by."""
    from student_jax.data import YAW_MULTIPLE, aux_targets
    from student_jax.policy import position_to_world

    observation = np.stack(seen.observation)
    lay, at = observation[0, OBSERVATION.object_pos], observation[:, OBSERVATION.object_pos]
    truth = aux_targets(observation, np.zeros(len(at), bool))
    away = np.asarray(position_to_world(aux.position)) - observation[:, OBSERVATION.grasp_pos]
    turn = np.arctan2(aux.yaw[:, 1], aux.yaw[:, 0]) - np.arctan2(truth.yaw[:, 1], truth.yaw[:, 0])
    to_grasp = observation[:, OBSERVATION.grip_pos] - observation[:, OBSERVATION.grasp_pos]
    return Errors(
        away_m=away,
        yaw_rad=_off(turn / YAW_MULTIPLE, seen.symmetry),
        held=1 / (1 + np.exp(-aux.held_logit)),
        distance_m=np.linalg.norm(to_grasp, axis=1),
        grasped=np.array(seen.grasped),
        touched=np.maximum.accumulate(np.linalg.norm(at - lay, axis=1) > MOVED_M),
        carried=at[:, 2] - lay[2] > LIFTED_M,
    )


def _off(turn_rad: Float[np.ndarray, " T"], symmetry: int) -> Float[np.ndarray, " T"]:
    """How far `turn_rad` is from no turn, or from the nearest by which the object is grasped as well."""
    if symmetry == 0:
        return np.full(len(turn_rad), np.nan)
    return np.abs(np.angle(np.exp(1j * symmetry * turn_rad))) / symmetry


def tabulate(parts: Sequence[Errors], success: Sequence[bool], names: Sequence[str]) -> list[dict[str, Any]]:
    """A row for each part of a trial: of all trials, of those that succeeded, of those that did not, and for
    each object of the steps with the hand near. `success` and `names` are the trials' outcomes and objects;
    `n_trials` is of how many trials a row is, those that had such steps.

    Position (mm): medians without sign, in the plane and in height, and means with it, x away from the base,
    y to its left, z up. Yaw (degrees): median, of objects that have one. Held: share of steps told wrongly.
    """
    groups = {"all": list(parts)}
    for title, wanted in (("success", True), ("failure", False)):
        groups[title] = [part for part, well in zip(parts, success, strict=True) if well == wanted]
    for name in dict.fromkeys(names):
        groups[name] = [part for part, of in zip(parts, names, strict=True) if of == name]
    rows = []
    for title, chosen in groups.items():
        for hand, steps in _PHASES.items():
            where = [steps(part) for part in chosen]
            if any(w.any() for w in where) and (hand == "near" or title not in names):
                row = {"trials": title, "n_trials": sum(bool(w.any()) for w in where), "hand": hand}
                rows.append(row | _row(chosen, where))
    return rows


_PHASES: dict[str, Callable[[Errors], np.ndarray]] = {
    "far": lambda part: ~part.touched & (part.distance_m > FAR_M),
    "near": lambda part: ~part.touched & (part.distance_m < NEAR_M),
    "carried": lambda part: part.carried,
}


def _median_deg(yaw_rad: Float[np.ndarray, " N"]) -> float | None:
    told = yaw_rad[~np.isnan(yaw_rad)]
    return round(float(np.degrees(np.median(told))), 1) if len(told) else None


def _row(parts: Sequence[Errors], where: Sequence[np.ndarray]) -> dict[str, Any]:
    def of(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name)[w] for part, w in zip(parts, where, strict=True)])

    away = 1e3 * of("away_m")
    x, y, z = (round(float(value), 1) for value in away.mean(axis=0))
    return {
        "steps": len(away),
        "horizontal_mm": round(float(np.median(np.linalg.norm(away[:, :2], axis=1))), 1),
        "height_mm": round(float(np.median(np.abs(away[:, 2]))), 1),
        "mean_x_mm": x,
        "mean_y_mm": y,
        "mean_z_mm": z,
        "yaw_deg": _median_deg(of("yaw_rad")),
        "held_wrong": round(float(np.mean((of("held") > 0.5) != (of("carried") | of("grasped")))), 3),
    }
