"""Where the camera stands beside where the policy was trained to see from: what deploy says and records."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from ddgrasp import contract
from ddgrasp.config import Config, RandomConfig
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_json, read_json
from deploy.devices.options import SessionOptions
from mjx_envs.camera import look_at

DEFAULT_FILE = Path("runs/calibration/calibration.json")
"""Where `ddgrasp calibrate` writes and `ddgrasp deploy` looks."""
VERSION = 1
_MOVES = (
    ("towards the robot", "away from the robot"),
    ("to the robot's right", "to the robot's left"),
    ("down", "up"),
)
"""What brings the camera back whose shift along base x, y, z is positive, negative."""
_TURNS = (("down", "up"), ("to its left", "to its right"), ("anticlockwise", "clockwise"))
"""The same for turns about the camera's own x (right), y (down), z (forward)."""


@dataclass(frozen=True)
class Calibration:
    """What was measured, of which camera and robot."""

    created: str
    """ISO 8601."""
    camera: str
    """As `--camera` names it."""
    host: str
    """Address of the robot's control unit."""
    T_base_cam: Float64[np.ndarray, "4 4"]
    """(4, 4) pose of the camera that measures depth (left imager) in the robot's base frame, metres."""
    rms_px: float
    """Reprojection error."""
    serial: str = ""
    """The camera's, where it has one; empty of files of before 2026-11-30."""
    details: dict[str, Any] = field(default_factory=dict)
    """Board, views, standard errors; for people and for a later look."""


@dataclass(frozen=True)
class Offset:
    """A camera beside the place that training assumes."""

    shift_m: Float64[np.ndarray, "3"]
    """(3,) along the robot's base axes: x away from it, y to its left, z up."""
    turn_rad: Float64[np.ndarray, "3"]
    """(3,) rotation vector about the nominal camera's own axes: x right, y down, z forward."""

    @property
    def distance_m(self) -> float:
        """Length of the shift."""
        return float(np.linalg.norm(self.shift_m))

    @property
    def angle_rad(self) -> float:
        """Size of the turn."""
        return float(np.linalg.norm(self.turn_rad))


@dataclass(frozen=True)
class Standing:
    """What is known of the camera's place in a session; all empty where there is nothing to know."""

    line: str = ""
    calibration: Calibration | None = None
    offset: Offset | None = None
    trained_for: bool | None = None
    """Whether every axis is within what training draws; None without a calibration."""

    def as_dict(self) -> dict[str, Any] | None:
        """For the deployment's record; None without a calibration."""
        if self.calibration is None or self.offset is None:
            return None
        c, o = self.calibration, self.offset
        return {
            "created": c.created, "T_base_cam": c.T_base_cam.tolist(), "rms_px": c.rms_px,
            "shift_m": o.shift_m.tolist(), "turn_rad": o.turn_rad.tolist(), "trained_for": self.trained_for,
        }  # fmt: skip


def offset(T_base_cam: Float[np.ndarray, "4 4"], T_reference: Float[np.ndarray, "4 4"]) -> Offset:
    """From `T_reference` to `T_base_cam`, as `mjx_envs.draws.displaced` would move it."""
    from scipy.spatial.transform import Rotation  # of the extra franka, as all that calibrates

    turn = Rotation.from_matrix(T_reference[:3, :3].T @ T_base_cam[:3, :3]).as_rotvec()
    return Offset(np.asarray(T_base_cam[:3, 3] - T_reference[:3, 3], float), np.asarray(turn, float))


def standing(config: Config, options: SessionOptions, trained: Mapping[str, Any] | None = None) -> Standing:
    """What deploy says of its camera. `trained`: the policy file's camera (`PolicyMetadata.camera`).

    Raises UserError for a file that is named and does not fit.
    """
    if not options.real:
        return Standing()
    spread, place = config.world.random, _place(trained or {})
    path = options.calibration or DEFAULT_FILE
    if options.calibration is None and not path.exists():
        return Standing(_assumed("not calibrated", place, spread))
    found, host = load(path), config.deploy.franka.host
    camera = "rig" if options.camera == "rig-ideal" else options.camera
    serial = named_serial(config, camera)
    if not _is_of(found, camera, host, serial):
        unlike = f"{path} is of camera {_numbered(found.camera, found.serial)} and the robot at {found.host}"
        if options.calibration is not None:
            asked = f"{_numbered(camera, serial)} at {host}"
            raise UserError(f"{unlike}, not of {asked}: `ddgrasp calibrate`, or another file.")
        return Standing(_assumed(f"not calibrated ({unlike})", place, spread))
    away = offset(found.T_base_cam, look_at(*place))
    which = f" (camera {found.serial}, {path})" if found.serial else ""
    text = f"calibrated {found.created[:10]}{which}: {describe(away, spread)}"
    return Standing(text, found, away, is_trained_for(away, spread))


def is_trained_for(away: Offset, spread: RandomConfig) -> bool:
    """Whether every axis is within what training draws."""
    shifts, turns = np.abs(away.shift_m), np.abs(away.turn_rad)
    return bool((shifts <= spread.camera_position_m).all() and (turns <= spread.camera_angle_rad).all())


def describe(away: Offset, spread: RandomConfig) -> str:
    """One line: how far the camera is from where it was trained, and what to move if that is too far."""
    place = f"the camera is {_size(away)} from where it was trained"
    if is_trained_for(away, spread):
        return f"{place}, within training's {_spread(spread)}"
    moves = [
        f"{1e3 * abs(value):.0f} mm {words[int(value < 0)]}"
        for value, words in zip(away.shift_m, _MOVES, strict=True)
        if abs(value) > spread.camera_position_m
    ]
    turns = [
        f"{np.degrees(abs(value)):.1f} degrees {words[int(value < 0)]}"
        for value, words in zip(away.turn_rad, _TURNS, strict=True)
        if abs(value) > spread.camera_angle_rad
    ]
    remedy = [f"move it {', '.join(moves)}"] * bool(moves) + [f"turn it {', '.join(turns)}"] * bool(turns)
    return f"{place}, more than training's {_spread(spread)}: {'; '.join(remedy)}"


def save(path: Path, calibration: Calibration) -> None:
    """Writes the file that `load` reads."""
    values = {
        "version": VERSION, "created": calibration.created, "camera": calibration.camera,
        "host": calibration.host, "T_base_cam": calibration.T_base_cam.tolist(),
        "rms_px": calibration.rms_px, "serial": calibration.serial, **calibration.details,
    }  # fmt: skip
    atomic_write_json(path, values)


def load(path: Path) -> Calibration:
    """Raises UserError for a file that is absent, damaged, or no calibration, and for a folder."""
    if path.is_dir():
        raise UserError(f"{path} is a folder: name the file, {path / DEFAULT_FILE.name}.")
    values = read_json(path)
    try:
        if values["version"] != VERSION:
            raise UserError(f"{path} has version {values['version']!r}, {VERSION} is read: calibrate again.")
        T = np.array(values["T_base_cam"], float)
        if not _is_rigid(T):
            raise ValueError("T_base_cam is no rigid transform")
        created, camera, host = (str(values[name]) for name in ("created", "camera", "host"))
        return Calibration(created, camera, host, T, float(values["rms_px"]), str(values.get("serial") or ""))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{path} is no calibration ({error}): `ddgrasp calibrate` writes one.") from None


def _is_rigid(T: np.ndarray) -> bool:
    """Whether it is a (4, 4) turn and shift: no mirror image, none that was written by columns."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0)):
        return False
    R = T[:3, :3]
    return bool(np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0.0)


def check_own(path: Path, camera: str, host: str, serial: str = "") -> None:
    """UserError if `path` is of another camera or robot, whose calibration is not to be lost; `serial` may be
    empty, not known."""
    try:
        there = load(path) if path.exists() else None
    except UserError:
        return
    if there is not None and not _is_of(there, camera, host, serial):
        own = f"{_numbered(there.camera, there.serial)} and the robot at {there.host!r}"
        raise UserError(
            f"{path} is of camera {own}: name another file for {_numbered(camera, serial)} and {host!r}, "
            "--out FILE, and give it to deploy as --calibration."
        )


def now() -> str:
    """ISO 8601, local time, seconds."""
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")


def named_serial(config: Config, camera: str) -> str:
    """The serial number that `camera`, as `--camera` names it, is asked for by; empty for any."""
    return config.deploy.realsense.serial if camera == "realsense" else ""


def _is_of(calibration: Calibration, camera: str, host: str, serial: str) -> bool:
    """Whether it was measured of these; a serial number that one side does not know fits every other."""
    own = calibration.serial or serial
    return (calibration.camera, calibration.host, own) == (camera, host, serial or own)


def _numbered(camera: str, serial: str) -> str:
    return f"{camera!r} with serial number {serial}" if serial else repr(camera)


def _place(trained: Mapping[str, Any]) -> tuple[Sequence[float], Sequence[float]]:
    """Where the policy's camera stood in training and what it looked at; what it does not say, the contract
    does."""
    position_m = trained.get("position", contract.CAMERA_POSITION_M)
    return position_m, trained.get("look_at", contract.CAMERA_LOOK_AT_M)


def _assumed(why: str, stands: tuple[Sequence[float], Sequence[float]], spread: RandomConfig) -> str:
    place, aim = (", ".join(f"{value:.2f}" for value in point) for point in stands)
    return (
        f"{why}: assumes the camera at ({place}) m in the robot's base frame, looking at ({aim}), within "
        f"{_spread(spread)}; `ddgrasp calibrate` measures it"
    )


def _size(away: Offset) -> str:
    return f"{1e3 * away.distance_m:.1f} mm / {np.degrees(away.angle_rad):.2f} degrees"


def _spread(spread: RandomConfig) -> str:
    angle = np.degrees(spread.camera_angle_rad)
    return f"±{1e3 * spread.camera_position_m:g} mm and ±{angle:.2f} degrees on each axis"
