"""Diffusion equations against a reference implementation's recorded values, and by hand."""

import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp.config import SPACINGS, HeadConfig, StudentConfig
from ddgrasp.errors import UserError
from learning import diffusion as s
from student_jax.policy import noise_schedule

PARITY = Path(
    os.environ.get("PARITY_DIR") or Path(__file__).resolve().parents[1].parent / "shared/parity/public"
)
FILE = PARITY / "unit_diffusion_schedule.npz"
NAMES = {"linear": "linear", "squaredcos_cap_v2": "cosine"}


@pytest.fixture(scope="module")
def reference():
    if not FILE.exists():
        pytest.skip(f"no parity file {FILE.name} in {PARITY} (set PARITY_DIR)")
    with np.load(FILE) as arrays:
        values = {name: arrays[name] for name in arrays.files}
    cases = json.loads(bytes(values["meta_json"]).decode())["cases"]
    return values, cases


def stub_model(x, step):
    return jnp.tanh(0.7 * x + 0.1 * jnp.sin(step))


def test_schedule_and_forward_process_match_the_reference(reference):
    values, cases = reference
    for i, case in enumerate(cases):
        made = s.make_schedule(NAMES[case["beta_schedule"]], case["num_train_timesteps"])
        np.testing.assert_allclose(made.betas, values[f"case{i}/betas"], rtol=2e-4, atol=1e-7)
        np.testing.assert_allclose(made.alpha_bars, values[f"case{i}/alphas_cumprod"], rtol=1e-3, atol=2e-7)
        x_k = s.q_sample(made, values[f"case{i}/x0"], values[f"case{i}/t"], values[f"case{i}/eps"])
        np.testing.assert_allclose(x_k, values[f"case{i}/q_sample"], atol=2e-5)


def test_samplers_match_the_reference(reference):
    values, cases = reference
    compared = 0
    for i, case in enumerate(cases):
        made = s.make_schedule(NAMES[case["beta_schedule"]], case["num_train_timesteps"])
        clip = 1.0 if case["clip_sample"] else None
        visited = s.timesteps(made.steps, case["ddim_steps"], case["ddim_timestep_spacing"])
        np.testing.assert_array_equal(visited, values[f"case{i}/ddim_timesteps"])
        with jax.enable_x64(True):
            x = jnp.asarray(values[f"case{i}/xT"])
            for k, previous in zip(visited, s.previous_steps(visited), strict=True):
                step = s.ddim_coefficients(made, k, previous, x, case["eta"])
                x = s.ddim_step(step, x, stub_model(x, k), clip)
            np.testing.assert_allclose(x, values[f"case{i}/ddim_out"], rtol=0, atol=2e-5)
            compared += 1
            if f"case{i}/ddpm_out" in values:
                x = jnp.asarray(values[f"case{i}/xT"])
                for k in range(made.steps - 1, -1, -1):
                    noise = values[f"case{i}/noise"][k]
                    x = s.ddpm_step(made, x, k, k - 1, stub_model(x, k), noise, clip)
                np.testing.assert_allclose(x, values[f"case{i}/ddpm_out"], rtol=0, atol=2e-5)
                compared += 1
    assert compared >= len(cases)


def test_two_step_schedule_by_hand():
    made = s.Schedule(np.array([0.5, 0.5], np.float32), np.array([0.5, 0.25], np.float32))
    x_0, eps = jnp.ones((1, 2)), jnp.full((1, 2), 2.0)
    x_1 = s.q_sample(made, x_0, jnp.array([1]), eps)
    np.testing.assert_allclose(x_1, 0.5 + 2 * np.sqrt(0.75), rtol=1e-6)
    np.testing.assert_allclose(s.predict_x_0(made, x_1, 1, eps), x_0, rtol=1e-6)
    # q(x_0' | x_1, x_0): a=.25, a_prev=.5, alpha=.5 -> (sqrt(.5) * .5 * x_0 + sqrt(.5) * .5 * x_1) / .75
    want = np.sqrt(0.5) * 0.5 * (1 + x_1[0, 0]) / 0.75
    np.testing.assert_allclose(s.posterior_mean(made, x_1, x_0, 1, 0)[0, 0], want, rtol=1e-6)
    np.testing.assert_allclose(s.posterior_variance(made, 1, 0, x_1)[0], 0.5 / 0.75 * 0.5, rtol=1e-6)
    np.testing.assert_allclose(
        s.ddim_step(s.ddim_coefficients(made, 1, -1, x_1), x_1, eps, None), x_0, rtol=1e-6
    )


def test_ddim_with_eta_one_equals_ddpm():
    made = s.make_schedule("cosine", 50)
    x = jax.random.normal(jax.random.key(0), (3, 4))
    eps, noise = jax.random.normal(jax.random.key(1), (2, 3, 4))
    for k, previous in ((40, 30), (10, 9), (9, -1)):
        ddim = s.ddim_step(s.ddim_coefficients(made, k, previous, x, eta=1.0), x, eps, None, noise=noise)
        np.testing.assert_allclose(ddim, s.ddpm_step(made, x, k, previous, eps, noise, None), atol=2e-5)


def test_stochastic_ddim_from_pure_noise_stays_finite():
    made = s.make_schedule("cosine", 1000)
    x = jax.random.normal(jax.random.key(0), (2, 3))
    for count in (2, 3, 7):
        visited = s.timesteps(made.steps, count, "trailing")
        for k, previous in zip(visited, s.previous_steps(visited), strict=True):
            step = s.ddim_coefficients(made, k, previous, x, eta=1.0)
            assert np.isfinite(s.ddim_step(step, x, x, 1.0, noise=x)).all(), (count, k)


def test_shift_moves_log_snr_by_the_amount():
    plain, moved = s.make_schedule("linear", 100), s.make_schedule("linear", 100, log_snr_shift=-1.5)
    log_snr = [np.log(a / (1 - a)) for a in (plain.alpha_bars, moved.alpha_bars)]
    np.testing.assert_allclose(log_snr[1] - log_snr[0], -1.5, atol=1e-3)


def test_timestep_spacing():
    assert s.timesteps(1000, 5, "trailing").tolist() == [999, 799, 599, 399, 199]
    assert s.timesteps(1000, 5, "leading").tolist() == [800, 600, 400, 200, 0]
    assert s.timesteps(11, 3, "linspace").tolist() == [10, 5, 0]
    assert s.timesteps(1000, 4, "quadratic").tolist() == [999, 561, 249, 61]
    assert s.timesteps(10, 8, "quadratic").tolist() == [9, 7, 5, 4, 3, 2, 1, 0]  # none twice, none below 0
    for spacing in SPACINGS:
        assert s.timesteps(1000, 1, spacing).tolist() == [999]  # pure noise
    assert s.previous_steps(np.array([800, 0])).tolist() == [0, -1]
    with pytest.raises(UserError, match="trailing"):
        s.timesteps(10, 2, "trailling")
    with pytest.raises(UserError, match="11"):
        s.timesteps(10, 11)


def test_dpm_solver_is_of_second_order_on_a_gaussian():
    """For x_0 ~ N(0, s^2) both the best prediction and the exact end of the reverse process are known."""
    made, spread = s.make_schedule("cosine", 1000), 0.3
    x_start = jnp.array([[1.3]])

    def best(x, k):
        a = s.alpha_bar_at(made, k, x)
        return jnp.sqrt(a) * spread**2 * x / (a * spread**2 + 1 - a)

    def error(count: int, second_order: bool) -> float:
        visited = s.timesteps(1000, count, "quadratic")
        x, before, x_0_before = x_start, jnp.array([visited[0]]), x_start
        for k, previous in zip(visited, s.previous_steps(visited), strict=True):
            k, previous = jnp.array([k]), jnp.array([previous])
            x_0 = best(x, k)
            if second_order:
                x = s.dpm_solver_step(made, x, k, previous, x_0, before, x_0_before)
            else:
                step = s.ddim_coefficients(made, k, previous, x)
                x = s.ddim_step(step, x, s.eps_from_x_0(made, x, k, x_0), None)
            before, x_0_before = k, x_0
        return abs(float(x[0, 0]) - 1.3 * spread)

    assert error(1, True) == pytest.approx(error(1, False), abs=1e-5)
    for count in (8, 16, 32):
        assert error(count, True) < 0.4 * error(count, False), count


# --- the action head's schedule and sampler --------------------------------------------------------


def test_schedule_falls_from_almost_one_to_almost_zero():
    schedule = noise_schedule(StudentConfig(head=HeadConfig(diffusion_steps=50))).alpha_bars
    assert schedule[0] > 0.99 and np.all(np.diff(schedule) < 0)
    assert np.sqrt(schedule[-1]) == pytest.approx(0.0310, abs=1e-3)


@pytest.mark.parametrize("iterations", [1, 3, 10])
def test_ddim_with_perfect_noise_prediction_returns_the_clean_sample(iterations):
    schedule = noise_schedule(StudentConfig(head=HeadConfig(diffusion_steps=50)))
    x0 = jax.random.uniform(jax.random.key(0), (5, 4, 8), minval=-1, maxval=1)

    def predict(x, k):
        a = jnp.asarray(schedule.alpha_bars)[k][:, None, None]
        return (x - jnp.sqrt(a) * x0) / jnp.sqrt(1 - a)

    noise = jax.random.normal(jax.random.key(1), x0.shape)
    sampled = s.ddim_sample(predict, noise, schedule, iterations)
    np.testing.assert_allclose(sampled, x0, atol=1e-4)


def test_ddim_step_clips_and_keeps_explaining_x():
    step = s.DDIMCoefficients((2.0, np.sqrt(3.0), 0.8, 0.6))  # a = 1/4, a' = 0.64
    x, eps = jnp.array([1.0]), jnp.array([-1.0])  # x0 = 2 + 1.73, clipped to 1
    # eps' = (2 * 1 - 1) / sqrt(3); x' = 0.8 * 1 + 0.6 * eps'
    made = s.ddim_step(step, x, eps, 1.0, after_clip=s.CONSISTENT)
    np.testing.assert_allclose(made, [0.8 + 0.6 / np.sqrt(3.0)], rtol=1e-6)


def test_ddim_step_may_keep_the_predicted_eps_after_clipping():
    """The same step as above: x0 is clipped to 1, the direction stays the predicted -1."""
    x, eps = jnp.array([1.0]), jnp.array([-1.0])
    step = s.DDIMCoefficients((2.0, np.sqrt(3.0), 0.8, 0.6))
    np.testing.assert_allclose(s.ddim_step(step, x, eps, 1.0), [0.8 - 0.6], rtol=1e-6)
    # Unclipped the two agree: x0 = 2 + 1.73.
    for after_clip in (s.PREDICTED, s.CONSISTENT):
        made = s.ddim_step(step, x, eps, None, after_clip=after_clip)
        np.testing.assert_allclose(made, [0.8 * (2 + np.sqrt(3)) - 0.6], rtol=1e-6)


@pytest.mark.parametrize(
    ("after_clip", "expected"), [(s.PREDICTED, [-0.6, 0.68]), (s.CONSISTENT, [0.8 + 0.6 / np.sqrt(3), 0.68])]
)
def test_both_sets_of_coefficients_take_the_same_step(after_clip, expected):
    """alpha_bar 1/4 -> 0.64. The first entry's x0 is 2 + 7 / sqrt 3 and clipped, the second's is 0.1."""
    made = s.Schedule(np.array([0.36, 0.609375], np.float32), np.array([0.64, 0.25], np.float32))
    eps = jnp.array([-7 / 3, 1.0])
    x = jnp.array([1.0, 0.05 + np.sqrt(0.75)])
    computed = s.ddim_step(s.ddim_coefficients(made, 1, 0, x), x, eps, 1.0, after_clip=after_clip)
    row = s.ddim_table(made, np.array([1, 0]))[0]
    np.testing.assert_allclose(row, [2, np.sqrt(3), 0.8, 0.6], rtol=1e-6)
    tabled = s.ddim_step(s.DDIMCoefficients(row), x, eps, 1.0, after_clip=after_clip)
    np.testing.assert_allclose(computed, expected, rtol=1e-5)
    np.testing.assert_allclose(tabled, expected, rtol=1e-5)


def test_the_last_row_of_the_table_leads_to_the_clean_sample():
    made = s.make_schedule("cosine", 20)
    assert s.ddim_table(made, s.timesteps(20, 4))[-1, 2:].tolist() == [1, 0]


def test_linear_noise_rises_from_a_ten_thousandth_to_a_fiftieth():
    np.testing.assert_allclose(s.linear_betas(3), [1e-4, 0.01005, 0.02], rtol=1e-12)


def test_a_terminal_time_below_one_is_the_start_of_the_whole_schedule():
    """Half the time in 10 steps is the first half of 20 steps."""
    np.testing.assert_allclose(s.cosine_betas(10, 0.5), s.cosine_betas(20)[:10], rtol=1e-12)
    action = noise_schedule(StudentConfig(head=HeadConfig(diffusion_steps=50)))
    f = np.cos((np.arange(51) / 50 * 0.98 + 0.008) / 1.008 * np.pi / 2) ** 2
    np.testing.assert_array_equal(action.alpha_bars, (f[1:] / f[0]).astype(np.float32))
