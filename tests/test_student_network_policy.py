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
from mjx_envs import kinematics
from mjx_envs.camera import nominal_camera
from student_jax import denoiser, encoder, hand_view, policy, preprocess
from xla_support import optimized

PROFILE = contract.D455.scaled(0.25)
CONFIG = StudentConfig()
SMALL = replace(
    CONFIG,
    encoder=replace(CONFIG.encoder, width=8, stage_blocks=(1, 1), keypoints=8, features=32),
    head=replace(CONFIG.head, state_features=16, width=32, blocks=1, time_features=16),
)


def test_keypoint_on_a_cell_is_that_cell_s_point_in_the_world():
    """A one-hot attention on one cell with known relief must give the surface point seen there."""
    origin = jnp.array([[20, 60]])
    maps = encoder.cell_maps(origin, PROFILE, CONFIG)
    stride, columns = encoder.map_stride(CONFIG), CONFIG.picture.width_px // encoder.map_stride(CONFIG)
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


def test_stages_stop_striding_at_the_output_stride():
    resnet = replace(
        CONFIG,
        encoder=replace(CONFIG.encoder, width=64, stage_blocks=(2, 2, 2, 2), output_stride=32),
    )
    assert encoder.stage_plan(resnet) == [(64, 1), (128, 2), (256, 2), (512, 2)]
    narrow = replace(resnet, encoder=replace(resnet.encoder, output_stride=8, max_channels=128))
    assert encoder.stage_plan(narrow) == [
        (64, 1),
        (128, 2),
        (128, 1),
        (128, 1),
    ]
    assert encoder.map_stride(replace(resnet, encoder=replace(resnet.encoder, output_stride=16))) == 16


def test_resnet18_has_the_published_number_of_parameters():
    """torchvision's resnet18 has 11,176,512 in its convolutions and norms, for 3 input channels."""
    config = replace(
        CONFIG,
        encoder=replace(
            CONFIG.encoder,
            stem="conv7",
            width=64,
            stage_blocks=(2, 2, 2, 2),
            output_stride=32,
            pooling="mean",
        ),
        picture=replace(CONFIG.picture, channels=("relief",)),
        hand_view=replace(CONFIG.hand_view, size_px=0),
    )
    shapes = policy.param_shapes(config, PROFILE)["encoder"]
    del shapes["features"]
    assert sum(leaf.size for leaf in jax.tree.leaves(shapes)) == 11_176_512


def test_mean_pooling_ends_linearly_and_is_told_where_the_crop_window_is():
    """A relu of means that differ little dies: of 512 features 22 were left after 1,300 steps."""
    config = replace(SMALL, encoder=replace(SMALL.encoder, pooling="mean"))
    net = encoder.DepthEncoder(config, PROFILE)
    size = (4, config.picture.height_px, config.picture.width_px, 6)
    picture = jax.random.normal(jax.random.key(1), size)
    origin = jnp.array([PROFILE.crop_origin_px] * 4)
    params = net.init(jax.random.key(0), picture, origin)
    features, moved = (np.asarray(net.apply(params, picture, at)) for at in (origin, origin + 6))
    assert 0.2 < (features < 0).mean() < 0.8 and (features.std(axis=0) > 0).all()
    assert np.abs(moved - features).max() > 1e-3


def test_state_limits_map_to_minus_one_and_one():
    state = jnp.stack([denoiser.STATE_LOWER, denoiser.STATE_UPPER])
    np.testing.assert_allclose(denoiser.normalise_state(state), [[-1.0] * 9, [1.0] * 9], atol=1e-6)


def test_the_condition_is_joints_then_pose_then_offset_from_the_hand():
    params = policy.init_params(jax.random.key(0), SMALL, PROFILE)
    net = policy.StudentPolicy(SMALL, PROFILE)
    state = jnp.asarray([[*contract.HOME_RAD, 0.05, -0.01]])
    hand, _ = kinematics.grip_pose(np.array(contract.HOME_RAD))
    place = policy.position_from_world(jnp.asarray(hand + [0.0, 0.1, -0.05]))
    aux = policy.Aux(place[None], jnp.array([[0.6, 0.8]]), jnp.array([2.0]))
    seen = policy.Seen(jnp.ones((1, policy.feature_count(SMALL))), aux)

    def condition(config):
        cond = policy.StudentPolicy(config, PROFILE).apply(
            {"params": params}, seen, state, method="condition"
        )
        return np.asarray(cond)[0]

    joints = np.asarray(net.apply({"params": params}, state, method=lambda m, s: m.state_stream(s)))[0]
    held = 1 / (1 + np.exp(-2.0))
    expected = np.concatenate([joints, place, [0.6, 0.8, held], [0.0, 2.0, -1.0]])  # units of 5 cm
    np.testing.assert_allclose(condition(SMALL), expected, atol=1e-5)
    both = condition(replace(SMALL, head=replace(SMALL.head, features_to_head=True)))
    assert both.shape[0] == len(expected) + policy.feature_count(SMALL)
    with pytest.raises(UserError, match="features_to_head and student.head.aux_to_head are both off"):
        condition(replace(SMALL, head=replace(SMALL.head, aux_to_head=False)))


def test_the_hand_view_decides_how_much_the_hand_counts():
    """With the gate open the position is hand + 5 cm * offset, with it closed the raw output."""
    params = policy.init_params(jax.random.key(0), SMALL, PROFILE)
    output = {"kernel": jnp.zeros_like(params["aux_output"]["kernel"])}
    state = jnp.asarray([[*contract.HOME_RAD, 0.05, -0.01]])
    hand, _ = kinematics.grip_pose(np.array(contract.HOME_RAD))
    picture = jnp.zeros((1, SMALL.picture.height_px, SMALL.picture.width_px, 6))
    net = policy.StudentPolicy(SMALL, PROFILE)

    def position(gate):
        bias = jnp.array([0.1, 0.2, 0.3, 0, 0, 0, 1.0, 0.0, -2.0, gate])
        seen = net.apply(
            {"params": {**params, "aux_output": {**output, "bias": bias}}}, picture, state,
            method="encode_picture",
        )  # fmt: skip
        return np.asarray(policy.position_to_world(seen.aux.position))[0]

    np.testing.assert_allclose(position(50.0), hand + [0.05, 0.0, -0.1], atol=1e-5)
    np.testing.assert_allclose(
        position(-50.0), policy.position_to_world(jnp.array([0.1, 0.2, 0.3])), atol=1e-5
    )


def test_the_hand_view_shows_what_lies_beside_the_hand():
    """A point 3 cm beside the hand, across the camera's axis, is 3 cm / pitch samples from the middle."""
    config = replace(CONFIG, hand_view=replace(CONFIG.hand_view, pitch_m=0.005))
    origin = np.array(PROFILE.crop_origin_px) + [3, -4]
    camera = nominal_camera(PROFILE)
    right, down = camera.T_world_cam[:3, 0], camera.T_world_cam[:3, 1]
    hand = np.array([0.5, 0.02, 0.1])
    point = hand + 0.03 * right - 0.02 * down
    seen = np.linalg.inv(camera.T_world_cam)[:3] @ [*point, 1.0]
    u = PROFILE.fx_px * seen[0] / seen[2] + PROFILE.cx_px - origin[1]
    v = PROFILE.fy_px * seen[1] / seen[2] + PROFILE.cy_px - origin[0]
    picture = np.zeros((1, config.picture.height_px, config.picture.width_px, 6), np.float32)
    rows, columns = np.mgrid[: picture.shape[1], : picture.shape[2]] + 0.5
    picture[0, :, :, 1::2] = 1.0  # valid everywhere
    picture[0, :, :, 4] = np.exp(-((rows - v) ** 2 + (columns - u) ** 2) / 8)  # relief of the newest frame
    placed = hand_view.place(jnp.asarray(hand)[None], jnp.asarray(origin)[None], PROFILE, config)
    view = np.asarray(hand_view.cut(jnp.asarray(picture), *placed, config))[0, :, :, 4]
    middle = (config.hand_view.size_px - 1) / 2
    sample = (np.indices(view.shape) * view).sum((1, 2)) / view.sum() - middle
    np.testing.assert_allclose(sample, [-0.02 / 0.005, 0.03 / 0.005], atol=0.1)


def test_the_hand_view_ignores_invalid_pixels_and_what_is_outside():
    picture = np.full((1, CONFIG.picture.height_px, CONFIG.picture.width_px, 6), 0.7, np.float32)
    picture[..., 1::2] = 1.0
    picture[:, :, ::2] = 0.0  # every second column has no reading
    centre, per_metre = jnp.array([[56.0, 144.0]]), jnp.array([[300.0, 300.0]])  # at the right edge
    view = np.asarray(hand_view.cut(jnp.asarray(picture), centre, per_metre, CONFIG))[0]
    relief, share = view[10:-10, :20, ::2], view[10:-10, :20, 1::2]
    assert np.all(view[:, 30:] == 0)
    assert share.mean() == pytest.approx(0.5, abs=0.05)
    np.testing.assert_allclose(relief[share > 0.25], 0.7, rtol=1e-4)


def test_the_chain_of_the_exported_graph_ends_between_the_finger_pads():
    q = np.random.default_rng(0).uniform(-1, 1, 7)
    point = hand_view.grip_tip()
    for angle, (rotation, offset) in zip(q[::-1], hand_view.grip_chain()[::-1], strict=True):
        c, s = np.cos(angle), np.sin(angle)
        point = rotation @ (np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ point) + offset
    np.testing.assert_allclose(point, kinematics.grip_pose(q)[0], atol=1e-9)


def test_unknown_options_name_the_nearest():
    with pytest.raises(UserError, match="Did you mean 'spatial_softmax'"):
        replace(CONFIG.encoder, pooling="spatial_sofmax")
    with pytest.raises(UserError, match="needs 'relief'"):
        replace(CONFIG, picture=replace(CONFIG.picture, channels=("depth", "valid")))
    with pytest.raises(UserError, match="ddim_steps is 60; expected 1 to 50"):
        replace(CONFIG.head, ddim_steps=60)


def disc_scene(rng: np.random.Generator, batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Discs of 5 cm above the table at random places, 10 % dropped pixels, random crops."""
    camera, table = nominal_camera(PROFILE), preprocess.table_depth(PROFILE, CONFIG.picture.max_depth_m)
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
    config = replace(
        SMALL,
        encoder=replace(SMALL.encoder, width=16, keypoints=16, features=64),
        hand_view=replace(SMALL.hand_view, size_px=0),
    )
    net = policy.StudentPolicy(config, PROFILE)
    params = policy.init_params(jax.random.key(0), config, PROFILE)
    optimiser = optax.adam(3e-3)

    @jax.jit
    def step(params, moments, frames, crop, place):
        def loss(p):
            seen = net.apply({"params": p}, frames, jnp.zeros((32, 9)), crop, method="encode")
            error = seen.aux.position - policy.position_from_world(place)
            return jnp.mean(error**2), jnp.linalg.norm(error, axis=-1).mean() * encoder.POSITION_SCALE_M

        gradient, error_m = jax.grad(loss, has_aux=True)(params)
        update, moments = optimiser.update(gradient, moments, params)
        return optax.apply_updates(params, update), moments, error_m

    batches = [disc_scene(rng, 32) for _ in range(20)]
    moments = optimiser.init(params)
    with optimized():
        for index in range(80):
            params, moments, _ = step(params, moments, *batches[index % len(batches)])
    unseen = disc_scene(rng, 32)
    assert float(step(params, moments, *unseen)[2]) < 0.04
