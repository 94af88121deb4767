"""Student network: keypoints in the robot's frame, diffusion by value, learning on a small task."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ddgrasp import contract
from ddgrasp.config import StudentConfig
from ddgrasp.errors import UserError
from mjx_envs.camera import nominal_camera
from student_jax import denoiser, diffusion, encoder, policy, preprocess

PROFILE = contract.D455.scaled(0.25)
CONFIG = StudentConfig()
SMALL = replace(
    CONFIG, width=8, stage_blocks=(1, 1), keypoints=8, feature_size=32, state_features=16,
    denoiser_width=32, denoiser_blocks=1, time_features=16,
)  # fmt: skip


def test_keypoint_on_a_cell_is_that_cell_s_point_in_the_world():
    """A one-hot attention on one cell with known relief must give the surface point seen there."""
    origin = jnp.array([[20, 60]])
    maps = encoder.cell_maps(origin, PROFILE, CONFIG)
    stride, columns = encoder.map_stride(CONFIG), CONFIG.input_width_px // encoder.map_stride(CONFIG)
    row, column, relief = 5, 7, 0.8
    logits = np.full((1, maps.shape[1], 1), -1e9, np.float32)
    logits[0, row * columns + column] = 0.0
    point = encoder.spatial_softmax(logits, jnp.full((1, maps.shape[1]), relief), maps)[0, 0]

    v, u = 20 + (row + 0.5) * stride, 60 + (column + 0.5) * stride  # the window is trimmed on the right only
    camera = nominal_camera(PROFILE)
    ray = camera.T_world_cam[:3, :3] @ [
        (u - PROFILE.cx_px) / PROFILE.fx_px, (v - PROFILE.cy_px) / PROFILE.fy_px, 1.0,
    ]  # fmt: skip
    depth = camera.T_world_cam[2, 3] / -ray[2] - relief * preprocess.RELIEF_SCALE_M
    world = camera.T_world_cam[:3, 3] + depth * ray
    np.testing.assert_allclose(point[:2], [2 * v / 180 - 1, 2 * u / 320 - 1], atol=1e-5)
    np.testing.assert_allclose(point[2], relief, atol=1e-5)
    np.testing.assert_allclose(policy.position_to_world(point[3:]), world, atol=1e-5)


def test_static_maps_equal_the_centred_dynamic_ones():
    origin = jnp.array([PROFILE.crop_origin_px])
    dynamic = encoder.cell_maps(origin, PROFILE, CONFIG)[0]
    np.testing.assert_allclose(encoder.static_cell_maps(PROFILE, CONFIG), dynamic, atol=1e-5)


def test_cell_relief_averages_valid_pixels_of_the_newest_frame():
    picture = np.zeros((1, 112, 144, 6), np.float32)
    picture[0, :8, :8, 4] = np.where(np.arange(8) < 2, 1.5, 0.0)  # two valid columns of eight
    picture[0, :8, :8, 5] = np.arange(8) < 2
    picture[0, :8, 8:16, 0] = 9.0  # an older frame
    relief = np.asarray(encoder.cell_relief(jnp.asarray(picture), CONFIG))
    assert relief[0, 0] == pytest.approx(1.5)
    assert np.all(relief[0, 1:] == 0.0)


def test_group_norm_matches_flax():
    from flax import linen as nn

    x = jax.random.normal(jax.random.key(0), (2, 5, 7, 16)) * 3 + 1
    ours = encoder.GroupNorm().apply({"params": {"scale": jnp.ones(16), "bias": jnp.zeros(16)}}, x)
    flax_norm = nn.GroupNorm(num_groups=2, epsilon=encoder.EPSILON)
    np.testing.assert_allclose(ours, flax_norm.apply(flax_norm.init(jax.random.key(1), x), x), atol=1e-5)


def test_space_to_depth_by_hand():
    x = jnp.arange(2 * 4 * 1).reshape(1, 2, 4, 1)
    assert np.asarray(encoder.space_to_depth(x, 2))[0, 0].tolist() == [[0, 1, 4, 5], [2, 3, 6, 7]]


def test_stages_stop_striding_at_the_output_stride():
    resnet = replace(CONFIG, width=64, stage_blocks=(2, 2, 2, 2), output_stride=32)
    assert encoder.stage_plan(resnet) == [(64, 1), (128, 2), (256, 2), (512, 2)]
    assert encoder.stage_plan(replace(resnet, output_stride=8, max_channels=128)) == [
        (64, 1), (128, 2), (128, 1), (128, 1),
    ]  # fmt: skip
    assert encoder.map_stride(replace(resnet, output_stride=16)) == 16


def test_resnet18_has_the_published_number_of_parameters():
    """torchvision's resnet18 has 11,176,512 in its convolutions and norms, for 3 input channels."""
    config = replace(
        CONFIG,
        stem="conv7",
        width=64,
        stage_blocks=(2, 2, 2, 2),
        output_stride=32,
        pooling="mean",
        channels=("relief",),
    )
    shapes = policy.param_shapes(config, PROFILE)["encoder"]
    del shapes["features"]
    assert policy.count_params(shapes) == 11_176_512


def test_state_limits_map_to_minus_one_and_one():
    state = jnp.stack([denoiser.STATE_LOWER, denoiser.STATE_UPPER])
    np.testing.assert_allclose(denoiser.normalise_state(state), [[-1.0] * 8, [1.0] * 8], atol=1e-6)


def test_time_embedding_by_value():
    embedded = denoiser.embed_time(jnp.array([0, 3]), 4)
    np.testing.assert_allclose(embedded[0], [0, 0, 1, 1], atol=1e-6)
    np.testing.assert_allclose(embedded[1], [np.sin(3), np.sin(0.03), np.cos(3), np.cos(0.03)], atol=1e-6)


def test_schedule_falls_from_almost_one_to_almost_zero():
    schedule = diffusion.cosine_alpha_bar(50)
    assert schedule[0] > 0.99 and np.all(np.diff(schedule) < 0)
    assert np.sqrt(schedule[-1]) == pytest.approx(0.0310, abs=1e-3)


@pytest.mark.parametrize("iterations", [1, 3, 10])
def test_ddim_with_perfect_noise_prediction_returns_the_clean_sample(iterations):
    schedule = jnp.asarray(diffusion.cosine_alpha_bar(50))
    x0 = jax.random.uniform(jax.random.key(0), (5, 4, 8), minval=-1, maxval=1)

    def predict(x, k):
        a = schedule[k][:, None, None]
        return (x - jnp.sqrt(a) * x0) / jnp.sqrt(1 - a)

    noise = jax.random.normal(jax.random.key(1), x0.shape)
    sampled = diffusion.ddim_sample(predict, noise, np.asarray(schedule), iterations)
    np.testing.assert_allclose(sampled, x0, atol=1e-4)


def test_ddim_step_clips_and_keeps_explaining_x():
    row = jnp.array([2.0, np.sqrt(3.0), 0.8, 0.6])  # a = 1/4, a' = 0.64
    x, eps = jnp.array([1.0]), jnp.array([-1.0])  # x0 = 2 + 1.73, clipped to 1
    # eps' = (2 * 1 - 1) / sqrt(3); x' = 0.8 * 1 + 0.6 * eps'
    np.testing.assert_allclose(diffusion.ddim_step(x, eps, row), [0.8 + 0.6 / np.sqrt(3.0)], rtol=1e-6)


def test_auxiliary_predictions_reach_the_head_and_stop_gradient_stops():
    def head_gradient(config):
        params = policy.init_params(jax.random.key(0), config, PROFILE)
        net = policy.StudentPolicy(config, PROFILE)
        picture = jax.random.normal(jax.random.key(1), (2, 112, 144, 6))

        def loss(p):
            seen = net.apply({"params": p}, picture, jnp.zeros((2, 8)), method="encode_picture")
            return seen.cond[:, -policy.AUX_SIZE :].sum()

        return float(jnp.abs(jax.jit(jax.grad(loss))(params)["aux_output"]["bias"]).sum())

    assert head_gradient(SMALL) == pytest.approx(2 * policy.AUX_SIZE)
    assert head_gradient(replace(SMALL, aux_stop_gradient=True)) == 0.0


def test_unknown_options_name_the_nearest():
    with pytest.raises(UserError, match="Did you mean 'spatial_softmax'"):
        encoder.check_encoder(replace(CONFIG, pooling="spatial_sofmax"))
    with pytest.raises(UserError, match="needs 'relief'"):
        encoder.check_encoder(replace(CONFIG, channels=("depth", "valid")))
    with pytest.raises(UserError, match="ddim_steps is 60; expected 1 to 50"):
        denoiser.check_denoiser(replace(CONFIG, ddim_steps=60))


def scene(rng: np.random.Generator, batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Discs of 5 cm above the table at random places, 10 % dropped pixels, random crops."""
    camera, table = nominal_camera(PROFILE), preprocess.table_depth(PROFILE, CONFIG.max_depth_m)
    rows, columns = np.mgrid[: PROFILE.height_px, : PROFILE.width_px] + 0.5
    rays = np.stack([(columns - PROFILE.cx_px) / PROFILE.fx_px, (rows - PROFILE.cy_px) / PROFILE.fy_px], -1)
    rays = np.concatenate([rays, np.ones_like(rays[..., :1])], -1) @ camera.T_world_cam[:3, :3].T
    place = rng.uniform((0.4, -0.15, 0.05), (0.6, 0.15, 0.05), (batch, 3))
    depth = (camera.T_world_cam[2, 3] - 0.05) / -rays[..., 2]
    hit = camera.T_world_cam[:2, 3] + depth[..., None] * rays[..., :2]
    inside = ((hit - place[:, None, None, :2]) ** 2).sum(-1) < 0.03**2
    seen = np.where(inside, depth, table) * (rng.random((batch, *table.shape)) > 0.1)
    frames = np.repeat(seen[:, None], contract.DEPTH_FRAMES, axis=1).astype(np.float32)
    crop = np.array(PROFILE.crop_origin_px) + rng.integers(-8, 9, (batch, 2))
    return frames, crop, place.astype(np.float32)


def test_the_encoder_learns_where_an_object_is_within_seconds():
    """Chance is 10 cm; 80 steps of 32 pictures must bring unseen ones under 4 cm."""
    rng = np.random.default_rng(0)
    config = replace(SMALL, width=16, keypoints=16, feature_size=64)
    net = policy.StudentPolicy(config, PROFILE)
    params = policy.init_params(jax.random.key(0), config, PROFILE)
    optimiser = optax.adam(3e-3)

    @jax.jit
    def step(params, moments, frames, crop, place):
        def loss(p):
            seen = net.apply({"params": p}, frames, jnp.zeros((32, 8)), crop, method="encode")
            error = seen.aux.position - policy.position_from_world(place)
            return jnp.mean(error**2), jnp.linalg.norm(error, axis=-1).mean() * encoder.POSITION_SCALE_M

        gradient, error_m = jax.grad(loss, has_aux=True)(params)
        update, moments = optimiser.update(gradient, moments, params)
        return optax.apply_updates(params, update), moments, error_m

    batches = [scene(rng, 32) for _ in range(20)]
    moments = optimiser.init(params)
    for index in range(80):
        params, moments, _ = step(params, moments, *batches[index % len(batches)])
    unseen = scene(rng, 32)
    assert float(step(params, moments, *unseen)[2]) < 0.04
