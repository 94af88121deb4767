"""MJX-JAX: no link is computed again and again, rows and contacts are as asked for, none is lost unseen."""

import dataclasses
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from ddgrasp import contract
from ddgrasp.config import Config, WorldConfig
from demos.rollout import Roller
from mjx_envs import scene
from mjx_envs.grasp_env import GraspEnv
from mjx_envs.object_spec import DEFAULT_SLOTS, SlotLayout
from mjx_envs.objects import OBJECTS
from mjx_envs.physics import interface, mjx_collision, mjx_kinematics
from mjx_envs.physics.mjx_jax import JaxPhysics
from ppo import rollout, warmup
from teacher_support import still_teacher
from xla_support import optimized

BATCH = 64
SLOWER_THAN_C = 40.0
"""Bound of the guard, in CPU time, twenty times above a good compile, which takes once to twice what the C
engine does."""


def _cpu_seconds(run: Callable[[], object]) -> float:
    """Least CPU time of a call, of all threads: other processes do not count. Of ten, or fewer slow ones."""
    times: list[float] = []
    while len(times) < 10 and sum(times) < 2.0:
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return min(times)


_OLD_EMITTERS = "fusion_emitters" in os.environ.get("XLA_FLAGS", "")
AS_USERS = (
    {"xla_cpu_use_fusion_emitters": True, "xla_cpu_parallel_codegen_split_count": 32} if _OLD_EMITTERS else {}
)
"""Options of a compilation that undo what conftest.py sets for speed."""


@pytest.fixture
def all_optimizations():
    """Programs as users compile them, with `AS_USERS`; the other tests do without."""
    with optimized():
        yield


def _random_qpos(model: mujoco.MjModel, count: int) -> np.ndarray:
    """(count, nq): joints around home, the object turned anyhow."""
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (count, 1))
    qpos[:, : scene.N_ARM] = np.array(contract.HOME_RAD) + rng.uniform(-0.3, 0.3, (count, scene.N_ARM))
    qpos[:, 12:] = rng.normal(size=(count, 4))
    return qpos


def test_the_poses_of_links_are_computed_once(all_optimizations):
    """The hand's position alone, the end of the chain: without barriers its 64 take seconds."""
    model = scene.build_model()
    mx, empty = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
    qpos, hand = _random_qpos(model, BATCH), model.body("hand").id
    start, data = qpos.astype(np.float32), mujoco.MjData(model)

    @partial(jax.jit, compiler_options=AS_USERS)
    @jax.vmap
    def hands(qpos):
        return mjx_kinematics.kinematics(mx, empty.replace(qpos=qpos)).xpos[hand]

    def c_engine() -> None:
        for state in qpos:
            data.qpos[:] = state
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)

    jax.block_until_ready(hands(start))
    ours, theirs = _cpu_seconds(lambda: jax.block_until_ready(hands(start))), _cpu_seconds(c_engine)
    print(f"hands of {BATCH}: {ours * 1e3:.2f} ms, C engine {theirs * 1e3:.2f} ms")
    assert ours < SLOWER_THAN_C * theirs


def test_the_guard_is_documented_as_it_is():
    page = (Path(__file__).parents[1] / "docs" / "physics.md").read_text()
    assert f"the bound is {SLOWER_THAN_C:g} times that" in page


def test_poses_are_those_of_the_c_engine():
    model = scene.build_model()
    mx, empty = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
    qpos, data = _random_qpos(model, 4), mujoco.MjData(model)

    @jax.jit
    @jax.vmap
    def poses(qpos):
        data = mjx.com_pos(mx, mjx_kinematics.kinematics(mx, empty.replace(qpos=qpos)))
        return data.xpos, data.xmat, data.xipos, data.ximat, data.geom_xpos, data.geom_xmat, data.cdof

    seen = jax.device_get(poses(qpos.astype(np.float32)))
    for i, state in enumerate(qpos):
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        expected = data.xpos, data.xmat, data.xipos, data.ximat, data.geom_xpos, data.geom_xmat, data.cdof
        for mine, theirs in zip(seen, expected, strict=True):
            np.testing.assert_allclose(mine[i], theirs.reshape(mine[i].shape), atol=2e-6)


@pytest.mark.parametrize(
    ("layout", "contacts", "rows"),
    [(DEFAULT_SLOTS, 12, 65), (SlotLayout(capsules=8, cylinders=2, plates=5), 24, 113)],
)
def test_rows_and_contacts_are_those_asked_for(layout, contacts, rows):
    physics = JaxPhysics(0.005, 20, layout)
    made = physics.empty._impl
    assert (made.ncon, made.nefc) == (contacts, rows)
    assert (made.ne, made.nf, made.nl) == (1, 7, 9)
    assert (made.contact.dim == 4).all()
    assert made.efc_J.shape == (rows, scene.NV)


def test_contacts_beyond_the_cap_are_counted():
    layout = SlotLayout(capsules=8)
    physics = JaxPhysics(0.005, 20, layout)
    falling = scene.build_model(layout=layout).qpos0.astype(np.float32)
    falling[: scene.N_ARM], falling[11] = contract.HOME_RAD, 0.1
    sunk = falling.copy()
    sunk[11] = -0.2  # 4 contacts of the box, 2 of each capsule

    @jax.jit
    @jax.vmap
    def collided(qpos):
        data = mjx_kinematics.kinematics(physics.model, physics.empty.replace(qpos=qpos))
        contact, dropped = mjx_collision.collide(physics.model, data, 12)
        return jnp.sum(contact.dist < 0), dropped

    held, dropped = jax.device_get(collided(np.stack([falling, sunk])))
    assert held.tolist() == [0, 12]
    assert dropped.tolist() == [0, 8]


def test_a_ball_beside_a_pads_face_is_touched():
    """A capsule that is nearly a sphere, from in front of the pad's face to beyond its edge."""
    model = scene.build_model()
    scene.fill_slots(model, OBJECTS["peach"], DEFAULT_SLOTS)
    data = mujoco.MjData(model)
    data.qpos[: scene.N_ARM], data.qpos[7:9] = contract.HOME_RAD, 0.04
    mujoco.mj_forward(model, data)
    pad, turn = data.geom("left_finger_pad").xpos, data.geom("left_finger_pad").xmat.reshape(3, 3)
    ball = model.geom("slot_capsule0")
    states, expected = [], []
    for beyond in np.linspace(-0.004, 0.006, 11):
        centre = np.array([0.0105 + beyond, -0.005 - ball.size[0] + 0.002, 0.0])
        data.qpos[9:12] = pad + turn @ centre - ball.pos
        mujoco.mj_forward(model, data)
        states.append(data.qpos.astype(np.float32))
        depths = [c.dist for c in data.contact if {*c.geom} == {ball.id, model.geom("left_finger_pad").id}]
        expected.append(min(depths, default=0.0))
    mx, empty = mjx.put_model(_uncapped(model), impl="jax"), mjx.make_data(scene.build_model(), impl="jax")

    @jax.jit
    @jax.vmap
    def depth(qpos):
        posed = mjx_kinematics.kinematics(mx, empty.replace(qpos=qpos))
        contact, _ = mjx_collision.collide(mx, posed, 12)
        pair = jnp.array([ball.id, model.geom("left_finger_pad").id])
        return jnp.min(jnp.where((contact.geom == pair).all(axis=1), contact.dist, 0.0))

    assert min(expected) < -0.0015 and max(expected) < -0.001
    np.testing.assert_allclose(depth(np.stack(states)), expected, atol=1e-4)


def _uncapped(model: mujoco.MjModel) -> mujoco.MjModel:
    model.numeric_data[:] = -1
    return model


class Overfull:
    """The C engine's physics, saying that it lost three contacts in every step."""

    def __init__(self, physics: interface.Physics):
        self._physics = physics

    def step(
        self, params: interface.ModelParams, state: interface.PhysicsState, ctrl: jax.Array
    ) -> interface.PhysicsState:
        return dataclasses.replace(self._physics.step(params, state, ctrl), dropped=jnp.int32(3))


@pytest.mark.parametrize("lost", [False, True])
def test_an_evaluation_reports_what_its_physics_lost(lost, capsys):
    env = GraspEnv(WorldConfig(episode_steps=3))
    if lost:
        env.physics = Overfull(env.physics)
    keys = jax.random.split(jax.random.PRNGKey(0), 4)
    seen = rollout.roll_out(env, still_teacher(), keys, _nothing)
    said = capsys.readouterr().err
    assert seen.dropped == (3 * int(seen.running.sum()) if lost else 0)
    assert ("36 contacts in 12 control steps were more than the physics backend holds" in said) == lost
    assert said.count("\n") == int(lost)


def test_demos_and_dagger_report_what_their_physics_lost(capsys):
    roller = Roller(Config("test", world=WorldConfig(episode_steps=3)), still_teacher(), 4, with_depth=False)
    roller.env.physics = Overfull(roller.env.physics)
    roller.run(jax.random.PRNGKey(0), lambda scene: scene.expert)
    said = capsys.readouterr().err
    assert said.startswith("warning: 36 contacts in 12 control steps were more") and said.count("\n") == 1


def test_cloning_the_guide_reports_what_its_physics_lost(capsys):
    env = GraspEnv(WorldConfig(episode_steps=3))
    env.physics = Overfull(env.physics)
    observations, _ = warmup.Collector(env, 4)(still_teacher(), seed=0, guide_share=1.0)
    assert len(observations) == 12
    assert capsys.readouterr().err.startswith("warning: 36 contacts in 12 control steps were more")


def _nothing(before, action, after):
    return {}
