"""What may be done to recorded depth on its way to the policy: a camera that hands out treated frames."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from ddgrasp.errors import UserError
from deploy.interfaces import Camera, CameraError, Depth, Filmed, Frame
from sensors.inpainting import RADIUS_PX, inpainted


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

    def __init__(self, camera: Camera, treatment: Treatment):
        """Raises UserError if the treatment needs colour and the camera gives none."""
        if treatment.needs_rgb and not isinstance(camera, Filmed):
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
            depth = self._treatment(taken.depth, self._colour(taken))
            self._taken, self._frame = taken, replace(taken, depth=depth)
        return self._frame

    def stop(self) -> None:
        """See Camera."""
        self._camera.stop()

    def _colour(self, frame: Frame) -> UInt8[np.ndarray, "h w 3"] | None:
        if not self._treatment.needs_rgb or frame.rgb is not None:
            return frame.rgb
        if not isinstance(self._camera, Filmed):
            raise CameraError("no colour with the frame")
        return self._camera.picture()


def treated(camera: Camera, treatment: Treatment | None) -> Camera:
    """`camera` itself without a treatment."""
    return camera if treatment is None else TreatedCamera(camera, treatment)
