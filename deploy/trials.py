"""Trials of an exported policy on the development rig, through the very loop that would drive a robot."""

import contextlib
from collections.abc import Callable, Generator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Float, UInt8

from ddgrasp import contract
from ddgrasp.config import Config
from ddgrasp.workers import spread
from deploy.changes import AS_IT_IS, Change
from deploy.clock import RealClock, SimClock
from deploy.devices.rig_camera import StereoCamera
from deploy.devices.rig_robot import SimRobot
from deploy.interfaces import Depth, Filmed, TrialCamera
from deploy.loop import ControlLoop
from deploy.loop_report import LoopReport, Step
from deploy.policy import OnnxPolicy
from deploy.setup import loop_settings, safety_filter
from deploy.timing import SECONDS, Timings
from deploy.treatment import Replacement, Treatment, treated
from rig.film import Film

if TYPE_CHECKING:
    from rig.world import RigWorld

_STREAM = 0x526967
"""Keeps the trials' random numbers apart from every other stage's ("Rig")."""
_FAULT, _RULES = " fault: ", (" retry: ", " done: ")
"""Between the time and the words of an event that is one."""


@dataclass(frozen=True)
class Trial:
    """One episode to run."""

    index: int
    object_name: str
    realtime: bool = False
    """Against the machine's clock instead of the simulated one."""


@dataclass(frozen=True)
class TrialResult:
    """What came of a trial; plain values, one line of trials.jsonl."""

    index: int
    object_name: str
    realtime: bool
    success: bool
    steps: int
    holds: int
    missed_deadlines: int
    safety: dict[str, int]
    events: list[str]
    sense_s: list[float]
    infer_s: list[float]
    act_s: list[float]
    latency_s: list[float]
    period_s: list[float]
    object_pos_m: list[list[float]] = field(default_factory=list)
    """(steps, 3) where the object was at each step's frame, metres in the robot's base frame; empty on the
    real clock, and in logs of before 2026-11-25."""

    @property
    def key(self) -> tuple[int, bool]:
        """Identifies the trial."""
        return self.index, self.realtime

    @property
    def timings(self) -> Timings:
        """How well its loop kept its time."""
        seconds = {name: getattr(self, name) for name in SECONDS}
        return Timings(**seconds, missed_deadlines=self.missed_deadlines)

    @property
    def fault(self) -> str:
        """What made the robot end the trial; "" if it did not."""
        faults = [event.split(_FAULT, 1)[1] for event in self.events if _FAULT in event]
        return next(iter(faults), "")

    @property
    def at_first_try(self) -> bool:
        """Whether it succeeded without any of the loop's rules acting (`deploy.retry`)."""
        return self.success and not any(rule in event for event in self.events for rule in _RULES)


def tried(config: Config) -> Config:
    """`config` with the objects of a rig: those of training, then the ones that no list of training has."""
    trained = config.world.objects
    unseen = (name for name in contract.UNSEEN_OBJECTS if name not in trained)
    return replace(config, world=replace(config.world, objects=(*trained, *unseen)))


def plan(config: Config) -> list[Trial]:
    """Simulated-clock trials with the objects in turn, then a few on the real clock."""
    names = config.world.objects
    simulated = [Trial(i, names[i % len(names)]) for i in range(config.evaluation.rig_trials)]
    real = [Trial(i, names[i % len(names)], True) for i in range(config.deploy.realtime_trials)]
    return simulated + real


def lasting(config: Config, seconds: float) -> Config:
    """`config` with trials that end after so long unless they succeed before."""
    steps = round(seconds * contract.CONTROL_HZ)
    return replace(config, world=replace(config.world, episode_steps=steps))


RULES: dict[str, Any] = {"rules": 5, "ends": "with success, as judged then"}
"""What a trial is, besides policy, configuration and series: a log goes on by the rules that it began with.

The number goes up with every change of loop, driver or rig that a trial can tell. Before 2026-11-27 there was
none; with 1 a hand on the FR3 rig began as wide as the trial before had left it; with 2 the safety filter did
not know the fingers; with 3 a hand might close and open again in one place without end; with 4 what a hand
held by its end hung beside its place for good. Not for what late and held steps told the network until
2026-11-30 (docs/test_rig.md): the development rig has none, the FR3 rig one in a thousand.

`ends`: trials of before 2026-11-25 were judged when their time was over; until a day later, those that
success had ended were judged again on the development rig a control period later."""


Watch = Callable[[Step, Filmed], bool | None]
"""Is called after every step, with the camera of the trial for colour pictures; True ends the trial."""


WatchPolicy = Callable[[Depth, np.ndarray, "RigWorld"], None]
"""Is told the frames (3, H, W) and the state (9,) that a policy is given, and the world as it is then."""


class Bench(Protocol):
    """Somewhere to try a policy."""

    def run(self, trial: Trial, watch: Watch | None = None) -> tuple[TrialResult, Film]:
        """One trial."""
        ...

    def close(self) -> None:
        """Lets go of everything."""
        ...


@dataclass(frozen=True)
class Draw:
    """What chance decides about a trial."""

    world_seed: int
    """The object's place, its size, the arm's dynamics follow from it (`rig.world.RigWorld.reset`)."""
    policy_seed: int
    T_world_cam: Float[np.ndarray, "4 4"]
    """(4, 4) where the camera stands."""
    rng: np.random.Generator
    """Draws the camera's noise."""


def drawn(config: Config, trial: Trial) -> Draw:
    """The same for the same seed and trial, whatever else is changed."""
    from rig.camera import camera_pose

    rng = np.random.default_rng([config.seed, _STREAM, trial.index])
    world_seed, policy_seed = int(rng.integers(2**31)), int(rng.integers(2**31))
    return Draw(world_seed, policy_seed, camera_pose(config, rng), rng)


class Rig:
    """World, camera and policy, built once and used for one trial after the other."""

    def __init__(
        self,
        config: Config,
        policy_path: Path,
        change: Change = AS_IT_IS,
        treatment: Treatment | Replacement | None = None,
    ):
        """`change` is what is otherwise than in the development rig; `treatment` is what is done to depth
        before the policy sees it."""
        import cv2

        cv2.setNumThreads(1)
        self._config, self._treatment, self._change = config, treatment, change
        self._policy = OnnxPolicy(
            policy_path, noise=config.deploy.noise, execute_steps=config.deploy.execute_steps or None
        )
        self._world = change.make_world(config)
        self._camera = change.make_camera(config, self._world)

    def run(self, trial: Trial, watch: Watch | None = None) -> tuple[TrialResult, Film]:
        """Run one trial. The same trial gives the same result on the simulated clock."""
        config, draw = self._config, drawn(self._config, trial)
        self._world.reset(draw.world_seed, trial.object_name)
        self._camera.model = self._world.model  # some changes compile it anew for every trial
        self._policy.reset(draw.policy_seed)
        clock = RealClock() if trial.realtime else SimClock()
        settings = loop_settings(config.deploy, self._policy.info)
        robot = SimRobot(self._world, clock, settings.period_s)
        pose = self._change.displaced(draw.T_world_cam, draw.world_seed)
        camera = StereoCamera(self._world, self._camera, pose, draw.rng, robot.catch_up, trial.object_name)
        safety = safety_filter(config.deploy, self._policy.info)
        seen = treated(camera, self._treatment)
        loop = ControlLoop(seen, robot, self._policy, safety, clock, settings)
        filming = Filming(camera, config.deploy.film_every, watch)
        # Drawing for people takes the time of a period: not while time is measured.
        look = filming.judge if trial.realtime else filming.look
        report = loop.run(config.world.episode_steps, look)
        if report.interrupted:
            raise KeyboardInterrupt
        robot.catch_up()
        # What ended it with success has one, whatever the last command does; the last period of a trial
        # whose time is over counts as well.
        success = filming.succeeded or bool(self._world.success())
        return result(trial, success, report, filming.object_pos_m), filming.film()

    def watch_policy(self, watch: WatchPolicy) -> None:
        """From now on `watch` is told of everything that the policy is given."""
        self._policy.watch = lambda depth, state: watch(depth, state, self._world)

    def close(self) -> None:
        """See Bench."""
        self._camera.close()


def run_trials(
    config: Config,
    policy_path: Path,
    trials: Sequence[Trial],
    workers: int,
    make: Callable[[Config, Path], Bench] = Rig,
) -> Generator[tuple[TrialResult, Film], None, None]:
    """Results of `trials` as they come, from `workers` fresh processes (0: all in this one).

    `make` makes what every process tries them on. See `ddgrasp.workers.spread`.
    """
    started = partial(make, config, policy_path)
    return spread(started, trials, workers, remedy="fewer workers need less")


def keep_results(
    made: Generator[tuple[TrialResult, Film], None, None], keep: Callable[[TrialResult, Film], None]
) -> None:
    """Gives `keep` whatever comes of `run_trials`. Ctrl-C costs at most the one that is being kept: trials
    that run come to their end, and are kept."""
    try:
        for result, film in made:
            keep(result, film)
    except KeyboardInterrupt as interrupt:
        with contextlib.suppress(KeyboardInterrupt):
            keep(*made.throw(interrupt))
            for result, film in made:
                keep(result, film)
        raise


class Filming:
    """Collects pictures and the object's trajectory, shows every step to who watches, and ends a trial that
    has succeeded."""

    def __init__(self, camera: TrialCamera, every: int, watch: Watch | None = None):
        self._camera, self._every, self._watch = camera, every, watch
        self._columns: list[tuple[int, UInt8[np.ndarray, "H W 3"], Depth]] = []
        self.object_pos_m: list[list[float]] = []
        """As each step's frame has it, see `TrialResult`."""
        self.succeeded = False
        """Whether success ended the trial."""

    def look(self, step: Step) -> bool | None:
        """Takes the picture if it is due; what the loop's `on_step` is called with. True ends the trial, as
        success does."""
        if step.index % self._every == 0 and step.frame is not None:
            self._columns.append((step.index, self._camera.picture(), step.frame.depth))
        self.object_pos_m.append([round(float(x), 4) for x in self._camera.object_pos_m()])
        succeeded = self.judge(step)
        told = self._watch is not None and self._watch(step, self._camera)
        return succeeded or told

    def judge(self, step: Step) -> bool:
        """Ends the trial if it has succeeded, without a picture."""
        del step
        self.succeeded = self._camera.success()
        return self.succeeded

    def film(self) -> Film:
        """The pictures so far."""
        if not self._columns:
            return Film((), np.zeros((0, 0, 0, 3), np.uint8), np.zeros((0, 0, 0), np.uint16))
        steps, rgb, depth = zip(*self._columns, strict=True)
        return Film(steps, np.stack(rgb), np.stack(depth))


def result(
    trial: Trial, success: bool, report: LoopReport, object_pos_m: Sequence[Sequence[float]]
) -> TrialResult:
    """What came of `trial`, from the loop's report, the rig's verdict and the object's trajectory."""
    timings = report.timings
    seconds: dict[str, Any] = {
        name: [round(value, 6) for value in getattr(timings, name)] for name in SECONDS
    }
    return TrialResult(
        **asdict(trial),
        success=success,
        steps=report.steps,
        holds=report.holds,
        missed_deadlines=timings.missed_deadlines,
        safety=report.safety.as_dict(),
        events=[str(event) for event in report.events],
        **seconds,
        object_pos_m=[list(place) for place in object_pos_m if np.isfinite(place).all()],
    )
