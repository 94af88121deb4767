"""Every backend passes the conformance experiments; the drawn parameters stay in their ranges."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp

from ddgrasp import contract
from ddgrasp.config import RandomConfig
from ddgrasp.errors import UserError
from mjx_envs import inverse_kinematics, kinematics, randomize
from mjx_envs.grasp_math import HAND_DOWN
from mjx_envs.object_spec import DEFAULT_SLOTS
from mjx_envs.objects import OBJECTS
from mjx_envs.physics import backends, conformance
from mjx_envs.physics import mjx_warp as physics_warp
from mjx_envs.physics.c_engine import CpuPhysics

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


DEFECTS = {
    "object_friction": (1.1, {"slide_relative", "slide_from_cpu_m"}),
    "object_mass": (2.5, {"fall_from_cpu_m", "slide_from_cpu_m"}),
    "object_inertia": (1.1, {"turn_from_cpu_rad"}),
    "slot_size": (1.05, {"slide_from_cpu_m", "lift_from_cpu_m"}),
    "link_mass_scale": (1.1, {"arm_from_cpu_rad"}),
    "joint_damping": (1.1, {"arm_from_cpu_rad"}),
    "joint_friction": (1.1, {"arm_from_cpu_rad"}),
    "gain_scale": (0.98, {"arm_from_cpu_rad"}),
}
"""Field of ModelParams -> (what a faulty backend makes of it, the measures that see it)."""


@pytest.fixture(scope="module")
def c_step():
    return conformance.make_step(make_backend("cpu"))


def beyond(step) -> set[str]:
    """Measures of `step` that are beyond MJX-JAX's limits, the widest but the C engine's own."""
    return {line.split()[1] for line in conformance.violations("jax", conformance.measure(step))}


@pytest.mark.parametrize("field", DEFECTS)
def test_a_backend_with_one_defect_is_found_by_the_measure_that_should_see_it(field, c_step):
    factor, seen_by = DEFECTS[field]

    def step(params, state, ctrl):
        return c_step(params.replace(**{field: factor * getattr(params, field)}), state, ctrl)

    assert beyond(step) == seen_by


def test_a_backend_that_takes_another_world_s_parameters_is_found_by_every_measure_but_the_fall(c_step):
    def step(params, state, ctrl):
        return c_step(jax.tree.map(lambda x: np.roll(x, 1, axis=0), params), state, ctrl)

    assert beyond(step) == conformance.LIMITS.keys() - {"fall_relative"}  # all fall alike


@pytest.mark.parametrize(
    ("forgotten", "seen_by"),
    [
        ("qvel", {"slide_relative", "slide_from_cpu_m", "turn_from_cpu_rad", "arm_from_cpu_rad"}),
        ("touch", {"touch_relative"}),
    ],
)
def test_a_backend_that_forgets_part_of_its_state_is_found(forgotten, seen_by, c_step):
    def step(params, state, ctrl):
        def without(state):
            return state.replace(**{forgotten: 0 * getattr(state, forgotten)})

        return without(c_step(params, without(state), ctrl))

    assert beyond(step) == seen_by


def test_two_threads_at_the_c_engine_do_not_get_each_others_environments():
    """An evaluation beside a training, say, of one environment: two programs call with as many at a time."""
    engine, scenario = CpuPhysics(DT_S, 20, DEFAULT_SLOTS), conformance.moving_arm()
    params, start = jax.device_get((scenario.params, scenario.start))
    rolled = jax.tree.map(lambda x: np.roll(x, 1, axis=0), params)

    def stepped(swings: bool) -> np.ndarray:
        controls = scenario.controls[0] if swings else conformance._hold(1)[0]
        new = engine._host_step(np.int32(-1), params if swings else rolled, start, controls)
        return np.asarray(new.qpos)

    alone = [stepped(False), stepped(True)]
    assert np.abs(alone[1] - alone[0]).max() > 0.01
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(stepped, [False, True] * 40))
    for i, qpos in enumerate(together):
        np.testing.assert_array_equal(qpos, alone[i % 2])


def test_an_interrupt_while_parameters_are_written_leaves_no_mixture(monkeypatch):
    """Ctrl-C in a notebook, whose environment is then used further."""
    engine, scenario = CpuPhysics(DT_S, 20, DEFAULT_SLOTS), conformance.moving_arm()
    params, start = jax.device_get((scenario.params, scenario.start))
    given = np.int32(-1), params, start, scenario.controls[0]
    before = engine._host_step(*given).qpos
    stiff = params.replace(joint_damping=4 * params.joint_damping)
    with monkeypatch.context() as patch:
        (batch,) = engine._batches.values()
        patch.setattr(batch, "_batch", _Interrupted(batch._batch))
        with pytest.raises(KeyboardInterrupt):
            engine._host_step(given[0], stiff, *given[2:])
    np.testing.assert_array_equal(engine._host_step(*given).qpos, before)


class _Interrupted:
    """A batch in which Ctrl-C arrives once its fields are written."""

    def __init__(self, batch):
        self._batch = batch

    def __getattr__(self, name: str):
        return getattr(self._batch, name)

    def set_const(self, **_):
        raise KeyboardInterrupt


def test_the_angle_between_orientations_is_exact_for_small_ones_too():
    qpos = np.zeros((4, 16))
    qpos[:, 12], angles = 1.0, np.array([0.0, 1e-6, 0.3, 3.0])
    turned = qpos.copy()
    turned[:, 12], turned[:, 14] = np.cos(angles / 2), np.sin(angles / 2)
    np.testing.assert_allclose(conformance.turned_rad(qpos, turned), angles, rtol=1e-9)
    turned[:, 12:] *= -1  # the same orientation
    np.testing.assert_allclose(conformance.turned_rad(qpos, turned), angles, rtol=1e-9)


def test_the_experiments_do_what_they_say():
    """The C engine: objects fall and turn, more friction stops them sooner, the gripper holds with force."""
    seen = conformance.cpu_reference()
    fall, slide, lift = (seen[name].qpos[..., 9:12] for name in ("free_fall", "sliding", "grasp_and_lift"))
    np.testing.assert_allclose(fall[0, :, 2] - fall[-1, :, 2], 9.81 * DT_S**2 * 20 * 21 / 2, rtol=1e-3)
    qpos = seen["free_fall"].qpos
    assert conformance.turned_rad(qpos[0], qpos[-1]).min() > 0.18
    scenario, _ = conformance.experiments()["sliding"]
    mu = conformance.contact_friction(np.asarray(scenario.params.object_friction))
    slid = (slide[-1] - slide[0])[np.argsort(mu, kind="stable"), 0]
    assert 0.04 < slid.min() and slid[:2].min() > 1.1 * slid[2:4].max() > 1.2 * slid[4:].max()
    assert (lift[-1, :, 2] - lift[0, :, 2]).min() > 0.1
    assert seen["grasp_and_lift"].touch[4:].min() > 1.0
    assert np.ptp(seen["moving_arm"].qpos[1, :, :7], axis=0).max() > 1e-3  # parameters differ


def test_inverse_kinematics_reaches_the_pose():
    position, quat = jnp.array([0.42, 0.15, 0.05]), jnp.array(HAND_DOWN)
    q = inverse_kinematics.solve(jnp.array(contract.HOME_RAD), position, quat)
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


@pytest.mark.parametrize(("room", "dropped"), [(4, 0), (3, 1)])
def test_warp_counts_an_environment_whose_contacts_had_no_room(room, dropped, monkeypatch):
    """A cube lies on four contacts."""
    monkeypatch.setattr(physics_warp, "CONTACTS_PER_ENV", room)
    warp.config.optimization_level = 0
    params, rest = conformance._params(("cube",))
    start = conformance._start([(0.5, 0.0, rest[0] - 0.001)])
    step = jax.jit(jax.vmap(physics_warp.WarpPhysics(DT_S, 1, DEFAULT_SLOTS).step))
    assert step(params, start, conformance._hold(1)[0, :1]).dropped.tolist() == [dropped]


def test_unknown_backend_is_named():
    with pytest.raises(UserError, match="'cpuu'.*Did you mean 'cpu'"):
        backends.make_physics("cpuu", DT_S)


def test_warp_without_a_gpu_says_what_to_do():
    if any(device.platform == "gpu" for device in jax.devices()):
        pytest.skip("this machine has a GPU")
    with pytest.raises(UserError, match="'warp' needs an NVIDIA GPU.*choose cpu or jax"):
        backends.make_physics("warp", DT_S)
