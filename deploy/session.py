"""`ddgrasp deploy`: an exported policy on a robot and a camera chosen by name."""

import math
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ddgrasp.config import Config
from ddgrasp.errors import UserError
from deploy.clock import RealClock
from deploy.devices.options import SessionOptions, Setup
from deploy.devices.registry import check_devices, make_devices
from deploy.loop import ControlLoop, LoopReport
from deploy.policy import OnnxPolicy
from deploy.setup import loop_settings, safety_filter


def deploy(
    config: Config, policy_path: Path, options: SessionOptions, say: Callable[[str], None] = print
) -> LoopReport:
    """Run the loop on the machine's clock; events go to `say` as they happen.

    SIGTERM ends it as Ctrl-C does: the robot holds, both devices are stopped, the report comes back.

    Raises UserError for an unknown name, a combination that cannot work, or a device that is absent.
    """
    _check(options)
    with _terminable():
        return _run(config, policy_path, options, say)


def _run(
    config: Config, policy_path: Path, options: SessionOptions, say: Callable[[str], None]
) -> LoopReport:
    policy = OnnxPolicy(
        policy_path,
        noise=config.deploy.noise,
        seed=config.seed,
        execute_steps=config.deploy.execute_steps or None,
    )
    clock = RealClock()
    robot, camera = make_devices(Setup(config, options, policy.info, clock))
    settings = loop_settings(config.deploy, policy.info)
    loop = ControlLoop(camera, robot, policy, safety_filter(config.deploy, policy.info), clock, settings, say)
    steps = round(options.seconds * policy.info.control_hz) if math.isfinite(options.seconds) else None
    return loop.run(steps)


@contextmanager
def _terminable() -> Iterator[None]:
    """Turns the first SIGTERM into KeyboardInterrupt; a second one does not cut the stopping short."""

    def interrupt(signum, frame):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():  # signals are someone else's
        yield
        return
    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


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
        f"safety filter: {safety}",
    ])  # fmt: skip


def _row(name: str, percentiles: dict[str, float | None]) -> str:
    cells = ("-" if percentiles[p] is None else f"{percentiles[p]:.2f}" for p in ("p50", "p99"))
    return f"{name:<9}" + "".join(f"{cell:>9}" for cell in cells) + " ms"


def _check(options: SessionOptions) -> None:
    check_devices(options)
    if not options.seconds > 0:
        raise UserError(f"--seconds is {options.seconds:g}: choose more than 0, or inf to run until Ctrl-C.")
