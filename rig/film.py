"""A film strip of a trial, for people: colour above, depth below, one column every few steps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8, UInt16

INVALID_RGB = (255, 0, 255)
LABEL_PX = 22


@dataclass(frozen=True)
class Film:
    """T columns of a trial."""

    steps: tuple[int, ...]
    rgb: UInt8[np.ndarray, "T H W 3"]
    """(T, H, W, 3) uint8."""
    depth_mm: UInt16[np.ndarray, "T H W"]
    """(T, H, W) uint16."""


def contact_sheet(film: Film, title: str) -> bytes:
    """PNG of the film; the step stands under the title, invalid depth is magenta."""
    import cv2

    strip = np.concatenate([_row(film.rgb), _row(_colored(film.depth_mm))], axis=0)
    header = np.full((2 * LABEL_PX, strip.shape[1], 3), 255, np.uint8)
    _write(header, title, 4, LABEL_PX - 6)
    width = film.rgb.shape[2]
    for column, step in enumerate(film.steps):
        _write(header, f"step {step}", column * width + 4, 2 * LABEL_PX - 6)
    sheet = np.concatenate([header, strip], axis=0)
    ok, data = cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    if not ok:
        raise RuntimeError("OpenCV could not encode the contact sheet as PNG")
    return data.tobytes()


def _row(frames: np.ndarray) -> np.ndarray:
    return np.concatenate(list(frames), axis=1)


def _colored(depth_mm: np.ndarray) -> np.ndarray:
    valid = depth_mm[depth_mm > 0]
    near, far = np.percentile(valid, (1, 99)) if valid.size else (0.0, 1.0)
    return colored(depth_mm, near, far)


def colored(depth_mm: UInt16[np.ndarray, "*T H W"], near: float, far: float) -> UInt8[np.ndarray, "*T H W 3"]:
    """(..., H, W, 3) uint8: bright at `near` (mm), dark at `far` and beyond, magenta where there is none."""
    import cv2

    nearness = np.clip((far - depth_mm.astype(np.float32)) / max(far - near, 1.0), 0, 1)
    grey = np.rint(255 * nearness).astype(np.uint8)
    flat = cv2.applyColorMap(grey.reshape(-1, 1), cv2.COLORMAP_VIRIDIS)
    rgb = cv2.cvtColor(flat, cv2.COLOR_BGR2RGB).reshape(*depth_mm.shape, 3)
    rgb[depth_mm == 0] = INVALID_RGB
    return rgb


def _write(image: np.ndarray, text: str, x: int, y: int) -> None:
    import cv2

    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
