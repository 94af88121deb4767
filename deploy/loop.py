"""The control loop: sense, infer, act, at 10 Hz on absolute deadlines."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ddgrasp import contract
from ddgrasp.config import DeployConfig
from ddgrasp.errors import UserError
from deploy.interfaces import Camera, CameraError, Clock, Frame, Robot, RobotError, RobotState
from deploy.interrupts import unbroken
from deploy.loop_report import By, Event, LoopReport, Step
from deploy.pace import Pace
from deploy.policy import OnnxPolicy
from deploy.retry import EMPTY_WIDTH_M, Retry, patience, still_for
from deploy.safety import APPROACH, NonFiniteAction, SafetyFilter


@dataclass(frozen=True)
class LoopSettings:
    """Time keeping of a loop."""

    period_s: float = contract.CONTROL_DT_S
    stale_periods: float = DeployConfig.stale_periods
    """A frame older than this many periods is stale."""
    retry: bool = False
    """Whether a hand that stands still, or has closed on nothing, tries again (`deploy.retry`)."""
    by_time: bool = False
    """Whether deadlines that were missed count as steps where the number of those is bounded: an arm moves no
    longer on a slow machine."""


class ControlLoop:
    """Drives `robot` by `policy` on what `camera` sees. One object, one run."""

    def __init__(
        self,
        camera: Camera,
        robot: Robot,
        policy: OnnxPolicy,
        safety: SafetyFilter,
        clock: Clock,
        settings: LoopSettings,
        say: Callable[[str], None] = lambda text: None,
    ):
        """`say` is called with one line per event, as it happens."""
        self._camera, self._robot, self._policy = camera, robot, policy
        self._safety, self._clock, self._settings, self._say = safety, clock, settings, say
        self._pace = Pace(safety.action_scale_rad)
        limits = safety.limits
        self._retry = Retry(still_for(limits), patience(limits)) if settings.retry else None
        self._report = LoopReport(settings.period_s, safety=safety.counts)
        self._last_frame_s = -math.inf
        self._held_for = ""
        self._closed = self._touches = self._checked = False
        self._periods = 1
        self._start_s = self._last_s = 0.0

    def run(
        self, max_steps: int | None = None, on_step: Callable[[Step], bool | None] | None = None
    ) -> LoopReport:
        """Run until `max_steps`, until `on_step` returns True, until Ctrl-C, or until the robot fails.

        The last command has its whole period before this returns. Camera and robot are started here
        and stopped whatever happens; on Ctrl-C an arm that has started is told to hold first. The report
        comes back either way: what the robot failed with, or the camera at its start, is its `fault`, and
        an event.
        """
        self._start_s = self._clock.now()
        moving = False
        try:
            self._camera.start()
            self._robot.start()
            self._policy.forget()
            moving = True
            self._keep_time(max_steps, on_step)
        except KeyboardInterrupt:
            self._report.interrupted = True
            after = "the start was broken off"
            if moving:
                after = "the robot holds position" if self._hold_quietly() else "holding failed"
            self._log("stop", f"interrupted; {after}")
        except (CameraError, RobotError) as error:  # a camera's, where it does not start
            self._fail(error)
        finally:
            self._stop_both()
        return self._report

    @property
    def report(self) -> LoopReport:
        """As far as `run` has come."""
        return self._report

    def _keep_time(self, max_steps: int | None, on_step: Callable[[Step], bool | None] | None) -> None:
        deadline, previous, done = self._clock.now(), None, max_steps == 0
        self._start_s, started = deadline, time.monotonic()
        while not done:
            self._clock.sleep_until(deadline)
            begun = self._clock.now()
            if previous is not None:
                self._report.timings.period_s.append(begun - previous)
            previous = begun
            step = self._step()
            self._report.steps += 1
            done = self._report.steps == max_steps
            if on_step is not None:
                done = bool(on_step(step)) or done
            self._report.clock_s, self._report.machine_s = self._now_s(), time.monotonic() - started
            deadline = self._next_deadline(deadline)
            done = done or (self._settings.by_time and self._report.periods >= (max_steps or math.inf))
        self._clock.sleep_until(deadline)
        self._look_at_hand()

    def _next_deadline(self, deadline: float) -> float:
        """The next multiple of the period that is still ahead; skipped ones count as missed."""
        period = self._settings.period_s
        late = self._clock.now() - (deadline + period)
        missed = max(0, int(np.ceil(late / period)))
        self._periods = 1 + missed
        if not missed:
            return deadline + period
        self._report.timings.missed_deadlines += missed
        self._log("missed", f"{missed} deadline(s), step took {1e3 * (late + period):.0f} ms")
        return deadline + (1 + missed) * period

    def _step(self) -> Step:
        timings = self._report.timings
        started = time.perf_counter()
        frame, problem = self._sense_camera()
        state = self._robot.read_state()
        timings.sense_s.append(time.perf_counter() - started)
        problem = problem or _state_problem(state)
        self._report.width_m = float(state.width_m) if np.isfinite(state.width_m) else None
        self._tell_touch(state.met)
        action, own, inferring = None, None, False
        started = time.perf_counter()
        if frame is not None and not problem:
            own, inferring = self._act(frame, state)
            if inferring:
                timings.infer_s.append(time.perf_counter() - started)
            action = self._or_retry(state, own)
        acting = time.perf_counter()
        target = None
        if action is not None:
            target, problem = self._command(state, action, paced=action is own and not state.met)
        if problem:
            self._hold(problem, state)
        else:
            self._recover()
        ended = time.perf_counter()
        timings.act_s.append(ended - acting)
        if action is not None and inferring:
            timings.latency_s.append(ended - started)
        asked = None if problem else action
        return Step(self._report.steps, frame, state, asked, target, self._closed, _whose(asked, own))

    def _act(self, frame: Frame, state: RobotState) -> tuple[np.ndarray, bool]:
        """(8,) the policy's action, or what is left of its last one; whether the network ran for it."""
        if not state.met and (rest := self._pace.rest(state.q_rad)) is not None:
            self._policy.wait(state.vector(), self._periods)
            return rest, False
        self._pace.forget()
        if state.met:
            self._policy.replan()
        inferring = self._policy.will_infer
        return self._policy.act(frame.depth, state.vector(), self._periods), inferring

    def _or_retry(self, state: RobotState, action: np.ndarray) -> np.ndarray:
        """(8,) `action`, or what a hand does that tries again, after which the policy begins anew."""
        instead = (
            None
            if self._retry is None
            else self._retry(state.vector(), bool(state.met), state.felt_nm, self._closed)
        )
        if instead is None:
            return action
        assert self._retry is not None
        if self._retry.begun:
            self._log("done" if self._retry.done else "retry", self._retry.begun)
        self._policy.restart()
        self._pace.forget()
        return instead

    def _sense_camera(self) -> tuple[Frame | None, str]:
        """The newest frame and why it cannot be used ("" if it can)."""
        try:
            frame = self._camera.read()
        except CameraError as error:
            return None, f"no frame: {error}"
        age_s = self._clock.now() - frame.timestamp_s
        if age_s < -self._settings.period_s:
            ahead = f"{1e3 * -age_s:.0f} ms ahead"
            return frame, f"frame of the future: {ahead}, its time is not of the loop's clock"
        previous_s, self._last_frame_s = self._last_frame_s, max(frame.timestamp_s, self._last_frame_s)
        age = f"{1e3 * age_s:.0f} ms old"
        if frame.timestamp_s == previous_s:
            return frame, f"stale frame: the same one again ({age})"
        if not age_s <= self._settings.stale_periods * self._settings.period_s:
            return frame, f"stale frame: {age}"
        if frame.timestamp_s < previous_s:
            return frame, f"stale frame: older than the one before ({age})"
        if not self._checked:
            self._check_camera(frame)
            self._checked = bool(np.any(frame.depth > 0))
        return frame, self._policy.check_frame(frame.depth)

    def _check_camera(self, frame: Frame) -> None:
        """A camera that can never fit is the user's to change, before the policy moves anything."""
        problem = self._policy.check_fit(frame.depth) or self._policy.check_unit(frame.depth)
        if problem:
            raise UserError(
                f"{problem}: set the camera to what {self._policy.path} takes, or take a policy for it "
                "(exported with another --export.depth-dtype, or trained at another world.camera_scale)."
            )

    def _command(self, state: RobotState, action: np.ndarray, paced: bool) -> tuple[np.ndarray | None, str]:
        """(7,) target sent, or why none was; `paced`: what a slow arm lacks of `action` comes next.

        The fingers move when the hand is where it was to move them, or can go no further.
        """
        try:
            target, close, causes = self._safety.target(state.q_rad, action)
        except NonFiniteAction as error:
            return None, f"non-finite {error}"
        if paced and not self._pace.made(state.q_rad, action, APPROACH in causes):
            close = self._closed
        self._robot.command(target, close)
        self._closed = close
        return target, ""

    def _hold(self, reason: str, state: RobotState) -> None:
        self._robot.hold()
        self._safety.stopped()
        # The arm stands still, so after the gap one frame repeated is what three frames would show.
        self._policy.forget()
        if not _state_problem(state):
            self._policy.wait(state.vector())  # the fingers go on: to the network still ones hold something
        self._pace.forget()
        if self._retry is not None:
            self._retry.held()
        self._report.holds += 1
        kind = reason.split(":")[0]
        if kind != self._held_for:
            self._log("hold", reason)
        self._held_for = kind

    def _recover(self) -> None:
        if self._held_for:
            self._log("recover", f"after {self._held_for}")
        self._held_for = ""

    def _tell_touch(self, met: str) -> None:
        """Once for as long as the arm gives way in every step."""
        if met and not self._touches:
            self._log("touch", f"the arm met something and gave way ({met})")
        self._touches = bool(met)

    def _look_at_hand(self) -> None:
        """Says so if the hand was told to close and has nothing in it."""
        if not self._closed:
            return
        width_m = float(self._robot.read_state().width_m)
        self._report.width_m = width_m if np.isfinite(width_m) else None
        if width_m < EMPTY_WIDTH_M:
            self._log("empty", f"the gripper closed to {1e3 * width_m:.1f} mm: nothing in the hand")

    def _hold_quietly(self) -> bool:
        """Whether the robot was told to hold; it was not where that failed, which is the run's fault then."""
        try:
            self._robot.hold()
        except RobotError as error:
            self._fail(error)
            return False
        return True

    def _fail(self, error: CameraError | RobotError) -> None:
        """The first fault ends the run; what comes after it is its consequence."""
        self._report.fault = self._report.fault or str(error)
        self._log("fault", str(error))

    def _stop_both(self) -> None:
        with unbroken():
            try:
                self._robot.stop()
            except RobotError as error:
                self._fail(error)
            finally:
                self._camera.stop()

    def _log(self, kind: str, reason: str) -> None:
        event = Event(self._report.steps, self._now_s(), kind, reason)
        self._report.note(event)
        self._say(str(event))

    def _now_s(self) -> float:
        """Since the start; of the last step where the clock went with the robot."""
        try:
            self._last_s = self._clock.now() - self._start_s
        except RobotError:
            pass
        return self._last_s


def _whose(action: np.ndarray | None, own: np.ndarray | None) -> By | None:
    """Who asked for (8,) `action`; `own` is the policy's."""
    if action is None:
        return None
    return "policy" if action is own else "retry"


def _state_problem(state: RobotState) -> str:
    if state.q_rad.shape != (7,) or not np.isfinite(state.q_rad).all() or not np.isfinite(state.width_m):
        return f"bad joint state: {np.array2string(state.q_rad, precision=3)} rad, gripper {state.width_m} m"
    if state.felt_nm is not None and not np.isfinite(state.felt_nm).all():
        return f"bad external torques: {np.array2string(np.asarray(state.felt_nm), precision=3)}"
    return ""
