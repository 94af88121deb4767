"""The optimiser of every supervised training here; PPO's, which decays linearly, is `ppo.learner`'s."""

import optax


def adamw(
    peak: float,
    steps: int,
    *,
    warmup: int,
    final_share: float = 0.0,
    weight_decay: float = 0.0,
    clip: float = 1.0,
) -> optax.GradientTransformation:
    """AdamW (Loshchilov & Hutter 2019) on gradients of limited norm, with warm-up and cosine decay.

    Args:
      peak: the learning rate after the warm-up.
      steps: the rate rises linearly from 0, then falls along half a cosine until so many steps are done.
      warmup: steps of the rise; a tenth of `steps` at most, one at least.
      final_share: of `peak`, what is left at the end.
      weight_decay: 0 is Adam.
      clip: gradients whose global norm is larger are scaled down to it.
    """
    rise = min(warmup, max(1, steps // 10))
    rate = optax.warmup_cosine_decay_schedule(0.0, peak, rise, max(steps, rise + 1), final_share * peak)
    return optax.chain(optax.clip_by_global_norm(clip), optax.adamw(rate, weight_decay=weight_decay))
