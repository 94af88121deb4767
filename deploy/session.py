"""`ddgrasp deploy`: an exported policy on a robot and a camera chosen by name."""

import contextlib
import hashlib
import math
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ddgrasp import contract
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes
from ddgrasp.install import pip_install
from deploy import dry_run
from deploy.calibration.standing import standing
from deploy.clock import RealClock, RobotClock
from deploy.devices.options import RIG_CAMERAS, RIG_HOST, SessionOptions, Setup
from deploy.devices.registry import check_devices, make_devices
from deploy.dry_run import DryRun
from deploy.interfaces import Camera, Clock, KnowsObject, Robot, TimedRobot
from deploy.interrupts import note, terminable, unbroken
from deploy.loop import ControlLoop
from deploy.loop_report import LoopReport
from deploy.policy import OnnxPolicy
from deploy.record import ENDED, FITTED, REPORT_FILE, DeploymentRecord, verdict
from deploy.setup import check_start, loop_settings, safety_filter, space_notice, speed_notice

_LONGEST_S = 1e9
_TOO_SLOW = "the loop did not keep its rate: this machine is too busy or too slow for the policy and devices"


def deploy(
    config: Config, policy_path: Path, options: SessionOptions, say: Callable[[str], None] = print
) -> LoopReport:
    """Run the loop; events go to `say` as they happen, what it did into a folder of `options.out`.

    SIGTERM and a terminal that is closed end it as Ctrl-C does, and none cuts the stopping short when it
    comes again: the robot holds, both devices are stopped, the report comes back. So it does when the robot
    fails; its `fault` says with what. One that is ended before its first step leaves no folder, nor does one
    whose device fails in its start.

    Raises UserError for an unknown name, a combination that cannot work, or a device that is absent.
    """
    _check(options)
    with terminable():
        return _run(for_devices(config, options), policy_path, options, survived(say))


def _run(
    config: Config, policy_path: Path, options: SessionOptions, say: Callable[[str], None]
) -> LoopReport:
    policy = OnnxPolicy(
        policy_path,
        noise=config.deploy.noise,
        seed=config.seed,
        execute_steps=config.deploy.execute_steps or None,
    )
    options.out.mkdir(parents=True, exist_ok=True)  # before an arm moves that could not be recorded
    if options.real and not (options.yes or options.dry_run or sys.stdin.isatty()):
        raise UserError(
            f"robot {options.robot!r} asks before it moves, and nobody can be asked here: give --yes."
        )
    place = standing(config, options, policy.info.camera)
    if place.line:
        say(place.line)
    if place.calibration is not None and place.calibration.serial:  # and no other that is plugged in
        realsense = replace(config.deploy.realsense, serial=place.calibration.serial)
        config = replace(config, deploy=replace(config.deploy, realsense=realsense))
    clock = RobotClock() if config.deploy.clock == "robot" else RealClock()
    confirm = _unmoved if options.dry_run else _agreed if options.yes else ask_person
    robot, camera = make_devices(Setup(config, options, policy.info, clock, confirm, say))
    keep_time_of(robot, clock, options)
    safety = safety_filter(config.deploy, policy.info, options.robot)
    if options.real:
        check_start(safety)
        say(space_notice(config.deploy))
        if notice := speed_notice(config.deploy, policy.info):
            say(notice)
    driven = DryRun(robot, say) if options.dry_run else robot
    settings = loop_settings(config.deploy, policy.info, moves=not options.dry_run, by_time=options.real)
    loop = ControlLoop(camera, driven, policy, safety, clock, settings, say)
    steps = round(options.seconds * policy.info.control_hz) if math.isfinite(options.seconds) else None
    folder = _new_folder(options.out)
    seen_by = _camera_name(config, options)
    simulated = options.camera in ("stereo", *RIG_CAMERAS)
    sensor = f"{seen_by}, {'D455 profile' if simulated else FITTED}"
    kept = DeploymentRecord(camera, policy.info.profile, sensor, config.deploy.film_every, simulated)
    about: dict[str, Any] = {"policy": str(policy_path), "robot": options.robot, "camera": seen_by}
    about["policy_sha256"] = hashlib.sha256(policy.path.read_bytes()).hexdigest()
    name = options.object_name or (config.world.objects[0] if options.camera == "stereo" else "")
    about |= {"dry_run": options.dry_run, "created": _stamp(), "calibration": place.as_dict()}
    ending = contextlib.ExitStack()
    try:
        with kept.into(folder):
            report = loop.run(steps, kept.look)
            # Before the last frames are on the disk: the simulated arm's world goes on meanwhile.
            unattended = options.yes or report.interrupted or bool(report.fault)
            finished = not (options.dry_run or report.interrupted)
            success = verdict(camera, _unasked if unattended else ask_success) if finished else None
            ending.enter_context(unbroken())
    except BaseException as error:
        if not loop.report.steps:
            _drop(folder)
        else:  # a device that fails in a way of its own costs nothing of what was recorded
            fault = loop.report.fault or f"{type(error).__name__}: {error}"
            with unbroken(), contextlib.suppress(OSError, ValueError):
                kept.finish(
                    folder, {**loop.report.as_dict(), "fault": fault}, None, about | _object(camera, name)
                )
        ending.close()
        raise
    with ending:
        begun = report.steps or (report.fault and report.timings.sense_s)
        if not begun:  # interrupted, or a device failed in its start: nothing was tried
            _drop(folder)
            return report
        if success is not None:  # before the disk is written to, which may be full
            say(f"verdict: {ENDED[success]}")
        kept.finish(folder, report.as_dict(), success, about | _object(camera, name))
    say(f"report: {folder / REPORT_FILE}")
    if kept.lost:
        say(f"frames are missing: {kept.lost}")
    if isinstance(driven, DryRun):
        path = folder / "dry-run.png"
        atomic_write_bytes(path, dry_run.draw(driven.sent, safety.limits, 1.0 / policy.info.control_hz))
        say(f"drawn: {path}")
    return report


def _camera_name(config: Config, options: SessionOptions) -> str:
    """What report and recording call the camera: a simulated one before other tables sees other depth."""
    if config.record.other_tables and options.camera in ("stereo", "rig"):
        return f"{options.camera}, other tables"
    return options.camera


def _object(camera: Camera, named: str) -> dict[str, str]:
    """For the report: what lies before the arm, as its rig knows it, else as it was `named`; nothing if
    neither says."""
    there = camera.object_name() if isinstance(camera, KnowsObject) else ""
    return {"object": there or named} if there or named else {}


def survived(say: Callable[[str], None]) -> Callable[[str], None]:
    """`say`, which ends nothing where nobody hears it any more: the terminal may be gone."""

    def quietly(text: str) -> None:
        with contextlib.suppress(OSError):
            say(text)

    return quietly


def ask_success(question: str) -> bool | None:
    """A person's answer on the terminal; None without one."""
    if not sys.stdin.isatty():
        return None
    try:
        answer = _typed(f"{question} [y/n, or Enter for no answer] ")
    except EOFError:
        return None
    except KeyboardInterrupt:  # whoever leaves here still wants the report
        note(signal.SIGINT)
        return None
    return {"y": True, "yes": True, "n": False, "no": False}.get(answer)


def _unasked(question: str) -> bool | None:
    """Where nobody is to be asked."""


def ask_person(question: str) -> None:
    """Ask on the terminal. Raises UserError unless the answer is yes, or if nobody can be asked."""
    if not sys.stdin.isatty():
        raise UserError(f"{question} Nobody can be asked here: give --yes.")
    try:
        answer = _typed(f"{question} [y/N] ")
    except EOFError:  # Ctrl-D
        answer = ""
    if answer not in ("y", "yes"):
        raise UserError("not confirmed: the arm stays where it is.")


def _typed(question: str) -> str:
    """What a person answers; where standard output goes to a file the question must not go with it."""
    shown = sys.stdout.isatty()
    if not shown:
        print(question, end="", file=sys.stderr, flush=True)
    return input(question if shown else "").strip().lower()


def _agreed(question: str) -> None:
    """`--yes`."""


def _unmoved(question: str) -> None:
    """A dry run's answer to a driver that would move by itself. Raises UserError."""
    raise UserError("a dry run moves nothing, and this robot's driver would: see its make.")


def for_devices(config: Config, options: SessionOptions) -> Config:
    """The command line's host; before the FR3 rig, a process of this machine, its own time and any kernel.

    The rig's camera never goes with the configured arm: without a host named it is the rig at `RIG_HOST`.
    """
    section = config.deploy
    if host := options.host or (RIG_HOST if options.camera in RIG_CAMERAS else ""):
        section = replace(section, franka=replace(section.franka, host=host))
    if options.camera in RIG_CAMERAS:
        section = replace(section, clock="robot", franka=replace(section.franka, kernel="any"))
    return replace(config, deploy=section)


def keep_time_of(robot: Robot, clock: Clock, options: SessionOptions) -> None:
    """A clock that follows a robot follows this one. Raises UserError if it has no time of its own."""
    if not isinstance(clock, RobotClock):
        return
    if not isinstance(robot, TimedRobot):
        raise UserError(f"robot {options.robot!r} has no clock of its own: set deploy.clock machine.")
    clock.follow(robot)


def _new_folder(out: Path) -> Path:
    """A new one, named after the time of day: two deployments that begin in the same second have two."""
    stamp, again = _stamp(), 0
    while True:
        folder = out / (f"{stamp}-{again}" if again else stamp)
        try:
            folder.mkdir()
        except FileExistsError:
            again += 1
        else:
            return folder


def _drop(folder: Path) -> None:
    """Takes away a folder that nothing was kept in."""
    with contextlib.suppress(OSError):
        folder.rmdir()


def _stamp() -> str:
    return time.strftime("%Y%m%d-%H%M%S")


def describe(report: LoopReport) -> str:
    """A few lines for a terminal."""
    values = report.as_dict()
    rows = [
        f"{'':<9}{'p50':>9}{'p99':>9}",
        *(
            _row(name, values[f"{name}_ms"])
            for name in ("sense", "infer", "act", "latency", "period", "jitter")
        ),
    ]
    safety = ", ".join(f"{name} {count}" for name, count in values["safety"].items())
    return "\n".join([
        *rows,
        f"{report.steps} steps, {report.timings.missed_deadlines} missed deadlines, {report.holds} holds",
        f"{report.clock_s:.1f} s on the loop's clock took {report.machine_s:.1f} s of this machine's time",
        *([_TOO_SLOW] if report.timings.missed_deadlines > report.steps / 2 else []),
        f"safety filter: {safety}",
        *([f"ended by: {report.fault}"] if report.fault else []),
    ])  # fmt: skip


def _row(name: str, percentiles: dict[str, float | None]) -> str:
    cells = ("-" if percentiles[p] is None else f"{percentiles[p]:.2f}" for p in ("p50", "p99"))
    return f"{name:<9}" + "".join(f"{cell:>9}" for cell in cells) + " ms"


def _check(options: SessionOptions) -> None:
    check_devices(options)
    if options.recording is not None and options.camera != "replay":
        raise UserError(
            f"--recording is {options.recording}, which camera {options.camera!r} does not play: drop it, or "
            "choose --camera replay."
        )
    of_an_arm = {"--host": options.host, "--calibration": options.calibration}
    for option, value in of_an_arm.items():
        if value and not options.real:
            raise UserError(
                f"{option} is {value}, and robot 'sim' has none: drop it, or choose --robot franka."
            )
    if options.dry_run and find_spec("matplotlib") is None:  # of the arm's extra, and needed at the end
        raise UserError(f"--dry-run ends with a drawing of what was not sent: {pip_install('franka')}.")
    if not (contract.CONTROL_DT_S <= options.seconds <= _LONGEST_S or options.seconds == math.inf):
        raise UserError(
            f"--seconds is {options.seconds:g}: choose {contract.CONTROL_DT_S:g}, a control step, to "
            f"{_LONGEST_S:g}; inf runs until Ctrl-C."
        )
