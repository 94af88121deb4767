"""One kind of a camera's errors at a time, in depth that is true otherwise."""

import numpy as np
import pytest

from ddgrasp.presets import get_preset
from rig.camera_errors import ERRORS, MISMATCH_PX, SMALL_PX, ErrorName, only

PROFILE = get_preset("demo").world.profile
SHAPE = (PROFILE.height_px, PROFILE.width_px)
TRUE_MM = 1000


def _sensed() -> np.ndarray:
    """A wall a metre away with a hole of 4 x 4 pixels, one of 17 in a row, one of 18 that holds together by a
    corner, a ripple and a mismatch."""
    depth = np.full(SHAPE, TRUE_MM, np.uint16)
    depth[10:14, 10:14] = 0
    depth[20, 10:27] = 0
    depth[30:33, 10:13] = depth[33:36, 13:16] = 0
    depth[50, 50], depth[60, 60] = _off_by(0.5 * MISMATCH_PX), _off_by(2 * MISMATCH_PX)
    return depth


def _off_by(disparity_px: float) -> int:
    scale = PROFILE.fx_px * PROFILE.baseline_m * 1e3
    return round(scale / (scale / TRUE_MM - disparity_px))


@pytest.mark.parametrize(
    ("errors", "holes", "values"),
    [
        ("holes", 16 + 17 + 18, ()),
        ("small holes", 16, ()),
        ("large holes", 17 + 18, ()),
        ("values", 0, ((50, 50), (60, 60))),
        ("ripple", 0, ((50, 50),)),
        ("mismatches", 0, ((60, 60),)),
    ],
)
def test_one_kind_is_left_of_what_a_camera_has_wrong(errors: ErrorName, holes: int, values: tuple):
    sensed, clean = _sensed(), np.full(SHAPE, TRUE_MM, np.uint16)
    seen = only(errors, sensed, clean, PROFILE)
    assert SMALL_PX == 16 and np.sum(seen == 0) == holes
    assert np.all(sensed[seen == 0] == 0)
    assert [tuple(place) for place in np.argwhere((seen != TRUE_MM) & (seen > 0))] == list(values)


def test_every_kind_is_tried_above():
    (marked,) = test_one_kind_is_left_of_what_a_camera_has_wrong.pytestmark
    assert {case[0] for case in marked.args[1]} == set(ERRORS)
