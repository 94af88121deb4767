"""What a control loop says of itself: each step as it happens, and the whole run in the end."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from deploy.interfaces import Frame, RobotState
from deploy.safety import SafetyCounts
from deploy.timing import Timings

KEPT_EVENTS = 1000
"""Events kept in a report; later ones are counted only."""
By = Literal["policy", "retry"]
"""Who asked for an action: the network, or the rules for trying again (`deploy.retry`)."""


@dataclass(frozen=True)
class Event:
    """Something a person should know about a step."""

    step: int
    time_s: float
    """Since the loop's start."""
    kind: str
    """hold, recover, missed, touch, retry, done, empty, fault, stop."""
    reason: str

    def __str__(self) -> str:
        return f"step {self.step} ({self.time_s:.2f} s) {self.kind}: {self.reason}"


@dataclass(frozen=True)
class Step:
    """What happened in one period."""

    index: int
    frame: Frame | None
    state: RobotState
    action: Float[np.ndarray, "8"] | None
    """(8,), None where the loop held position."""
    q_target_rad: Float[np.ndarray, "7"] | None
    """(7,) after the safety filter, None where the loop held position."""
    close: bool = False
    """Whether the fingers were last told to close; they wait for a slow hand, `action` does not say so."""
    by: By | None = None
    """Whose `action` is; None where the loop held position."""


@dataclass
class LoopReport:
    """What a run of the loop did."""

    period_s: float
    steps: int = 0
    holds: int = 0
    """Steps that held position instead of following the policy."""
    interrupted: bool = False
    """Ended by Ctrl-C, or by SIGTERM in `ddgrasp deploy`."""
    fault: str = ""
    """What ended the run where a device did: a reflex, a lost connection, a camera that does not start."""
    width_m: float | None = None
    """The gripper's opening at the last step."""
    clock_s: float = 0.0
    """Seconds from the first step to the end of the last, on the loop's clock."""
    machine_s: float = 0.0
    """The same on this machine's: more where a simulated robot is slower than real."""
    timings: Timings = field(default_factory=Timings)
    safety: SafetyCounts = field(default_factory=SafetyCounts)
    events: list[Event] = field(default_factory=list)
    events_dropped: int = 0

    @property
    def periods(self) -> int:
        """Control periods so far: steps, and those that a slow step took besides its own."""
        return self.steps + self.timings.missed_deadlines

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "steps": self.steps,
            "holds": self.holds,
            "interrupted": self.interrupted,
            "fault": self.fault,
            "width_m": self.width_m,
            "clock_s": round(self.clock_s, 3),
            "machine_s": round(self.machine_s, 3),
            "safety": self.safety.as_dict(),
            "events": [str(event) for event in self.events],
            "events_dropped": self.events_dropped,
            **self.timings.summary(self.period_s),
        }

    def note(self, event: Event) -> None:
        """Keeps `event`, or counts it where there are `KEPT_EVENTS` already."""
        if len(self.events) < KEPT_EVENTS:
            self.events.append(event)
        else:
            self.events_dropped += 1
