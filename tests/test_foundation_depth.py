"""Depth networks as they are used: in parts, batched, streamed; on a network small enough for a test."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import network_graphs, networks
from ddgrasp.errors import UserError
from foundation import long_video, pictures
from foundation.depth import DepthNetwork, predict
from foundation.sizes import DepthSize
from foundation.video import stream

TINY = DepthSize("tiny", 64, 4, (0, 1, 2, 3), 32, (32, 32, 32, 32))
VIDEO = DepthNetwork(TINY, video=True)
IMAGE = DepthNetwork(TINY, video=False)
SIZE = 28


@pytest.fixture(scope="module")
def params():
    """Of the video network, drawn so that every part matters and depth is positive."""
    rng = np.random.default_rng(0)

    def draw(path, shape):
        array = rng.normal(0, 1, shape.shape) / np.sqrt(max(1, np.prod(shape.shape[:-1])))
        leaf = path[-1].key
        if leaf in ("scale", "gamma"):
            array = 1 + 0.1 * array
        if any(getattr(key, "key", "") == "scratch.output_conv2.2" for key in path) and leaf == "bias":
            array = array + 3
        return jnp.asarray(array, jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, VIDEO.param_shapes())


@pytest.fixture(scope="module")
def clip():
    rng = np.random.default_rng(1)
    base = rng.integers(0, 256, (30, 40, 3))
    return np.stack([np.roll(base, frame, 1) for frame in range(40)]).astype(np.uint8)


def test_clips_in_a_batch_and_in_parts_are_what_each_is_alone(params, clip):
    both = predict(replace(VIDEO, frames_at_once=4), params, np.stack([clip[:3], clip[10:13]]), SIZE)
    assert both.shape == (2, 3, 30, 40) and both.min() > 0 and both.std() > 0.05
    for index, start in enumerate((0, 10)):
        alone = predict(VIDEO, params, clip[None, start : start + 3], SIZE)[0]
        np.testing.assert_allclose(both[index], alone, atol=3e-5)


def test_untrained_motion_modules_change_nothing(params, clip):
    last, silent = "temporal_transformer.proj_out", dict(params["head"])
    for name in (f"motion_modules.{index}" for index in range(4)):
        silent[name] = silent[name] | {last: jax.tree.map(jnp.zeros_like, silent[name][last])}
    video = predict(VIDEO, params | {"head": silent}, clip[None, :3], SIZE)[0]
    image = predict(IMAGE, {"pretrained": params["pretrained"], "depth_head": silent}, clip[:3], SIZE)
    np.testing.assert_allclose(video, image, atol=3e-5)
    moving = predict(VIDEO, params, clip[None, :3], SIZE)[0]
    assert np.abs(moving - image).max() > 0.01


def test_bfloat16_is_near_float32(params, clip):
    exact = np.asarray(predict(VIDEO, params, clip[None, :3], SIZE))
    rounded = predict(replace(VIDEO, dtype="bfloat16"), params, clip[None, :3], SIZE)
    assert rounded.dtype == jnp.float32
    error = np.abs(np.asarray(rounded) - exact).mean() / exact.std()
    assert 1e-4 < error < 0.15


def test_wrong_shapes_are_named(params):
    with pytest.raises(UserError, match="30 x 40"):
        IMAGE(params, jnp.zeros((1, 30, 40, 3)))
    with pytest.raises(UserError, match="33 frames"):
        VIDEO(params, jnp.zeros((1, 33, 28, 28, 3)))
    with pytest.raises(UserError, match="Did you mean 'float32'"):
        replace(VIDEO, dtype="float23")
    with pytest.raises(UserError, match="0 x 40"):
        pictures.network_size(0, 40, 518, video=False)


@pytest.mark.parametrize("network", [VIDEO, IMAGE])
def test_the_benchmark_s_graph_computes_what_the_network_does(params, network):
    """benchmarks/network_graphs.py, by onnxruntime."""
    weights = {"pretrained": params["pretrained"], network.head: params["head"]}
    x = np.random.default_rng(2).normal(size=(3, SIZE, 2 * SIZE, 3)).astype(np.float32)
    nchw = np.ascontiguousarray(np.moveaxis(x, -1, 1))
    session = networks.open_session(network_graphs.depth_model(network, weights, nchw.shape))
    (made,) = session.run(None, {network_graphs.INPUT: nchw})
    wanted = np.asarray(jax.jit(network)(weights, x[None] if network.video else x)).reshape(3, SIZE, 2 * SIZE)
    assert wanted.std() > 0.05
    np.testing.assert_allclose(np.asarray(made)[:, 0], wanted, atol=1e-4)


# --- long videos ---------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 40])
def test_streaming_is_the_windows_stitched(params, clip, count):
    frames = long_video.window_frames(count)
    windows = (np.asarray(predict(VIDEO, params, clip[None, row], SIZE))[0] for row in frames)
    wanted = np.stack(list(long_video.stitch(windows, count)))
    streamed = np.stack(list(stream(VIDEO, params, iter(clip[:count]), SIZE)))
    assert streamed.shape == (count, 30, 40)
    np.testing.assert_allclose(streamed, wanted, atol=2e-5)


def test_streaming_reads_no_further_than_a_window_ahead(params, clip):
    read = 0

    def camera():
        nonlocal read
        for index in range(80):
            read += 1
            yield clip[index % len(clip)]

    ahead = [read - index for index, _ in enumerate(stream(VIDEO, params, camera(), SIZE))]
    assert len(ahead) == 80 and max(ahead) == long_video.WINDOW


def test_windows_of_another_scale_are_brought_to_the_first():
    truth = np.random.default_rng(0).uniform(1, 2, (76, 4, 5)).astype(np.float32)
    frames = long_video.window_frames(76)
    windows = [(1 + k) * truth[row] + k for k, row in enumerate(frames)]
    assert len(windows) == 4
    np.testing.assert_allclose(list(long_video.stitch(windows, 76)), truth, atol=1e-5)


def test_scale_and_shift_by_hand():
    assert long_video.fit_scale_shift(np.array([0.0, 1, 2]), np.array([3.0, 5, 7])) == pytest.approx((2, 3))
    assert long_video.fit_scale_shift(np.full(3, 4.0), np.array([3.0, 5, 7])) == (1.0, 0.0)


def test_input_sizes():
    assert pictures.network_size(1080, 1920, 518, video=False) == (518, 924)
    assert pictures.network_size(436, 1024, 518, video=True) == (392, 924)
    assert pictures.network_size(180, 320, 280, video=True) == (280, 504)
