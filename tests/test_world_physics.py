"""Every backend passes the conformance experiments; the drawn parameters stay in their ranges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp

from ddgrasp.config import RandomConfig
from ddgrasp.errors import UserError
from mjx_envs import inverse_kinematics, kinematics, randomize, scene
from mjx_envs.grasp_math import HAND_DOWN
from mjx_envs.object_spec import DEFAULT_SLOTS
from mjx_envs.objects import OBJECTS
from mjx_envs.physics import backends, conformance
from mjx_envs.physics import mjx_warp as physics_warp

NAMES = ("cube", "apple", "banana")
DT_S = 0.005


@pytest.fixture(scope="module")
def table():
    return randomize.ObjectTable(NAMES)


def make_backend(name):
    """Warp on its CPU device where there is no GPU: the same kernels and the same route through JAX."""
    if name == "warp":
        warp.config.optimization_level = 0  # the kernels take 76 s of CPU time instead of 94
        return physics_warp.WarpPhysics(DT_S, 20, DEFAULT_SLOTS)
    return backends.make_physics(name, DT_S)


@pytest.fixture(scope="module", params=backends.BACKENDS)
def measured(request):
    """(backend's name, every measure of its experiments)."""
    step = conformance.make_step(make_backend(request.param))
    measures = conformance.measure(step)
    print(request.param, {name: f"{value:.3g}" for name, value in measures.items()})
    return request.param, measures


def test_every_backend_stays_within_its_limits(measured):
    name, measures = measured
    assert measures.keys() == conformance.LIMITS.keys()
    assert conformance.violations(name, measures) == []


def test_violations_are_named():
    measures = dict.fromkeys(conformance.LIMITS, 0.0) | {"fall_relative": 0.1, "slide_relative": np.nan}
    assert conformance.violations("jax", measures) == [
        "jax: fall_relative is 0.1, limit 0.001",
        "jax: slide_relative is nan, limit 0.05",
    ]


def test_the_experiments_do_what_they_say():
    """The C engine: objects fall, harder friction stops them sooner, the gripper holds with force."""
    seen = conformance.cpu_reference()
    fall, slide, lift = (seen[name].qpos[..., 9:12] for name in ("free_fall", "sliding", "grasp_and_lift"))
    np.testing.assert_allclose(fall[0, :, 2] - fall[-1, :, 2], 9.81 * DT_S**2 * 20 * 21 / 2, rtol=1e-3)
    scenario, _ = conformance.experiments()["sliding"]
    mu = conformance.contact_friction(np.asarray(scenario.params.object_friction))
    slid = (slide[-1] - slide[0])[np.argsort(mu, kind="stable"), 0]
    assert 0.04 < slid.min() and slid[:2].min() > 1.1 * slid[2:4].max() > 1.2 * slid[4:].max()
    assert (lift[-1, :, 2] - lift[0, :, 2]).min() > 0.1
    assert seen["grasp_and_lift"].touch[4:].min() > 1.0
    assert np.ptp(seen["moving_arm"].qpos[1, :, :7], axis=0).max() > 1e-3  # parameters differ


def test_inverse_kinematics_reaches_the_pose():
    position, quat = jnp.array([0.42, 0.15, 0.05]), jnp.array(HAND_DOWN)
    q = inverse_kinematics.solve(jnp.array(scene.HOME_RAD), position, quat)
    reached, orientation = kinematics.grip_pose(q, jnp)
    np.testing.assert_allclose(reached, position, atol=1e-4)
    assert float(kinematics.angle_between(orientation, quat, jnp)) < 5e-3


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
        backends.make_physics("cpuu", DT_S)


def test_warp_without_a_gpu_says_what_to_do():
    if any(device.platform == "gpu" for device in jax.devices()):
        pytest.skip("this machine has a GPU")
    with pytest.raises(UserError, match="'warp' needs an NVIDIA GPU.*choose cpu or jax"):
        backends.make_physics("warp", DT_S)
