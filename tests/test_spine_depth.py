"""Millimetres and metres, and which pixels nearest neighbours are: one definition, with its edges."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp import depth
from ddgrasp.errors import UserError

NAN, INF = np.nan, np.inf


def test_every_millimetre_comes_back():
    mm = np.arange(65536, dtype=np.uint16)
    metres = depth.to_metres(mm)
    assert metres.dtype == np.float32
    np.testing.assert_array_equal(metres, mm.astype(np.float32) * np.float32(0.001))
    np.testing.assert_array_equal(depth.to_millimetres(metres), mm)
    np.testing.assert_array_equal(depth.from_counts(mm, 0.001), mm)


EDGES = [
    (0.0, 0), (-0.0, 0), (1.0, 1000), (65.535, 65535),
    (0.0005, 0), (0.0015, 2), (0.0025, 2),  # half a millimetre: to the even one
    (-0.0004, 0), (-1.0, 0), (65.5351, 65535), (65.5359, 0), (70.0, 0), (1e30, 0),
    (NAN, 0), (INF, 0), (-INF, 0),
]  # fmt: skip


@pytest.mark.parametrize(("metres", "mm"), EDGES)
def test_what_does_not_fit_is_no_reading(metres, mm):
    for dtype in (np.float32, np.float64):
        made = depth.to_millimetres(np.full((2, 3), metres, dtype))
        assert made.dtype == np.uint16 and made.shape == (2, 3) and (made == mm).all()


def test_jax_converts_as_numpy_does_compiled_or_not():
    metres = np.array([m for m, _ in EDGES] + list(np.linspace(0, 12, 1001)), np.float32)
    expected = depth.to_millimetres(metres)
    for convert in (depth.to_millimetres, jax.jit(depth.to_millimetres, static_argnums=1)):
        made = convert(jnp.asarray(metres), jnp)
        assert made.dtype == jnp.uint16
        # compiled, XLA multiplies by the reciprocal: half millimetres may fall either way, nothing else
        halves = np.abs(np.nan_to_num(metres, posinf=0, neginf=0) * 1000 % 1 - 0.5) < 1e-3
        np.testing.assert_array_equal(np.asarray(made)[~halves], expected[~halves])
    mm = np.arange(65536, dtype=np.uint16)
    np.testing.assert_array_equal(jax.jit(depth.to_metres)(mm), depth.to_metres(mm))
    np.testing.assert_array_equal(jax.jit(lambda d: depth.to_millimetres(depth.to_metres(d), jnp))(mm), mm)


def test_counts_of_another_unit():
    np.testing.assert_array_equal(
        depth.from_counts(np.array([0, 4, 5, 15, 65535], np.uint16), 1e-4), [0, 0, 0, 2, 6554]
    )
    np.testing.assert_array_equal(
        depth.from_counts(np.array([7, 6553, 6554], np.uint16), 0.01), [70, 65530, 0]
    )
    np.testing.assert_array_equal(
        depth.from_counts(np.array([0.5, NAN, INF, -1, 66], np.float32), 1.0), [500, 0, 0, 0, 0]
    )
    almost = np.float32(0.001)  # what a device reports for a millimetre
    mm = np.arange(65536, dtype=np.uint16)
    np.testing.assert_array_equal(depth.from_counts(mm, float(almost)), mm)


def test_counts_are_copied():
    raw = np.ones((2, 2), np.uint16)
    made = depth.from_counts(raw, 0.001)
    raw[:] = 9
    assert (made == 1).all()


PICKED = {
    (12, 6): [1, 3, 5, 7, 9, 11],
    (12, 4): [1, 4, 7, 10],
    (12, 8): [0, 2, 3, 5, 6, 8, 9, 11],
    (6, 12): [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5],
    (4, 12): [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3],
    (8, 12): [0, 1, 1, 2, 3, 3, 4, 5, 5, 6, 7, 7],
}
"""(from, to) pixels of an axis -> the pixels picked: factors 2, 3 and 1.5, down and up."""
PICKED_BY_OPENCV = {
    (12, 6): [0, 2, 4, 6, 8, 10],
    (12, 4): [0, 3, 6, 9],
    (12, 8): [0, 1, 3, 4, 6, 7, 9, 10],
    (6, 12): PICKED[6, 12],
    (4, 12): PICKED[4, 12],
    (8, 12): [0, 0, 1, 2, 2, 3, 4, 4, 5, 6, 6, 7],
}
"""What sampling used until it shared this function with training: another pixel wherever a map shrinks."""


@pytest.mark.parametrize(("had", "wanted"), PICKED)
def test_the_pixel_under_the_centre_is_picked(had, wanted):
    ramp = np.arange(had, dtype=np.float32)
    rows, columns = np.repeat(ramp[:, None], 3, 1), np.repeat(ramp[None], 3, 0)
    assert depth.resize_nearest(rows, (wanted, 3))[:, 0].tolist() == PICKED[had, wanted]
    assert depth.resize_nearest(columns, (3, wanted))[0].tolist() == PICKED[had, wanted]
    as_jax = jax.jit(depth.resize_nearest, static_argnums=1)(columns[None, None], (3, wanted))
    assert as_jax.shape == (1, 1, 3, wanted) and as_jax[0, 0, 0].tolist() == PICKED[had, wanted]
    assert jax.image.resize(ramp, (wanted,), "nearest").tolist() == PICKED[had, wanted]
    theirs = cv2.resize(columns, (wanted, 3), interpolation=cv2.INTER_NEAREST)[0]
    assert theirs.tolist() == PICKED_BY_OPENCV[had, wanted]


def test_the_presets_sizes():
    frame = np.arange(180 * 320).reshape(180, 320)
    assert depth.resize_nearest(frame, (180, 320)) is frame
    np.testing.assert_array_equal(depth.resize_nearest(frame, (90, 160)), frame[1::2, 1::2])
    np.testing.assert_array_equal(depth.crop_nearest(frame, (90, 160)), frame[1::2, 1::2])
    real = np.arange(480 * 640).reshape(480, 640)
    np.testing.assert_array_equal(depth.crop_nearest(real, (180, 320)), real[61:421:2, 1::2])
    np.testing.assert_array_equal(depth.crop_nearest(real, (240, 320)), real[1::2, 1::2])
    np.testing.assert_array_equal(depth.crop_nearest(real, (20, 10)), real[12::24, 212:444:24])


def test_shrinking_what_was_enlarged_gives_it_back():
    rng = np.random.default_rng(0)
    for size, larger in (((9, 16), (18, 32)), ((9, 16), (27, 48)), ((7, 5), (20, 31))):
        frames = rng.random((2, *size))
        np.testing.assert_array_equal(
            depth.resize_nearest(depth.resize_nearest(frames, larger), size), frames
        )


@pytest.mark.parametrize("xp", [np, jnp])
def test_depth_in_the_other_unit_is_refused(xp):
    with pytest.raises(UserError, match=r"float32; expected whole millimetres"):
        depth.to_metres(xp.full((2, 2), 0.9, xp.float32))
    with pytest.raises(UserError, match=r"uint16; expected metres"):
        depth.to_millimetres(xp.full((2, 2), 900, xp.uint16), xp)
