"""The backends agree: same scene, same controls, same trajectories."""

import jax
import jax.numpy as jp
import numpy as np
import pytest

from ddgrasp.config import RandomConfig
from ddgrasp.errors import UserError
from mjx_envs import inverse_kinematics, kinematics, physics, randomize, scene
from mjx_envs.grasp_math import HAND_DOWN
from mjx_envs.objects import OBJECTS

NAMES = ("cube", "apple", "banana")
DT_S = 0.005


@pytest.fixture(scope="module")
def table():
    return randomize.ObjectTable(NAMES)


@pytest.fixture(scope="module")
def params(table):
    one = [randomize.sample_params(jax.random.PRNGKey(i), RandomConfig(), table, i)[0] for i in range(3)]
    return jax.tree.map(lambda *x: jp.stack(x), *one)


def batch_at(height_m, x_m=0.5, y_m=0.0):
    fingers = jp.full(2, 0.04)
    rows = []
    for name in NAMES:
        place = jp.array([x_m, y_m, OBJECTS[name].rest_height_m + height_m, 1.0, 0, 0, 0])
        rows.append(jp.concatenate([jp.array(scene.HOME_RAD), fingers, place]))
    return jax.vmap(physics.initial_state)(jp.stack(rows))


@pytest.fixture(scope="module")
def steppers():
    return {name: jax.jit(jax.vmap(physics.make_physics(name, DT_S).step)) for name in ("cpu", "jax")}


def hold_still():
    return jp.tile(jp.concatenate([jp.array(scene.HOME_RAD), jp.full(2, 0.04)]), (len(NAMES), 1))


def test_free_fall_agrees_and_obeys_gravity(steppers, params):
    for step in steppers.values():
        start = batch_at(0.3, 0.65, 0.2)  # clear of the hand
        state = step(params, start, hold_still())
        fallen = start.qpos[:, 11] - state.qpos[:, 11]
        # Semi-implicit Euler over n steps of h: g h^2 n (n + 1) / 2.
        np.testing.assert_allclose(fallen, 9.81 * DT_S**2 * 20 * 21 / 2, rtol=0.01)


def test_backends_agree_with_the_object_on_the_table_and_the_arm_moving(steppers, params):
    states = {name: batch_at(0.0) for name in steppers}
    target = hold_still().at[:, 3].add(0.1).at[:, 7:].set(0.0)
    for _ in range(3):
        states = {name: steppers[name](params, s, target) for name, s in states.items()}
    np.testing.assert_allclose(states["cpu"].qpos[:, :9], states["jax"].qpos[:, :9], atol=2e-3)
    np.testing.assert_allclose(states["cpu"].qpos[:, 9:12], states["jax"].qpos[:, 9:12], atol=2e-3)


def test_grasp_and_lift_on_both(steppers, params):
    down = jp.array(HAND_DOWN)
    heights = jp.array([max(OBJECTS[n].rest_height_m, 0.02) for n in NAMES])
    solve = jax.vmap(lambda p: inverse_kinematics.solve(jp.array(scene.HOME_RAD), p, down))
    at = solve(jp.stack([jp.full(3, 0.5), jp.zeros(3), heights], axis=1))
    lifted = solve(jp.stack([jp.full(3, 0.5), jp.zeros(3), heights + 0.12], axis=1))
    for name, step in steppers.items():
        state = batch_at(0.0)
        state = state.replace(qpos=state.qpos.at[:, :7].set(at))
        for t in range(16):
            joints = at + (lifted - at) * min(1.0, max(0, t - 5) / 8)
            ctrl = jp.concatenate([joints, jp.full((3, 2), 0.0)], axis=1)
            state = step(params, state, ctrl)
            if t == 4:
                assert np.all(np.asarray(state.touch) > 1.0), (name, state.touch)
        assert np.all(np.asarray(state.qpos[:, 11]) > 0.1), (name, state.qpos[:, 11])


def test_inverse_kinematics_reaches_the_pose():
    position, quat = jp.array([0.42, 0.15, 0.05]), jp.array(HAND_DOWN)
    q = inverse_kinematics.solve(jp.array(scene.HOME_RAD), position, quat)
    reached, orientation = kinematics.grip_pose(q, jp)
    np.testing.assert_allclose(reached, position, atol=1e-4)
    assert float(kinematics.angle_between(orientation, quat, jp)) < 5e-3


def test_randomisation_stays_in_range_and_moves_only_what_it_should(table):
    config = RandomConfig(
        size=0.1, object_mass=0.0, object_friction=0.0, link_mass=0.0, damping=0.0, stiffness=0.0
    )
    keys = jax.random.split(jax.random.PRNGKey(1), 200)
    params, size = jax.vmap(lambda k: randomize.sample_params(k, config, table, 0))(keys)
    assert 0.9 <= float(size.min()) < 0.92 and 1.08 < float(size.max()) <= 1.1
    np.testing.assert_allclose(params.slot_size[:, 0, 0], 0.025 * np.asarray(size), rtol=1e-5)
    np.testing.assert_allclose(params.object_mass, OBJECTS["cube"].mass_kg, rtol=1e-6)
    np.testing.assert_array_equal(params.gain_scale, 1.0)
    np.testing.assert_array_equal(params.link_mass_scale, 1.0)


def test_unknown_backend_is_named():
    with pytest.raises(UserError, match="'cpuu'.*Did you mean 'cpu'"):
        physics.make_physics("cpuu", DT_S)
