"""A picture file's content as an array, or None: whatever it is damaged by, OpenCV ends nothing."""

import cv2
import numpy as np


def decoded(data: bytes, how: int = cv2.IMREAD_COLOR) -> np.ndarray | None:
    """(H, W) or (H, W, C) pixels of a PNG, JPEG or TIFF, colour in OpenCV's order; None of what is none.

    Args:
      data: the whole file.
      how: a cv2.IMREAD_* flag.
    """
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), how)
    except cv2.error:  # nothing in it, or a header that claims more than OpenCV's 2^30 pixels
        return None
