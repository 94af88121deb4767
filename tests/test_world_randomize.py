"""Each range of RandomConfig moves what it names, over its whole width, and nothing else."""

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.config import RandomConfig, WorldConfig
from ddgrasp.layout import OBSERVATION, QPOS, QVEL
from mjx_envs import draws, grasp_math, kinematics, randomize, scene
from mjx_envs.camera import nominal_camera
from mjx_envs.grasp_env import AutoReset, GraspEnv
from mjx_envs.objects import OBJECTS
from mjx_envs.physics import interface as physics
from rig.world import RigWorld

COUNT = 400
NOTHING = RandomConfig(**{field.name: 0 for field in fields(RandomConfig)})
CAMERA = nominal_camera(contract.D455).T_world_cam
CUBE = OBJECTS["cube"]

MOVES = {
    "joint_rad": {"joints": (-0.1, 0.1)},
    "pregrasp_share": {"joints": None},
    "size": {"size": (0.95, 1.05), "slots": (0.95, 1.05), "object_inertia": (0.95**2, 1.05**2)},
    "object_mass": {"object_mass": (0.7, 1.3), "object_inertia": (0.7, 1.3)},
    "object_friction": {"object_friction": (0.8, 1.2)},
    "link_mass": {"link_mass_scale": (0.9, 1.1)},
    "damping": {"joint_damping": (0.7, 1.3)},
    "friction_nm": {"joint_friction": (0.0, 0.3)},
    "stiffness": {"gain_scale": (0.9, 1.1)},
    "camera_position_m": {"camera_position": (-0.01, 0.01)},
    "camera_angle_rad": {"camera_angle": (-0.015, 0.015)},
}
"""Field -> what it moves at its default, with the bounds (relative to nominal, or absolute where nominal is
0)."""


@pytest.fixture(scope="module")
def table():
    return randomize.ObjectTable(("cube",))


@pytest.fixture(scope="module")
def sampler(table):
    """RandomConfig -> quantity -> (COUNT, ...) draws; object pose is drawn in any case and left out."""

    names = [field.name for field in fields(RandomConfig)]

    @jax.jit
    def draw_all(ranges, keys):
        # traced numbers, one program for all ranges: a RandomConfig without the checks of its values
        config = object.__new__(RandomConfig)
        for name, value in zip(names, ranges, strict=True):
            object.__setattr__(config, name, value)

        def one(key):
            k_params, k_qpos, k_start, k_camera = jax.random.split(key, 4)
            params, size = randomize.sample_params(k_params, config, table, 0)
            qpos = randomize.sample_qpos(k_qpos, config, jnp.asarray(CUBE.rest_height_m))
            grasp = grasp_math.grasp_pose(qpos[9:12], qpos[12:16], jnp.asarray(4), 0.0, jnp)
            qpos = randomize.maybe_pregrasp(
                k_start, config.pregrasp_share, config.pregrasp_turn_rad, qpos, *grasp
            )
            turn = CAMERA[:3, :3].T @ randomize.sample_camera(k_camera, config, CAMERA)[:3, :3]
            return {
                "size": size,
                "slots": params.slot_size[0] / jnp.asarray(CUBE.slot_arrays(table.layout)[0][0]),
                "object_mass": params.object_mass / CUBE.mass_kg,
                "object_inertia": params.object_inertia / jnp.asarray(CUBE.inertia_kg_m2()),
                "object_friction": params.object_friction / CUBE.friction,
                "link_mass_scale": params.link_mass_scale,
                "joint_damping": params.joint_damping / scene.JOINT_DAMPING_NMS_RAD,
                "joint_friction": params.joint_friction,
                "gain_scale": params.gain_scale,
                "joints": qpos[:7] - jnp.asarray(contract.HOME_RAD),
                "fingers": qpos[7:9],
                "camera_position": randomize.sample_camera(k_camera, config, CAMERA)[:3, 3] - CAMERA[:3, 3],
                "camera_angle": jnp.stack([turn[2, 1], turn[0, 2], turn[1, 0]]),
            }

        return jax.vmap(one)(keys)

    def draw(config: RandomConfig) -> dict[str, np.ndarray]:
        ranges = [float(getattr(config, name)) for name in names]
        keys = jax.random.split(jax.random.PRNGKey(3), COUNT)
        return {name: np.asarray(value) for name, value in draw_all(ranges, keys).items()}

    return draw


def test_every_range_is_listed():
    assert {field.name for field in fields(RandomConfig)} == {
        *MOVES,
        "held_share",
        "latency_share",
        "other_pose_share",
        "pregrasp_turn_rad",
    }


@pytest.mark.parametrize("field", MOVES)
def test_a_range_moves_what_it_names_and_nothing_else(field, sampler):
    value = 1.0 if field == "pregrasp_share" else getattr(RandomConfig(), field)
    draws = sampler(replace(NOTHING, **{field: value}))
    moved = {name for name, values in draws.items() if np.ptp(values, axis=0).max() > 1e-5}
    assert moved == set(MOVES[field])
    for name, bounds in MOVES[field].items():
        if bounds is None:
            continue
        low, high = bounds
        values, slack = draws[name].reshape(COUNT, -1), 1e-3 * (high - low)
        assert values.min() >= low - slack and values.max() <= high + slack, name
        assert (values.min(axis=0) < low + 0.05 * (high - low)).all(), name  # every component, all the way
        assert (values.max(axis=0) > high - 0.05 * (high - low)).all(), name


def test_without_ranges_everything_is_nominal(sampler):
    for name, values in sampler(NOTHING).items():
        nominal = {"joint_friction": 0.0, "joints": 0.0, "fingers": 0.04}.get(name)
        nominal = 0.0 if name.startswith("camera") else 1.0 if nominal is None else nominal
        np.testing.assert_allclose(values, nominal, atol=1e-5, err_msg=name)


def test_ranges_are_drawn_independently(sampler):
    draws = sampler(RandomConfig())
    names = ("size", "object_mass", "object_friction", "link_mass_scale", "joint_damping", "joint_friction",
             "gain_scale", "joints", "camera_position", "camera_angle")  # fmt: skip
    columns = np.concatenate([draws[name].reshape(COUNT, -1) for name in names], axis=1)
    correlation = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(correlation).max() < 0.25  # 5 standard deviations at 400 draws


def test_an_arm_starts_within_its_limits_however_far_from_home():
    config = RandomConfig(joint_rad=1.0)
    qpos = draws.start_qpos(config, -np.ones(7), np.zeros(2), np.zeros(()), 0.02)
    home, limits = np.array(contract.HOME_RAD), np.array(contract.JOINT_LOWER_RAD)
    np.testing.assert_allclose(qpos[:7], np.maximum(home - 1.0, limits))
    assert (qpos[:7] > home - 1.0).any()


def test_the_pose_covers_the_workspace_and_all_yaws():
    qpos = jax.vmap(lambda k: randomize.sample_qpos(k, RandomConfig(), jnp.asarray(0.025)))(
        jax.random.split(jax.random.PRNGKey(0), 1000)
    )
    lower = np.subtract(contract.WORKSPACE_CENTER_M, np.array(contract.WORKSPACE_SIZE_M) / 2)
    upper = np.add(contract.WORKSPACE_CENTER_M, np.array(contract.WORKSPACE_SIZE_M) / 2)
    xy = np.asarray(qpos[:, 9:11])
    assert (xy >= lower - 1e-6).all() and (xy <= upper + 1e-6).all()
    assert (xy.min(axis=0) < lower + 0.01).all() and (xy.max(axis=0) > upper - 0.01).all()
    yaw = np.asarray(kinematics.yaw_of(qpos[:, 12:16]))
    assert np.histogram(yaw, bins=8, range=(-np.pi, np.pi))[0].min() > 80
    np.testing.assert_allclose(qpos[:, 11], 0.025, rtol=1e-6)


def test_pregrasp_share_is_a_share(sampler):
    home = np.abs(sampler(replace(NOTHING, pregrasp_share=0.25))["joints"]).max(axis=1) < 1e-6
    assert 1 - home.mean() == pytest.approx(0.25, abs=0.06)


@pytest.mark.parametrize("turn_rad", [0.0, 1.0])
def test_the_hand_above_the_object_is_turned_from_the_grasp(turn_rad):
    random = replace(NOTHING, pregrasp_share=1, pregrasp_turn_rad=turn_rad)
    env = GraspEnv(WorldConfig(objects=("cube",), random=random))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 200))
    place, hand = kinematics.grip_pose(state.data.qpos[:, QPOS.arm], jnp)
    above = np.asarray(place - state.obs[:, OBSERVATION.grasp_pos])[:, 2]
    assert above.min() > -0.01 and np.ptp(above) > 0.7 * randomize.PREGRASP_HEIGHT_M
    grasp = state.obs[:, OBSERVATION.grasp_quat]
    turn = np.asarray(kinematics.quat_mul(hand, kinematics.quat_conj(grasp, jnp), jnp))
    angle = 2 * np.arctan2(turn[:, 3] * np.sign(turn[:, 0]), np.abs(turn[:, 0]))
    assert np.abs(turn[:, 1:3]).max() < 0.02
    quartiles = np.quantile(angle, np.linspace(0, 1, 5))
    np.testing.assert_allclose(quartiles, np.linspace(-turn_rad, turn_rad, 5), atol=0.02 + 0.15 * turn_rad)


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_episodes_start_with_the_object_in_the_hand_in_their_share(share):
    """A gripper that is told to close then holds it, whichever it is."""
    env = GraspEnv(WorldConfig(objects=tuple(OBJECTS), random=RandomConfig(held_share=share)))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 240))
    height = np.asarray(state.data.qpos[:, QPOS.object_pos][:, 2] - state.info["episode"].rest_height)
    raised = height > 1e-4
    assert raised.mean() == pytest.approx(share, abs=0.08)
    assert height[raised].max() < contract.LIFT_TARGET_M[2] and np.ptp(height[raised]) > 0.3
    assert np.asarray(state.info["episode"].distances.grip_to_object)[raised].max() < 0.03
    close = jnp.zeros((240, 8)).at[:, 7].set(1.0)
    step = jax.jit(jax.vmap(env.step))
    for _ in range(5):
        state = step(state, close)
    assert np.asarray(state.info["episode"].grasped)[raised].mean() > 0.97
    assert not np.asarray(state.info["episode"].grasped)[~raised].any()


@pytest.mark.parametrize("exploring", [0.0, 0.5])
def test_shares_of_exploring_starts_are_turned_down(exploring):
    """Of pregrasps and of held objects alike, in a running batch."""
    random = replace(NOTHING, pregrasp_share=0.5, held_share=0.5)
    env = AutoReset(GraspEnv(WorldConfig(objects=("cube",), random=random)))
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 400))
    length = env.env.config.episode_steps  # episodes of a batch do not end together
    np.testing.assert_array_equal(state.info["episode"].steps, np.arange(400) % length)
    qpos = np.asarray(jax.jit(env.refresh)(state, exploring).info["next"][0].qpos)
    held = qpos[:, QPOS.object_pos][:, 2] > 0.026
    moved = np.abs(qpos[:, QPOS.arm] - contract.HOME_RAD).max(axis=1) > 1e-6
    assert held.mean() == pytest.approx(0.5 * exploring, abs=0.08)
    assert moved[~held].mean() == pytest.approx(0.5 * exploring, abs=0.08)


MODEL_FIELDS = {
    "size": {"geom_size", "geom_rbound", "body_inertia"},
    "object_mass": {"body_mass", "body_inertia"},
    "object_friction": {"geom_friction"},
    "link_mass": {"body_mass", "body_inertia"},
    "damping": {"dof_damping"},
    "friction_nm": {"dof_frictionloss"},
    "stiffness": {"actuator_gainprm", "actuator_biasprm"},
}
"""Field of RandomConfig -> arrays of MuJoCo's model that it reaches."""


@pytest.mark.parametrize("field", MODEL_FIELDS)
def test_a_range_reaches_the_model_of_both_worlds(field, table):
    config = replace(NOTHING, **{field: getattr(RandomConfig(), field)})
    params, _ = randomize.sample_params(jax.random.PRNGKey(0), config, table, 0)
    nominal, _ = randomize.sample_params(jax.random.PRNGKey(0), NOTHING, table, 0)
    model = scene.build_model()
    index = physics.ModelIndex(model)
    one, base = (index.fields(model, jax.tree.map(np.asarray, p)) for p in (params, nominal))
    assert {name for name in one if not np.allclose(one[name], base[name], rtol=1e-6)} == MODEL_FIELDS[field]

    rig, plain = RigWorld(("cube",), random=config), RigWorld(("cube",), random=NOTHING)
    rig.reset(5, "cube")
    plain.reset(5, "cube")
    moved = {name for name in one if not np.allclose(getattr(rig.model, name), getattr(plain.model, name))}
    assert moved == MODEL_FIELDS[field]


def test_latency_delays_commands_by_one_step_in_its_share_of_the_episodes():
    env = GraspEnv(WorldConfig(objects=("cube",), random=replace(NOTHING, latency_share=0.5)))
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    state = reset(jax.random.split(jax.random.PRNGKey(0), 64))
    late = np.asarray(state.info["episode"].latency.late)
    assert 16 < late.sum() < 48
    bend = jnp.zeros((64, 8)).at[:, 3].set(0.5).at[:, 7].set(1.0)  # elbow, and close
    path = []
    for action in (bend, -bend, -bend):
        state = step(state, action)
        path.append(np.asarray(state.data.qpos[:, :9]) - np.append(contract.HOME_RAD, (0.04, 0.04)))
    path = np.stack(path)  # all start alike, far from the cube: only latency tells them apart
    prompt, delayed = path[:, ~late], path[:, late]
    assert np.abs(prompt[0, :, 3]).min() > 0.01 and prompt[0, :, 7].max() < -0.004
    assert np.abs(delayed[0]).max() < 1e-3  # holds still
    np.testing.assert_allclose(delayed[1], np.broadcast_to(prompt[0, :1], delayed[1].shape), atol=1e-3)


def test_what_an_episode_draws_does_not_hang_together():
    """Lateness and rest pose, and the hand's turn and place above the object, once were the same number."""
    random = replace(
        NOTHING, latency_share=0.3, other_pose_share=0.5, pregrasp_share=1, pregrasp_turn_rad=1.0
    )
    env = GraspEnv(WorldConfig(objects=("block",), random=random))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 600))
    late, variant = np.asarray(state.info["episode"].latency.late), state.info["episode"].variant
    other = np.asarray(variant) != np.bincount(variant).argmax()
    assert late[other].mean() == pytest.approx(0.3, abs=0.1)
    place, hand = kinematics.grip_pose(state.data.qpos[:, QPOS.arm], jnp)
    turn = kinematics.quat_mul(hand, kinematics.quat_conj(state.obs[:, OBSERVATION.grasp_quat], jnp), jnp)
    aside = place[:, 0] - state.obs[:, OBSERVATION.grasp_pos][:, 0]
    assert abs(np.corrcoef(np.asarray(aside), np.asarray(turn[:, 3] * jnp.sign(turn[:, 0])))[0, 1]) < 0.2


def test_a_late_command_does_not_drop_what_an_episode_starts_with_in_the_hand():
    random = replace(NOTHING, held_share=1.0, latency_share=1.0)
    env = GraspEnv(WorldConfig(objects=("cube",), random=random))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 32))
    close = jnp.zeros((32, 8)).at[:, 7].set(1.0)
    height = np.asarray(state.data.qpos[:, QPOS.object_pos][:, 2])
    step = jax.jit(jax.vmap(env.step))
    for _ in range(5):
        state = step(state, close)
    np.testing.assert_allclose(state.data.qpos[:, QPOS.object_pos][:, 2], height, atol=0.01)


def test_an_episode_whose_physics_blows_up_ends():
    """On the C engine, which left alone would go on from its first state."""
    env = GraspEnv(WorldConfig(objects=("cube",)))
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    thrown = state.replace(data=replace(state.data, qvel=state.data.qvel.at[QVEL.object_angular].set(1e12)))
    after = jax.jit(env.step)(thrown, jnp.zeros(8))
    assert after.done == 1.0 and after.info["truncation"] == 0.0
    np.testing.assert_array_equal(after.data.qpos, state.data.qpos)
