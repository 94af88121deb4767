"""A robot that is connected but not moved, and a picture of what it would have been told."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ddgrasp.files import to_png
from deploy import kinematics
from deploy.interfaces import Robot, RobotState
from deploy.safety import SafetyLimits


@dataclass(frozen=True)
class Sent:
    """One command that was not sent."""

    q_rad: Float[np.ndarray, "7"]
    """Measured joints."""
    q_target_rad: Float[np.ndarray, "7"]
    close: bool


class DryRun:
    """Reads the state of `robot` and says what it would be told."""

    def __init__(self, robot: Robot, say: Callable[[str], None]):
        self._robot, self._say = robot, say
        self._q_rad = np.zeros(7)
        self.sent: list[Sent] = []

    def start(self) -> None:
        """Connects."""
        self._robot.start()

    def read_state(self) -> RobotState:
        """The robot's own."""
        state = self._robot.read_state()
        self._q_rad = state.q_rad
        return state

    def command(self, q_target_rad: Float[np.ndarray, "7"], close: bool) -> None:
        """Keeps it and says it: where the grip point is, joint steps in mrad, where they would take it, the
        gripper."""
        self.sent.append(Sent(self._q_rad.copy(), q_target_rad.copy(), close))
        steps = " ".join(f"{1e3 * step:+4.0f}" for step in q_target_rad - self._q_rad)
        here, there = (_metres(kinematics.grip_position(q)) for q in (self._q_rad, q_target_rad))
        hand = "close" if close else "open"
        self._say(f"grip at {here} m, would send {steps} mrad, to {there} m, {hand}")

    def hold(self) -> None:
        """Nothing moves."""

    def stop(self) -> None:
        """Disconnects."""
        self._robot.stop()


def _metres(place_m: np.ndarray) -> str:
    return " ".join(f"{value:.3f}" for value in place_m)


def draw(sent: Sequence[Sent], limits: SafetyLimits, period_s: float) -> bytes:
    """PNG: joint steps over time beside the speed limit, and the grip point's targets in the workspace."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    steps, top, side = figure.subplots(1, 3, width_ratios=(2, 1, 1))
    times = period_s * np.arange(len(sent))
    speeds = np.array([s.q_target_rad - s.q_rad for s in sent]).reshape(-1, 7) / period_s
    for joint, speed in enumerate(speeds.T, start=1):
        steps.plot(times, speed, label=f"joint {joint}")
    for sign in (-1, 1):
        steps.axhline(sign * min(limits.velocity_rad_s), color="grey", linestyle="--")
    steps.set(xlabel="s", ylabel="asked for, rad/s")
    steps.legend(ncols=4, fontsize="small")
    grip = np.array([kinematics.grip_position(s.q_target_rad) for s in sent]).reshape(-1, 3)
    lower, upper = limits.workspace_lower_m, limits.workspace_upper_m
    for axes, (a, b) in ((top, (0, 1)), (side, (0, 2))):
        axes.plot(grip[:, a], grip[:, b], ".-")
        corners = [(lower[a], lower[b]), (upper[a], lower[b]), (upper[a], upper[b]), (lower[a], upper[b])]
        axes.plot(*zip(*corners, corners[0], strict=True), color="grey", linestyle="--")
        axes.set(xlabel=f"{'xyz'[a]}, m", ylabel=f"{'xyz'[b]}, m", aspect="equal")
    figure.suptitle(f"{len(sent)} commands that were not sent; dashed: what the safety filter allows")
    return to_png(figure)
