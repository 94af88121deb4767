"""A recording played back as a camera, at the pace of the loop's clock."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt16

from ddgrasp import contract
from ddgrasp.depth import at_profile
from deploy.devices.options import Setup
from deploy.interfaces import Clock, Frame, Robot

if TYPE_CHECKING:
    import sensors.recordings.recording


def make(setup: Setup, robot: Robot) -> "ReplayCamera":
    """Plays the chosen recording; UserError if there is none."""
    assert setup.options.recording is not None  # `registry.check_devices` sees to it
    return ReplayCamera.open(setup.options.recording, setup.clock, setup.info.profile)


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
        profile: contract.CameraProfile | None = None,
    ):
        """Depth of another size than `profile`'s becomes what that camera would have seen, if the recording
        names its focal length."""
        self._recording, self._clock, self._period_s = recording, clock, period_s
        self._profile, self._had = profile, _camera(recording)
        size = (recording.height_px, recording.width_px)
        self._brought = profile is not None and (profile.height_px, profile.width_px) != size
        self._start_s: float | None = None
        self._shown = -1
        self._frame: Frame | None = None

    @classmethod
    def open(cls, path: Path, clock: Clock, profile: contract.CameraProfile | None = None) -> "ReplayCamera":
        """Play the recording in `path` at its own rate, if it names one; UserError if there is none."""
        from sensors.recordings.recording import Recording

        recording = Recording.open(path)
        hz = recording.meta.get("hz")
        if not isinstance(hz, int | float) or not math.isfinite(hz):
            return cls(recording, clock, profile=profile)
        return cls(recording, clock, 1.0 / max(hz, contract.CONTROL_HZ), profile)

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
            self._frame = Frame(self._depth_mm(index), due_s, self._recording.rgb(index))
        return self._frame

    def recorded_as(self) -> dict[str, Any]:
        """See Replayed: as slow as they were recorded, where the loop sees every one of them."""
        meta, hz = self._recording.meta, self._recording.meta.get("hz")
        brought = self._profile if self._brought and self._had is not None else None
        return {
            "sensor": f"{meta.get('sensor', 'unnamed')}, replayed",
            "fx_px": brought.fx_px if brought else self._recording.fx_px,
            "baseline_m": meta.get("baseline_m"),
            "hz": min(hz, contract.CONTROL_HZ) if hz else None,
            "consecutive_frames": self._recording.consecutive,
            "color_aligned_to_depth": self._recording.color_aligned and not self._brought,
        }

    def stop(self) -> None:
        """Nothing to close."""

    def _depth_mm(self, index: int) -> UInt16[np.ndarray, "H W"]:
        depth_mm = self._recording.depth_mm(index)
        if self._profile is None or self._had is None or not self._brought:
            return depth_mm
        return at_profile(depth_mm, self._had, self._profile)


def _camera(recording: "sensors.recordings.recording.Recording") -> contract.CameraProfile | None:
    """What recorded, its axis through the middle of the picture; None if its focal length is not known."""
    focal_px = recording.meta.get("fx_px")
    if not isinstance(focal_px, int | float) or not 0 < focal_px < math.inf:
        return None
    return replace(
        contract.D455, width_px=recording.width_px, height_px=recording.height_px,
        fx_px=focal_px, fy_px=focal_px, cx_px=recording.width_px / 2, cy_px=recording.height_px / 2,
    )  # fmt: skip
