"""Small experiments that every physics backend must pass: free fall, sliding, a moving arm, grasp-and-lift.

Each is one batch of six environments with differing objects or parameters. What comes out is held
against a closed form where there is one, and against the C engine's trajectory; `LIMITS` says how
close each backend must come. Run by the tests on two cores and by `benchmarks/gpu_check.py` on a GPU.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from ddgrasp import contract
from ddgrasp.config import RandomConfig
from ddgrasp.layout import CONTROLS, QPOS, QVEL
from mjx_envs import grasp_math, inverse_kinematics, randomize, scene
from mjx_envs.object_spec import DEFAULT_SLOTS
from mjx_envs.objects import OBJECTS
from mjx_envs.physics import interface as physics
from mjx_envs.physics.backends import make_physics
from mjx_envs.physics.interface import ModelParams, PhysicsState

SIM_DT_S = 0.005
GRAVITY_M_S2 = 9.81
OBJECTS_TRIED = ("cube", "block", "apple", "banana", "peach", "lemon")
"""All fit the default slots, which compile soonest; boxes and capsules alike."""

LIMITS: Mapping[str, Mapping[str, float]] = {
    # backend        C engine      MJX-JAX       MJX-Warp
    "fall_relative": {"cpu": 1e-3, "jax": 1e-3, "warp": 1e-3},
    "slide_relative": {"cpu": 0.05, "jax": 0.05, "warp": 0.05},
    "lift_error_m": {"cpu": 3e-3, "jax": 3e-3, "warp": 3e-3},
    "touch_relative": {"cpu": 0.0, "jax": 0.2, "warp": 0.02},
    "fall_from_cpu_m": {"cpu": 0.0, "jax": 1e-5, "warp": 1e-5},
    "turn_from_cpu_rad": {"cpu": 0.0, "jax": 1e-2, "warp": 1e-4},
    "slide_from_cpu_m": {"cpu": 0.0, "jax": 1e-3, "warp": 1e-3},
    "arm_from_cpu_rad": {"cpu": 0.0, "jax": 2e-4, "warp": 2e-4},
    "lift_from_cpu_m": {"cpu": 0.0, "jax": 1e-3, "warp": 1e-3},
}
"""Largest value of each measure. Relative to a closed form, to what was commanded, or to `cpu`.

MJX-JAX's pads may press otherwise: it chooses other contact points, of which the sensor takes the strongest.
A tumbling banana it turns otherwise by 3.7 mrad, which is as much as steps of 5 ms are wrong; a tenth more
inertia is 19 mrad.
"""

Step = Callable[[ModelParams, PhysicsState, jax.Array], PhysicsState]
"""A jitted, vmapped `Physics.step`."""


@dataclass(frozen=True)
class Scenario:
    """A batch B of environments and the commands of T control steps."""

    params: ModelParams
    start: PhysicsState
    controls: np.ndarray
    """(T, B, 9)."""


@dataclass(frozen=True)
class Trajectory:
    """What a backend made of a scenario."""

    qpos: np.ndarray
    """(T + 1, B, 16), the first is the start."""
    touch: np.ndarray
    """(T, B, 2) N."""


def make_step(backend: physics.Physics) -> Step:
    """The backend's step for a batch, compiled once for all scenarios."""
    return jax.jit(jax.vmap(backend.step))


def roll_out(step: Step, scenario: Scenario) -> Trajectory:
    """Follows the scenario's commands."""
    params, state = jax.device_get((scenario.params, scenario.start))  # one type for all: one compilation
    qpos, touch = [state.qpos], []
    for controls in scenario.controls:
        state = jax.device_get(step(params, state, controls))
        qpos.append(state.qpos)
        touch.append(state.touch)
    return Trajectory(np.stack(qpos), np.stack(touch))


def measure(step: Step, reference: Mapping[str, Trajectory] | None = None) -> dict[str, float]:
    """Every measure of `LIMITS` for a backend; without `reference`, the C engine's trajectories are made."""
    reference = reference or cpu_reference()
    measures: dict[str, float] = {}
    for name, (scenario, judge) in experiments().items():
        measures |= judge(scenario, roll_out(step, scenario), reference[name])
    return measures


def violations(backend: str, measures: Mapping[str, float]) -> list[str]:
    """One line for each measure beyond the backend's limit (or not a number)."""
    return [
        f"{backend}: {name} is {measures[name]:.3g}, limit {limits[backend]:.3g}"
        for name, limits in LIMITS.items()
        if not measures[name] <= limits[backend]
    ]


@cache
def cpu_reference() -> Mapping[str, Trajectory]:
    """The C engine's trajectory of each experiment."""
    step = make_step(make_physics("cpu", SIM_DT_S))
    return {name: roll_out(step, scenario) for name, (scenario, _) in experiments().items()}


# --- experiments ----------------------------------------------------------------------------------


TUMBLE_RAD_S = (3.0, 4.0, 5.0)
"""About no principal axis; the free joint is damped, so that the inertia counts, and not its ratios alone."""


def free_fall() -> Scenario:
    """Objects of every kind let go, tumbling, 0.2 to 0.4 m above the table, for 0.1 s."""
    params, rest = _params()
    start = _start([(0.65, 0.2, rest[i] + 0.2 + 0.04 * i) for i in range(len(rest))])
    start = replace(start, qvel=start.qvel.at[:, QVEL.object_angular].set(jnp.asarray(TUMBLE_RAD_S)))
    return Scenario(params, start, _hold(1))


def judge_fall(scenario: Scenario, seen: Trajectory, cpu: Trajectory) -> dict[str, float]:
    """Semi-implicit Euler over n steps of h falls g h^2 n (n + 1) / 2; turning against the C engine."""
    n = _substeps(scenario)
    expected = GRAVITY_M_S2 * SIM_DT_S**2 * n * (n + 1) / 2
    fallen = -_travelled(seen)[:, 2]
    return {
        "fall_relative": float(np.max(np.abs(fallen / expected - 1))),
        "fall_from_cpu_m": _object_difference(seen, cpu),
        "turn_from_cpu_rad": float(np.max(turned_rad(seen.qpos[-1], cpu.qpos[-1]))),
    }


SLIDE_SPEED_M_S = 1.0
SLIDE_FRICTION = (0.35, 0.8, 0.95)
"""Below and above the table's 0.7, short of tipping the cube over."""


def sliding() -> Scenario:
    """Cube and block pushed off along x with three friction coefficients each, until they stand still."""
    names = ("cube", "block") * len(SLIDE_FRICTION)
    params, rest = _params(names)
    friction = jnp.repeat(jnp.asarray(SLIDE_FRICTION), 2)
    start = _start([(0.6, 0.2, height) for height in rest])
    start = replace(start, qvel=start.qvel.at[:, QVEL.object_linear.start].set(SLIDE_SPEED_M_S))
    return Scenario(replace(params, object_friction=friction), start, _hold(5))


def judge_sliding(scenario: Scenario, seen: Trajectory, cpu: Trajectory) -> dict[str, float]:
    """v^2 / (2 mu g), less the half step by which semi-implicit Euler falls short."""
    mu = contact_friction(np.asarray(scenario.params.object_friction))
    expected = SLIDE_SPEED_M_S**2 / (2 * mu * GRAVITY_M_S2) - SLIDE_SPEED_M_S * SIM_DT_S / 2
    slid = _travelled(seen)[:, 0]
    return {
        "slide_relative": float(np.max(np.abs(slid / expected - 1))),
        "slide_from_cpu_m": _object_difference(seen, cpu),
    }


def contact_friction(object_friction: np.ndarray) -> np.ndarray:
    """Sliding friction between table and object as MuJoCo combines them: priority, else the larger."""
    model = scene.build_model(SIM_DT_S)
    slot, table = model.geom("slot_box").id, model.geom("table").id
    table_friction = model.geom_friction[table, 0]
    if model.geom_priority[slot] > model.geom_priority[table]:
        return object_friction
    if model.geom_priority[slot] < model.geom_priority[table]:
        return np.full_like(object_friction, table_friction)
    return np.maximum(object_friction, table_friction)


def moving_arm() -> Scenario:
    """The arm swings for 0.5 s under differing link masses, friction, damping and gains, touching nothing."""
    params, rest = _params()
    start = _start([(0.65, 0.25, height) for height in rest])
    controls = _hold(5)
    controls[..., CONTROLS.arm] += np.array([0.3, -0.2, 0.2, -0.3, 0.3, 0.3, -0.4])
    controls[..., CONTROLS.fingers] = 0.0
    return Scenario(params, start, controls)


def judge_arm(scenario: Scenario, seen: Trajectory, cpu: Trajectory) -> dict[str, float]:
    """Joints and fingers at every step against the C engine."""
    return {"arm_from_cpu_rad": float(np.max(np.abs((seen.qpos - cpu.qpos)[..., : scene.N_ROBOT])))}


LIFT_M = 0.12
_GRASP_STEPS, _LIFT_STEPS, _SETTLE_STEPS = 5, 8, 5


def grasp_and_lift() -> Scenario:
    """The gripper closes about each object in its grasp pose and lifts it."""
    params, rest = _params()
    start = _start([(0.5, 0.0, height) for height in rest])
    specs = [OBJECTS[name] for name in OBJECTS_TRIED]
    symmetry = jnp.array([spec.grasp_symmetry for spec in specs])
    offset = jnp.array([spec.grasp_offset_m for spec in specs])
    above = jnp.array([0.0, 0.0, LIFT_M])

    def joints(qpos, symmetry, offset):
        branch = grasp_math.yaw_branch(qpos[QPOS.object_quat], symmetry, jnp)
        pose = qpos[QPOS.object_pos], qpos[QPOS.object_quat]
        pos, quat = grasp_math.grasp_pose(*pose, symmetry, branch, jnp, offset)
        home = jnp.asarray(contract.HOME_RAD)
        at = inverse_kinematics.solve(home, pos, quat)
        return at, inverse_kinematics.solve(at, pos + above, quat)

    at, lifted = jax.vmap(joints)(start.qpos, symmetry, offset)
    time = np.arange(_GRASP_STEPS + _LIFT_STEPS + _SETTLE_STEPS)
    share = np.clip((time - _GRASP_STEPS + 1) / _LIFT_STEPS, 0, 1)[:, None, None]
    controls = np.zeros((len(time), len(specs), scene.NU), np.float32)
    controls[..., CONTROLS.arm] = np.asarray(at) + share * np.asarray(lifted - at)
    return Scenario(params, replace(start, qpos=start.qpos.at[:, QPOS.arm].set(at)), controls)


def judge_lift(scenario: Scenario, seen: Trajectory, cpu: Trajectory) -> dict[str, float]:
    """Every object risen as commanded; forces on the pads and heights against the C engine."""
    risen = _travelled(seen)[:, 2]
    held, expected = seen.touch[_GRASP_STEPS - 1 :], cpu.touch[_GRASP_STEPS - 1 :]
    return {
        "lift_error_m": float(np.max(np.abs(risen - LIFT_M))),
        "touch_relative": float(np.max(np.abs(held - expected) / np.maximum(expected, 1.0))),
        "lift_from_cpu_m": _object_difference(seen, cpu),
    }


Judge = Callable[[Scenario, Trajectory, Trajectory], dict[str, float]]
"""(scenario, the backend's trajectory, the C engine's) -> measures, named as in LIMITS."""


@cache
def experiments() -> dict[str, tuple[Scenario, Judge]]:
    """All of them, by name."""
    return {
        "free_fall": (free_fall(), judge_fall),
        "sliding": (sliding(), judge_sliding),
        "moving_arm": (moving_arm(), judge_arm),
        "grasp_and_lift": (grasp_and_lift(), judge_lift),
    }


# --- parts ----------------------------------------------------------------------------------------


def _params(names: tuple[str, ...] = OBJECTS_TRIED) -> tuple[ModelParams, np.ndarray]:
    """Parameters drawn for each of `names`, and the heights (B,) at which they rest."""
    table = randomize.ObjectTable(names)
    assert table.layout == DEFAULT_SLOTS
    keys = jax.random.split(jax.random.PRNGKey(0), len(names))
    sample = jax.vmap(lambda key, i: randomize.sample_params(key, RandomConfig(), table, i))
    params, size = sample(keys, jnp.arange(len(names)))
    return params, table.rest_height[: len(names)] * np.asarray(size)


def _start(places) -> PhysicsState:
    """At rest, arm home, gripper open, objects upright at `places` (B, 3)."""
    robot = np.tile([*contract.HOME_RAD, *_OPEN], (len(places), 1))
    qpos = np.concatenate([robot, places, np.tile([1.0, 0, 0, 0], (len(places), 1))], axis=1)
    return jax.vmap(physics.initial_state)(jnp.asarray(qpos, jnp.float32))


_OPEN = (contract.GRIPPER_MAX_WIDTH_M / 2,) * 2


def _hold(steps: int) -> np.ndarray:
    """(steps, B, 9) commands that hold the arm home."""
    return np.tile(np.array([*contract.HOME_RAD, *_OPEN], np.float32), (steps, len(OBJECTS_TRIED), 1))


def _substeps(scenario: Scenario) -> int:
    return len(scenario.controls) * round(contract.CONTROL_DT_S / SIM_DT_S)


def _object_difference(seen: Trajectory, cpu: Trajectory) -> float:
    """Largest distance between the objects' positions in the end, m."""
    apart = (seen.qpos[-1] - cpu.qpos[-1])[:, QPOS.object_pos]
    return float(np.max(np.linalg.norm(apart, axis=-1)))


def turned_rad(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(B,) angle between the objects' orientations in `a` and in `b` (B, 16), exact for small ones too."""
    p, q = (np.asarray(qpos, np.float64)[:, QPOS.object_quat] for qpos in (a, b))
    apart, opposite = (np.linalg.norm(p - sign * q, axis=-1) for sign in (1, -1))
    return 4 * np.arctan2(np.minimum(apart, opposite), np.maximum(apart, opposite))


def _travelled(seen: Trajectory) -> np.ndarray:
    """(B, 3) m, where the objects are in the end less where they began."""
    return (seen.qpos[-1] - seen.qpos[0])[:, QPOS.object_pos]
