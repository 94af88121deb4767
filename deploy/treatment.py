"""What may be done to recorded depth on its way to the policy: a camera that hands out treated frames."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8, UInt16

from ddgrasp.errors import UserError
from deploy.interfaces import Camera, CameraError, Depth, Filmed, Frame, Pausing, Simulated
from sensors.inpainting import RADIUS_PX, inpainted

CleanDepth = Callable[[], UInt16[np.ndarray, "H W"]]


@runtime_checkable
class Treatment(Protocol):
    """Recorded depth in, the depth that the policy sees out; called once a frame, in time order."""

    @property
    def needs_rgb(self) -> bool:
        """Whether it must be given colour."""
        ...

    def __call__(self, depth: Depth, rgb: UInt8[np.ndarray, "h w 3"] | None) -> Depth:
        """(H, W) depth of the same size and unit; `rgb` of the same moment, where `needs_rgb`."""
        ...


@runtime_checkable
class Replacement(Protocol):
    """A treatment that before a simulation may put other depth in the place of what was recorded."""

    def replace(self, depth: Depth, clean_mm: CleanDepth) -> Depth:
        """(H, W) depth that the policy sees; `clean_mm` gives what a camera without errors would."""
        ...


@dataclass(frozen=True)
class Inpaint:
    """Every hole filled from around it, as the paper's row Inpaint does on line."""

    radius_px: float = RADIUS_PX
    needs_rgb: bool = False

    def __call__(self, depth: Depth, rgb: UInt8[np.ndarray, "h w 3"] | None) -> Depth:
        """See `Treatment`. Raises UserError for depth in metres."""
        del rgb
        if depth.dtype != np.uint16:
            raise UserError(
                f"inpainting takes depth in uint16 millimetres, not {depth.dtype}: use a camera that gives "
                "them."
            )
        return inpainted(depth, self.radius_px)


class TreatedCamera:
    """A camera whose frames are treated, each once. What is not a frame (films, verdicts), ask the camera."""

    def __init__(self, camera: Camera, treatment: Treatment | Replacement):
        """Raises UserError if the treatment needs what the camera does not give: colour, clean depth."""
        if isinstance(treatment, Replacement):
            if not isinstance(camera, Simulated):
                raise UserError(f"{type(treatment).__name__} needs a simulation: choose a rig's camera.")
        elif treatment.needs_rgb and not isinstance(camera, Filmed):
            raise UserError(f"{type(treatment).__name__} needs a camera with colour: choose another camera.")
        self._camera, self._treatment = camera, treatment
        self._taken: Frame | None = None
        self._frame: Frame | None = None

    def start(self) -> None:
        """See Camera."""
        self._camera.start()

    def read(self) -> Frame:
        """See Camera: the newest frame, treated. Raises CameraError."""
        taken = self._camera.read()
        if self._frame is None or taken is not self._taken:
            pausing = self._camera.time_held() if isinstance(self._camera, Pausing) else nullcontext()
            with pausing:
                self._taken, self._frame = taken, replace(taken, depth=self._treat(taken))
        return self._frame

    def stop(self) -> None:
        """See Camera."""
        self._camera.stop()

    def _treat(self, frame: Frame) -> Depth:
        if isinstance(self._treatment, Replacement):
            assert isinstance(self._camera, Simulated)
            return self._treatment.replace(frame.depth, self._camera.clean_mm)
        return self._treatment(frame.depth, self._colour(frame, self._treatment))

    def _colour(self, frame: Frame, treatment: Treatment) -> UInt8[np.ndarray, "h w 3"] | None:
        if not treatment.needs_rgb or frame.rgb is not None:
            return frame.rgb
        if not isinstance(self._camera, Filmed):
            raise CameraError("no colour with the frame")
        return self._camera.picture()


def treated(camera: Camera, treatment: Treatment | Replacement | None) -> Camera:
    """`camera` itself without a treatment."""
    return camera if treatment is None else TreatedCamera(camera, treatment)
