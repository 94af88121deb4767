"""A recording played back as a camera, at the pace of the loop's clock."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from ddgrasp import contract
from deploy.devices.options import Setup
from deploy.interfaces import Clock, Frame, Robot

if TYPE_CHECKING:
    import sensors.recordings.recording


def make(setup: Setup, robot: Robot) -> "ReplayCamera":
    """Plays the chosen recording; UserError if there is none."""
    assert setup.options.recording is not None  # `registry.check_devices` sees to it
    return ReplayCamera.open(setup.options.recording, setup.clock)


class ReplayCamera:
    """Frame i is shown from i * period_s after the start; past the end the last one stays (and goes stale).

    `period_s` is the time between two recorded frames, at most a control step's: of a recording at 30 Hz the
    loop sees every third frame, one at 2 Hz is played faster than it was, since nobody controls an arm by it.
    """

    def __init__(
        self,
        recording: "sensors.recordings.recording.Recording",
        clock: Clock,
        period_s: float = contract.CONTROL_DT_S,
    ):
        self._recording, self._clock, self._period_s = recording, clock, period_s
        self._start_s: float | None = None
        self._shown = -1
        self._frame: Frame | None = None

    @classmethod
    def open(cls, path: Path, clock: Clock) -> "ReplayCamera":
        """Play the recording in `path` at its own rate, if it names one; UserError if there is none."""
        from sensors.recordings.recording import Recording

        recording = Recording.open(path)
        hz = recording.meta.get("hz")
        if not isinstance(hz, int | float) or not math.isfinite(hz):
            return cls(recording, clock)
        return cls(recording, clock, 1.0 / max(hz, contract.CONTROL_HZ))

    def __len__(self) -> int:
        return len(self._recording)

    def start(self) -> None:
        """The first frame is shown from now on (or from the first `read`, if that comes before)."""
        if self._start_s is None:
            self._start_s = self._clock.now()

    def read(self) -> Frame:
        """The frame of this moment, millimetres; its time is when it was first due."""
        self.start()
        assert self._start_s is not None
        elapsed = int((self._clock.now() - self._start_s) / self._period_s + 1e-6)
        index = min(elapsed, len(self._recording) - 1)
        if self._frame is None or index != self._shown:
            self._shown = index
            due_s = self._start_s + index * self._period_s
            self._frame = Frame(self._recording.depth_mm(index), due_s, self._recording.rgb(index))
        return self._frame

    def stop(self) -> None:
        """Nothing to close."""
