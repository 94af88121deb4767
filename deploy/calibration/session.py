"""`ddgrasp calibrate`: where the camera stands, measured with a board that the robot shows it."""

import signal
import sys
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ddgrasp import policy_metadata
from ddgrasp.config import Config
from ddgrasp.contract import HOME_RAD
from ddgrasp.errors import Trouble, UserError, unknown_name
from ddgrasp.files import atomic_write_bytes
from deploy import kinematics
from deploy.calibration import picture, poses, standing
from deploy.calibration.drive import Driver
from deploy.calibration.hand_eye import MIN_VIEWS, HandEye, View, calibrate
from deploy.calibration.standing import Calibration
from deploy.clock import RealClock, RobotClock
from deploy.devices.options import SessionOptions, Setup
from deploy.devices.registry import IMAGERS, ROBOTS
from deploy.interfaces import CameraError, Clock, Imager, KnowsItsPlace, Lens, Numbered, Robot, RobotError
from deploy.interrupts import note, terminable, unbroken
from deploy.session import ask_person, for_devices, keep_time_of, survived
from deploy.setup import check_start, safety_filter, space_notice
from mjx_envs.camera import nominal_pose
from sensors.charuco_board import CharucoBoard, Corners

HOPELESS = 4
"""So many pictures without a glimpse of the board end the run."""
MOVED_RAD = 1e-3
"""An arm that moved by more while the picture was taken spoils the view."""
MUCH_RMS_PX, MOST_RMS_PX = 1.0, 1.5
"""Reprojection error of a calibration that is warned of, and of one that is refused. Squares 3 % smaller than
said give 2 px, and move the camera by 6 mm."""


@dataclass(frozen=True)
class CalibrationOptions:
    """What to calibrate, with what."""

    camera: str
    """realsense or rig."""
    host: str = ""
    """Address of the robot's control unit; empty takes deploy.franka.host, or 127.0.0.1 with camera rig."""
    board: CharucoBoard = field(default_factory=CharucoBoard)
    poses: int = 20
    speed_rad_s: float = 0.3
    """Speed of the fastest joint."""
    dry_run: bool = False
    """Connect and look, say where the arm would go, move nothing."""
    yes: bool = False
    """Move without asking first."""
    out: Path | None = None
    """None is `standing.DEFAULT_FILE`, unless that is of another camera or robot."""

    @property
    def file(self) -> Path:
        """Where the calibration goes."""
        return self.out or standing.DEFAULT_FILE


@dataclass
class Taken:
    """What the poses gave so far; lists of the same length."""

    views: list[View] = field(default_factory=list)
    pictures: list[np.ndarray] = field(default_factory=list)
    joints_rad: list[np.ndarray] = field(default_factory=list)

    @property
    def seen(self) -> int:
        """Pictures with any of the board."""
        return sum(len(view.corners.ids) > 0 for view in self.views)


def run(
    config: Config, options: CalibrationOptions, say: Callable[[str], None] = print
) -> Calibration | None:
    """Drives the poses, solves, writes `options.file` and a picture beside it; None after a dry run.

    Raises UserError: a device is absent, nobody agrees, the board is not seen, the views do not suffice.
    """
    say = survived(say)
    session = SessionOptions(
        "franka", options.camera, dry_run=options.dry_run, yes=options.yes, host=options.host
    )
    if options.camera not in IMAGERS:
        raise unknown_name("camera", options.camera, IMAGERS)
    config = for_devices(config, session)
    host = config.deploy.franka.host
    _check_out(options, host, standing.named_serial(config, options.camera))
    info = policy_metadata.describe(config.student, config.export, config.world.profile)
    clock: Clock = RobotClock() if config.deploy.clock == "robot" else RealClock()
    confirm = (lambda question: None) if options.yes else ask_person
    give = confirm if options.camera == "rig" else ask_person  # whose hand has a board
    if options.camera != "rig" and not (options.dry_run or sys.stdin.isatty()):
        raise UserError(
            "the hand is given a board when it is open, and nobody can be asked for one here: run this on a "
            "terminal."
        )
    setup = Setup(config, session, info, clock, confirm, say)
    robot, imager = ROBOTS["franka"](setup), IMAGERS[options.camera](setup)
    keep_time_of(robot, clock, session)
    safety = safety_filter(config.deploy, info, "franka")
    driver = Driver(robot, safety, clock, min(options.speed_rad_s, *config.deploy.franka.speed_rad_s))
    with terminable(), _started(imager, robot, say) as start_robot:
        bench = poses.Bench(safety.limits, imager.lens(), nominal_pose(), options.board)
        _check_out(options, host, _serial(imager))
        check_start(safety)
        say(space_notice(config.deploy))
        say(f"looking for: {options.board.describe()}")
        ways = poses.plan(bench, options.poses, np.array(HOME_RAD), np.random.default_rng(config.seed))
        start_robot()
        if options.dry_run:
            _look_once(ways, imager, options, say)
            return None
        taken = _take(driver, imager, bench, ways, options, give, say)
        try:  # before a person touches the arm, which may fail: it costs none of the views
            found = _solved(taken, imager, options, config, say)
        except (UserError, OSError):
            _give_back(driver, options, say)
            raise
        _give_back(driver, options, say)
    return found


def describe(found: HandEye, truth: np.ndarray | None) -> list[str]:
    """Lines for a terminal: errors in pixels, what was left out, standard errors, error against the truth."""
    corners = f"{int(found.used.sum())} of {len(found.used)} views"
    lines = [
        f"reprojection error {found.rms_px:.3f} px RMS over {corners} "
        f"(closed form, before refinement: {found.closed_form_rms_px:.3f} px)"
    ]
    out = [
        f"view {i + 1} ({'too few corners, or on one line' if np.isnan(rms) else f'{rms:.2f} px'})"
        for i, rms in enumerate(found.view_rms_px)
        if not found.used[i]
    ]
    lines += [f"left out: {', '.join(out)}"] * bool(out)
    mm, deg = 1e3 * found.position_std_m.max(), np.degrees(found.angle_std_rad.max())
    lines.append(f"standard error of an axis, from corners alone: {mm:.2f} mm, {deg:.3f} degrees at most")
    if truth is not None:
        away = standing.offset(found.T_base_cam, truth)
        lines.append(
            f"against the truth, which the rig knows: {1e3 * away.distance_m:.2f} mm, "
            f"{np.degrees(away.angle_rad):.3f} degrees"
        )
    return lines


def _take(
    driver: Driver,
    imager: Imager,
    bench: poses.Bench,
    ways: np.ndarray,
    options: CalibrationOptions,
    confirm: Callable[[str], None],
    say: Callable[[str], None],
) -> Taken:
    """A view of every pose that is reached, or of those before the arm failed, if they can suffice.

    Raises UserError if they cannot, or the board is never seen.
    """
    taken = Taken()
    confirm(
        "Hold the board between the fingers by the middle of its upper margin, its printed face to the "
        "robot's right, its plate no more than 10 mm beyond the pattern below and beside it, and clear the "
        f"table of everything else: the hand closes, then the arm moves through {len(ways)} poses. Ready?"
    )
    number = 0
    try:
        driver.grip(close=True)
        stood = driver.joints()  # not where it was planned from: a person may have led it aside
        for number, q_target in enumerate(ways, start=1):
            if not poses.is_free_way(bench, stood, q_target):  # the planned one may be from elsewhere
                came = "left out, no free way from where the arm stands"
            elif driver.go(q_target):
                stood, came = q_target, _view(driver, imager, options.board, taken)
            else:
                came = _back(driver, stood)
            say(f"pose {number} of {len(ways)}: {came}")
            if len(taken.views) >= HOPELESS and not taken.seen:
                break
    except RobotError as error:
        ended = f"calibration ended at pose {number} of {len(ways)}: {error}"
        if taken.seen < MIN_VIEWS:
            raise Trouble(f"{ended}.") from error
        say(f"{ended}; goes on with the views before it")
    if not taken.views:
        raise UserError(f"none of {len(ways)} poses gave a picture; what happened is said above.")
    if not taken.seen:
        path = options.file.with_name("not-seen.png")
        atomic_write_bytes(path, picture.encode(taken.pictures[-1]))
        say(f"the last picture: {path}")
    return taken


def _back(driver: Driver, stood_rad: np.ndarray) -> str:
    """From something in the way to (7,) where the arm stood before, which is known to be free. RobotError."""
    driver.rest()
    if not driver.go(stood_rad, heed=False):
        raise RobotError("something is in its way, and on the way back: look at what it met")
    driver.rest()
    return "not reached, left out: something is in the way"


def _view(driver: Driver, imager: Imager, board: CharucoBoard, taken: Taken) -> str:
    """The view of a pose; what came of it in a few words. Raises RobotError."""
    before = driver.rest()
    try:
        gray = imager.picture()
    except CameraError as error:
        return f"no picture ({error})"
    after = driver.joints()
    if np.abs(after - before).max() > MOVED_RAD:
        return "the arm moved while the picture was taken, left out"
    q_rad, corners = (before + after) / 2, board.find(gray)
    taken.views.append(View(kinematics.grip_pose(q_rad), corners))
    taken.pictures.append(gray)
    taken.joints_rad.append(q_rad)
    return f"{len(corners.ids)} of {board.corner_count} corners" if len(corners.ids) else "board not seen"


def _give_back(driver: Driver, options: CalibrationOptions, say: Callable[[str], None]) -> None:
    """The board into a person's hand, where there is one."""
    if (options.yes and options.camera == "rig") or not sys.stdin.isatty():
        say("the hand keeps the board")
        return
    try:
        ask_person("Take hold of the board: the hand opens. Ready?")
        driver.grip(close=False)
    except KeyboardInterrupt:
        note(signal.SIGINT)  # what was measured is kept, and what follows in a script does not begin
        say("the hand keeps the board")
    except (UserError, EOFError):
        say("the hand keeps the board")
    except RobotError as error:
        say(f"the hand may have kept the board: {error}")


def _look_once(
    ways: np.ndarray, imager: Imager, options: CalibrationOptions, say: Callable[[str], None]
) -> None:
    """What a dry run does: says where the grip point would go, and whether the board is in view now."""
    for number, q in enumerate(ways, start=1):
        x, y, z = kinematics.grip_position(q)
        joints = " ".join(f"{value:+.2f}" for value in q)
        say(f"pose {number} of {len(ways)}: joints {joints} rad, grip at {x:.3f} {y:.3f} {z:.3f} m")
    try:
        gray = imager.picture()
    except CameraError as error:
        raise Trouble(f"camera {options.camera!r} gives no picture: {error}.") from error
    corners: Corners = options.board.find(gray)
    path = options.file.with_name("dry-run.png")
    atomic_write_bytes(path, picture.encode(gray))
    say(f"nothing moved; {len(corners.ids)} of {options.board.corner_count} corners in view now: {path}")


def _solved(
    taken: Taken,
    imager: Imager,
    options: CalibrationOptions,
    config: Config,
    say: Callable[[str], None],
) -> Calibration:
    lens, truth = imager.lens(), _truth(imager)
    found = calibrate(taken.views, lens, options.board)
    for line in describe(found, truth):
        say(line)
    details = _details(taken, found, lens, options.board, truth)
    host = config.deploy.franka.host
    measured = found.T_base_cam, found.rms_px, _serial(imager)
    result = Calibration(standing.now(), options.camera, host, *measured, details)
    saved = found.rms_px <= MOST_RMS_PX
    if saved:  # before the picture, which takes more room
        standing.save(options.file, result)
    sheet = options.file.with_name(f"{options.file.stem}{'' if saved else '-refused'}.png")
    atomic_write_bytes(sheet, picture.sheet(taken.pictures, taken.views, found, lens, options.board))
    _check_fit(found.rms_px, 1e3 * options.board.square_m, sheet, say)
    reads = "`ddgrasp deploy`" if options.out is None else f"`ddgrasp deploy --calibration {options.file}`"
    say(f"{options.file}, {sheet}: {reads} reads the first, look at the second")
    away = standing.offset(found.T_base_cam, nominal_pose())
    say(standing.describe(away, config.world.random))
    return result


def _check_fit(rms_px: float, square_mm: float, sheet: Path, say: Callable[[str], None]) -> None:
    """UserError, or a warning, for views that contradict one another all alike, of which none is left out."""
    if rms_px > MOST_RMS_PX:
        raise UserError(
            f"the views contradict one another by {rms_px:.1f} px, more than {MOST_RMS_PX:g}: are the "
            f"board's squares {square_mm:g} mm wide as printed (--board.square-mm)? Look at {sheet}; the "
            "result is not saved."
        )
    if rms_px > MUCH_RMS_PX:
        say(
            f"{rms_px:.1f} px is much: measure the printed squares (--board.square-mm is {square_mm:g}), and "
            "see that the board is flat and fast in the hand"
        )


def _details(
    taken: Taken, found: HandEye, lens: Lens, board: CharucoBoard, truth: np.ndarray | None
) -> dict[str, Any]:
    """Enough to solve it again: joints and corners of every view."""
    views = [
        {
            "q_rad": q, "used": bool(found.used[i]), "rms_px": float(found.view_rms_px[i]),
            "corner_ids": view.corners.ids, "corners_px": view.corners.pixels.round(3),
        }
        for i, (view, q) in enumerate(zip(taken.views, taken.joints_rad, strict=True))
    ]  # fmt: skip
    details: dict[str, Any] = {
        "T_grip_board": found.T_grip_board, "position_std_m": found.position_std_m,
        "angle_std_rad": found.angle_std_rad, "board": board,
        "lens": {"matrix": lens.matrix, "distortion": lens.distortion},
    }  # fmt: skip
    if truth is not None:
        away = standing.offset(found.T_base_cam, truth)
        details["against_truth"] = {"distance_m": away.distance_m, "angle_rad": away.angle_rad}
    return details | {"views": views}


def _truth(imager: Imager) -> np.ndarray | None:
    return np.asarray(imager.truth(), float) if isinstance(imager, KnowsItsPlace) else None


def _serial(imager: Imager) -> str:
    return imager.serial() if isinstance(imager, Numbered) else ""


def _check_out(options: CalibrationOptions, host: str, serial: str) -> None:
    """UserError, before anything moves, unless a calibration and a picture beside it can be written, over
    none of another camera or robot."""
    if options.out is None:
        standing.check_own(standing.DEFAULT_FILE, options.camera, host, serial)
    out = options.file
    if out.is_dir() or out.suffix == ".png":
        raise UserError(f"--out is {out}; expected the name of a file, for example calibration.json.")
    out.parent.mkdir(parents=True, exist_ok=True)


@contextmanager
def _started(imager: Imager, robot: Robot, say: Callable[[str], None]):
    """The imager started, a function that starts the robot; both stopped at the end, come what may.

    What a device fails with, and nobody else has dealt with, is a UserError.
    """
    begun = False

    def start_robot() -> None:
        nonlocal begun
        begun = True
        robot.start()

    try:
        imager.start()
        yield start_robot
    except (CameraError, RobotError) as error:
        raise Trouble(f"{error}.") from error
    finally:
        with unbroken():
            try:
                if begun:
                    robot.stop()
            except RobotError as error:
                say(f"the arm did not stop as it should: {error}")
            finally:
                imager.stop()
