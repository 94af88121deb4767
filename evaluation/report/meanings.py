"""Unit and meaning of every number in a report: one table, looked up by the parts of the number's name."""

import re
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Meaning:
    """What one part of a dotted name says."""

    text: str
    unit: str = ""
    """"%" where the number is a share between 0 and 1; empty for counts and what has no unit."""


SHARE, MS, PX, MM = "%", "ms", "px", "mm"
MEANINGS: dict[str, Meaning] = {
    # success
    "success": Meaning("the object is at the lift target and stays there", SHARE),
    "objects": Meaning("the same, by object"),
    "per_object": Meaning("the same, by object"),
    "student_clean": Meaning("student in its own simulation, depth without errors"),
    "student_ddg": Meaning("student in its own simulation, depth as in training"),
    "student_rig": Meaning("exported student on the simulated rig"),
    "seen": Meaning("objects that it was trained on", SHARE),
    "unseen": Meaning("objects that it was not trained on", SHARE),
    "realtime_trials": Meaning(
        "trials on the real clock, as long as an episode of training, in which time is measured"
    ),
    # teacher
    "saturated_actions": Meaning("joint actions at the end of their range", SHARE),
    "acceleration_p99": Meaning("1 of 100 steps has more, relative to Franka's limit", "of limit"),
    "acceleration_max": Meaning("largest, relative to Franka's limit", "of limit"),
    "jerk_p99": Meaning("1 of 100 steps has more, relative to Franka's limit", "of limit"),
    "jerk_max": Meaning("largest, relative to Franka's limit", "of limit"),
    "gripper_toggles": Meaning("times an episode that the hand opens or closes; 1 is a grasp at first try"),
    "visible_object_pixels_mean": Meaning("of the object before contact, mean", PX),
    "visible_object_pixels_min": Meaning("of the object before contact, fewest", PX),
    "contacts_dropped": Meaning("contacts that physics had no room for"),
    "drop_points": Meaning("success lost against the backend trained on", "points"),
    "seed": Meaning("what random numbers came from"),
    # demos, recordings, depth
    "episodes": Meaning("kept, all successful"),
    "tried_now": Meaning("episodes played to get them"),
    "steps": Meaning("control steps"),
    "curve.steps": Meaning("optimiser steps of the fit"),
    "samplers.frames": Meaning("pictures made, a second"),
    "trajectories": Meaning("recordings"),
    "frames": Meaning("pictures"),
    "training": Meaning("trained on"),
    "held_out": Meaning("kept apart for judging"),
    "skipped": Meaning("left out as unusable"),
    "skipped_frames": Meaning("pictures left out as unusable"),
    "refused_recordings": Meaning("recordings left out as a whole"),
    "static": Meaning("scene and camera at rest"),
    "recorded": Meaning("recorded by the camera, held out"),
    "generated": Meaning("generated for the same scenes"),
    "invalid_fraction": Meaning("pixels without a reading", SHARE),
    "hole_components": Meaning("connected holes in a picture"),
    "hole_median_px": Meaning("half of the holes are smaller", PX),
    "left_band_px": Meaning("width of the band at the left that only one imager sees", PX),
    "flicker_fraction": Meaning("pixels that appear or vanish from one frame to the next", SHARE),
    "temporal_deviation_mm": Meaning("how far a pixel strays over time", MM),
    "temporal_range_mm": Meaning("distance at which that was measured", MM),
    "deviation_median_per_m": Meaning("half of the pixels are nearer the surface, inverse depth", "1/m"),
    "deviation_p99_per_m": Meaning("1 of 100 pixels is further off the surface, inverse depth", "1/m"),
    # student
    "rollout_success": Meaning(
        "episodes that succeeded while it collected frames, in part the teacher's doing", SHARE
    ),
    "position": Meaning("perception's loss on where to grasp"),
    "position_error_mm": Meaning("median distance of the perceived grasp from the true one", MM),
    "yaw": Meaning("perception's loss on the object's angle"),
    "held": Meaning("perception's loss on whether the object is in the hand"),
    "action": Meaning("loss of the actions, through perception"),
    "n_trials": Meaning("trials that had such steps"),
    "horizontal_mm": Meaning("median error in the plane", MM),
    "height_mm": Meaning("median error in height", MM),
    "mean_x_mm": Meaning("mean error away from the base", MM),
    "mean_y_mm": Meaning("mean error to the base's left", MM),
    "mean_z_mm": Meaning("mean error upwards", MM),
    "yaw_deg": Meaning("median error of the angle", "degrees"),
    "held_wrong": Meaning("steps in which it is wrong about whether it holds the object", SHARE),
    # export, deploy
    "max_abs_diff": Meaning("largest difference between JAX's actions and ONNX Runtime's, of their range"),
    "parity_samples": Meaning("pictures that the two were compared on"),
    "file_mb": Meaning("size of the ONNX file", "MB"),
    "sense_ms": Meaning("reading camera and joints", MS),
    "infer_ms": Meaning("policy network", MS),
    "act_ms": Meaning("safety filter and command", MS),
    "export.latency_ms": Meaning("one evaluation of the network, on one thread", MS),
    "latency_ms": Meaning("from a frame to the command that it led to", MS),
    "period_ms": Meaning("from one control step to the next", MS),
    "jitter_ms": Meaning("how far a period is off 100 ms", MS),
    "p50": Meaning("half take no longer"),
    "p99": Meaning("99 of 100 take no longer"),
    "max": Meaning("longest"),
    "missed_deadlines": Meaning("control steps left out since the one before took too long"),
    "holds": Meaning("control steps in which the arm stood still for want of a frame or a state"),
    "safety": Meaning("commands that the safety filter changed"),
    "commands": Meaning("commands in all"),
    "safety.action": Meaning("beyond the action's range"),
    "joint_position": Meaning("beyond a joint's range"),
    "joint_velocity": Meaning("faster than a joint may turn"),
    "joint_acceleration": Meaning("more sudden than a joint may turn"),
    "approach": Meaning("a hand that came down faster than it may"),
    "workspace": Meaning("grip point out of its box"),
    "arm": Meaning("elbow, wrist or hand out of its box"),
    # curves
    "loss": Meaning("training loss"),
    "grad_norm": Meaning("length of the gradient"),
    "head_loss": Meaning("the action head's loss"),
    "pose_loss": Meaning("the action head's loss, trained on true poses"),
    "pose_success": Meaning(
        "success while poses were collected: of the teacher alone at first, of that head alone at last", SHARE
    ),
    "clone_loss": Meaning("loss of imitating the scripted controller"),
    "control_steps": Meaning("control steps so far", "steps"),
    "minutes": Meaning("time so far", "min"),
    "seconds": Meaning("time", "s"),
    "steps_per_s": Meaning("control steps a second", "1/s"),
    "eval_success": Meaning("success without exploration", SHARE),
    "eval_saturated": Meaning("joint actions at the end of their range, without exploration", SHARE),
    "saturated": Meaning("joint actions at the end of their range", SHARE),
    "lost": Meaning("episodes that ended before their time", SHARE),
    "blown_up": Meaning("states that were not finite, and were put back"),
    "episode": Meaning("episode"),
    "length": Meaning("control steps", "steps"),
    "return": Meaning("sum of its rewards"),
    "reward": Meaning("part of the reward, a step's mean"),
    "gradient": Meaning("length of the gradient"),
    "policy_loss": Meaning("PPO's clipped objective"),
    "v_loss": Meaning("the value network's"),
    "entropy_loss": Meaning("for exploring"),
    "total_loss": Meaning("all of it"),
    "policy": Meaning("of the policy"),
    "value": Meaning("of the value network"),
    "clip_fraction": Meaning("samples at which PPO's clipping acts", SHARE),
    "kl": Meaning("distance to the policy before the update", "nats"),
    "learning_rate": Meaning("step size"),
    "std": Meaning("spread of the actions tried"),
    "value.max": Meaning("most that it promises, scaled reward to come"),
    "explained_variance": Meaning("share of the returns' variance that it foresees", SHARE),
    # scores
    "sampler": Meaning("how many times the network is evaluated"),
}


def explain(name: str) -> tuple[str, str]:
    """(unit, meaning) of a number of that name, "deploy.sense_ms.p50" or "loss/v_loss": what its parts say,
    from left to right, and the unit of the last part that has one. Both empty if no part is known. What a
    part means behind another one ("export.latency_ms") comes first."""
    parts = re.split(r"[./]", name)
    names = [(f"{before}.{part}", part) for before, part in zip(["", *parts], parts, strict=False)]
    found = (next((key for key in keys if key in MEANINGS), None) for keys in names)
    known = [MEANINGS[key] for key in found if key]
    unit = next((meaning.unit for meaning in reversed(known) if meaning.unit), "")
    return unit, ": ".join(dict.fromkeys(meaning.text for meaning in known))


def show(value: Any, unit: str) -> str:
    """A number as people read it, with its unit."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return "" if value is None else str(value)
    if unit == SHARE:
        return f"{100 * value:.3g} %"
    number = f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
    return f"{number} {unit}".rstrip()
