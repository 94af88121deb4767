"""What `sample` draws: the prior's own noise, and in DDPM another one at every step."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddg_jax import sample
from ddgrasp.config import DDGConfig, PriorConfig, SamplingConfig
from learning import diffusion


@pytest.fixture
def seen(monkeypatch):
    """Lists of what each network call and each DDPM step got; the network is one that predicts nothing."""
    conditions: list = []
    noises: list = []

    def blind(config, params, x, c, step):
        conditions.append(np.asarray(c))
        return jnp.zeros_like(x)

    def stepped(made, x, k, previous, eps, noise, limit):
        noises.append(np.asarray(noise))
        return x

    monkeypatch.setattr(sample, "predict_noise", blind)
    monkeypatch.setattr(diffusion, "ddpm_step", stepped)
    return conditions, noises


def drawn(config: DDGConfig) -> None:
    c = jnp.zeros((2, 12, 16))
    with jax.disable_jit():
        sample.sample(config, jax.random.key(0), {}, c, jnp.int32(3), jnp.arange(2), steps=3)


def test_the_prior_is_disturbed_as_in_training_and_stays_so_over_the_steps(seen):
    drawn(DDGConfig(prior=PriorConfig(noise=0.25), sampling=SamplingConfig(frame_correlation=0.0)))
    first, *others = seen[0]
    assert len(others) == 2 and all(np.array_equal(first, other) for other in others)
    assert first.std() == pytest.approx(0.25, rel=0.15) and not np.allclose(first[0], first[1])


def test_every_step_of_ddpm_has_noise_of_its_own(seen):
    config = DDGConfig(sampling=SamplingConfig(sampler="ddpm", frame_correlation=0.0))
    drawn(config)
    noises = np.stack(seen[1]).reshape(3, -1)
    assert noises.std() == pytest.approx(1, rel=0.15)
    assert np.abs(np.corrcoef(noises) - np.eye(3)).max() < 0.2
    drawn(replace(config, prior=PriorConfig(noise=0.0)))
    np.testing.assert_array_equal(np.stack(seen[1][3:]).reshape(3, -1), noises)
