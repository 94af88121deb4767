"""The solver of MJX-JAX finds the C engine's accelerations and forces, on the C engine's own problems."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_envs import scene
from mjx_envs.objects import OBJECTS
from mjx_envs.physics import mjx_jax, mjx_solver

LIMITS, CONTACTS = 9, 24
"""Rows that MJX always has; the C engine has those that are active."""


def _problem(model: mujoco.MjModel, data: mujoco.MjData) -> mjx_solver.Problem:
    """What `mj_forward` left in `data`, with rows of zeros for what is inactive."""
    kinds = data.efc_type
    of = mujoco.mjtConstraint
    equality, friction = (np.flatnonzero(kinds == k) for k in (of.mjCNSTR_EQUALITY, of.mjCNSTR_FRICTION_DOF))
    limit = np.flatnonzero(kinds == of.mjCNSTR_LIMIT_JOINT)
    contact = np.flatnonzero(kinds == of.mjCNSTR_CONTACT_ELLIPTIC)
    count = len(equality) + len(friction)
    places = np.concatenate(
        [np.arange(count), count + np.arange(len(limit)), count + LIMITS + np.arange(len(contact))]
    )
    rows = np.concatenate([equality, friction, limit, contact])
    size = count + LIMITS + mjx_solver.CONE * CONTACTS
    jacobian, reference, stiffness = np.zeros((size, model.nv)), np.zeros(size), np.ones(size)
    jacobian[places] = data.efc_J.reshape(-1, model.nv)[rows]
    reference[places], stiffness[places] = data.efc_aref[rows], data.efc_D[rows]
    cone = np.ones((CONTACTS, mjx_solver.CONE))
    for i in range(data.ncon):
        assert data.contact[i].dim == mjx_solver.CONE
        cone[i, 0] = data.contact[i].friction[0] / np.sqrt(model.opt.impratio)
        cone[i, 1:] = data.contact[i].friction[[0, 1, 2]]
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    parts = mass, data.qfrc_smooth, jacobian, reference, stiffness, data.efc_frictionloss[friction], cone
    return mjx_solver.Problem(*(np.asarray(part, np.float32) for part in parts), equalities=len(equality))


@pytest.fixture(scope="module")
def visited():
    """(problems, first guesses, accelerations, contact forces) of objects that fall, lie and are squeezed."""
    model = scene.build_model()
    model.opt.tolerance, model.opt.ls_tolerance = 1e-12, 1e-6
    problems, guesses, accelerations, contacts = [], [], [], []
    for name in ("cube", "banana", "peach"):
        scene.fill_slots(model, OBJECTS[name], scene.DEFAULT_SLOTS)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        for height in (0.0, 0.08):
            data = mujoco.MjData(model)
            data.qpos[:9] = [0.0, 0.35, 0.0, -2.05, 0.0, 2.4, 0.7854, 0.04, 0.04]
            mujoco.mj_forward(model, data)
            grip = data.site("grip").xpos
            data.qpos[9:12] = [grip[0], grip[1], OBJECTS[name].rest_height_m + height]
            data.ctrl[:7], data.ctrl[7:] = data.qpos[:7], 0.0
            data.qvel[9] = 1.0 if height == 0 else 0.0
            for step in range(120):
                guess = data.qacc_warmstart.copy()
                mujoco.mj_forward(model, data)
                if step % 10 == 0:
                    problems.append(_problem(model, data))
                    guesses.append(guess)
                    accelerations.append(data.qacc.copy())
                    contacts.append(data.ncon)
                mujoco.mj_step(model, data)
    fixed = problems[0].equalities
    arrays = [np.stack(part) for part in zip(*(p[:-1] for p in problems), strict=True)]
    return arrays, fixed, np.asarray(guesses, np.float32), np.stack(accelerations), np.array(contacts)


def _cost(problem: mjx_solver.Problem, acceleration: np.ndarray) -> float:
    """What is to be minimised, float64, from MuJoCo's documentation."""
    mass, force, jacobian, reference, stiffness, loss, cone = (np.asarray(x, float) for x in problem[:-1])
    away = jacobian @ acceleration - reference
    total = acceleration @ mass @ acceleration / 2 - acceleration @ force
    first, contacts = problem.equalities, len(cone)
    second, third = first + len(loss), len(away) - mjx_solver.CONE * contacts
    total += np.sum(stiffness[:first] * away[:first] ** 2) / 2
    x, d = np.abs(away[first:second]), stiffness[first:second]
    total += np.sum(np.where(d * x < loss, d * x**2 / 2, loss * x - loss**2 / d / 2))
    total += np.sum(stiffness[second:third] * np.minimum(away[second:third], 0) ** 2) / 2
    for x, d, factors in zip(
        away[third:].reshape(contacts, -1), stiffness[third:].reshape(contacts, -1), cone, strict=True
    ):
        mu, normal, tangent = factors[0], x[0] * factors[0], np.linalg.norm(x[1:] * factors[1:])
        if mu * normal + tangent <= 0:
            total += np.sum(d * x**2) / 2
        elif normal < mu * tangent:
            total += d[0] / (mu**2 * (1 + mu**2)) * (normal - mu * tangent) ** 2 / 2
    return total


@pytest.mark.parametrize("noise", [0.0, 5.0])
def test_it_minimises_the_same_cost_as_the_c_engine(visited, noise):
    arrays, fixed, guesses, expected, contacts = visited
    off = np.random.default_rng(0).normal(size=guesses.shape)
    guesses = (guesses + noise * off).astype(np.float32)
    assert contacts.max() >= 8 and contacts.min() == 0

    def solve(parts, guess):
        task = mjx_solver.Problem(*parts, equalities=fixed)
        return mjx_solver.solve(task, guess, mjx_jax.ITERATIONS, mjx_jax.LINE_STEPS, mjx_jax.TOLERANCE)

    found, forces = jax.device_get(jax.jit(jax.vmap(solve))(arrays, guesses))
    for i, (acceleration, best) in enumerate(zip(found, expected, strict=True)):
        task = mjx_solver.Problem(*(part[i] for part in arrays), equalities=fixed)
        least = _cost(task, best)
        assert _cost(task, acceleration.astype(float)) - least < 1e-5 * max(1.0, abs(least)), i
        np.testing.assert_allclose(acceleration[:9], best[:9], atol=1e-4, err_msg=str(i))
        balance = task.mass @ acceleration - task.force - forces[i] @ task.jacobian
        assert np.abs(balance).max() < 1e-3, i


def test_a_state_that_is_not_finite_keeps_no_other_waiting(monkeypatch):
    """The batch's line search turns until its last one is done. A body sinks and slides along a table."""
    turns, slopes = [], mjx_solver._slopes

    def counting(task, line):
        def counted(step):
            jax.debug.callback(lambda _: turns.append(1), step)
            return slopes(task, line)(step)

        return counted

    monkeypatch.setattr(mjx_solver, "_slopes", counting)
    aims, stiffness = jnp.array([5.0, 3.0, 0.1, 0.0]), jnp.full(4, 50.0)
    cone = jnp.full((1, 4), 0.5)

    @jax.jit
    @jax.vmap
    def solve(force):
        task = mjx_solver.Problem(jnp.eye(4), force, jnp.eye(4), aims, stiffness, jnp.zeros(0), cone, 0)
        return mjx_solver.solve(task, jnp.zeros(4), 20, mjx_jax.LINE_STEPS, 1e-8)[0]

    def turns_of(*forces):
        turns.clear()
        found = np.asarray(solve(np.array(forces, np.float32)))
        jax.effects_barrier()
        return len(turns) / len(forces), found

    sound = [-9.81, 1.0, -4.0, 0.5]
    alone, expected = turns_of(sound, sound)
    beside, found = turns_of(sound, [np.nan] * 4)
    assert 2 < beside <= alone < mjx_jax.LINE_STEPS
    np.testing.assert_array_equal(found[0], expected[0])
