"""Trains depthfeat: which treatment, and what was measured, from the pooled features. `ddgrasp ddg features`.

Supervised by what a simulator knows for free, on depth that no camera and no generator of this project made
in the robot's scene. The heads are thrown away; the trunk is frozen under a version.
"""

import shutil
from functools import partial
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jaxtyping import Float, Int

from ddgrasp import artifacts, attempts
from ddgrasp.alone import alone_in
from ddgrasp.config import DepthFeatureConfig
from ddgrasp.config_hash import differences
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_path, atomic_write_json, read_json, read_npz, to_json
from ddgrasp.progress import Progress
from ddgrasp.versions import library_versions
from foundation import depth_features
from foundation.depth_feature_data import MEASURED, TREATMENTS, Batch, Pool, make_batch
from learning.loop import Metrics, run_steps
from learning.optimizers import adamw
from learning.params import save_params
from learning.train_state import TrainState, first_state, updated
from sensors.models.random_scenes import random_device, take_picture

WORK = ".work"
"""Folder of unfinished training, beside the result; removed at the end."""
TEST_SHARE = 1 / 8
"""Share of the devices (cameras, and rooms) that training never sees."""
WARMUP_STEPS = 50
_TEST_MAPS = 768
_SCALE_MAPS = 512
_HIDDEN = 128

CHECKPOINTS = "checkpoints"


class Heads(nn.Module):
    """Features -> logits of the treatments and the standardised measurements."""

    @nn.compact
    def __call__(
        self, features: Float[Array, "B features"]
    ) -> tuple[Float[Array, "B treatments"], Float[Array, "B measurements"]]:
        """Logits, in the order of TREATMENTS; measurements, in the order of MEASURED."""
        h = nn.relu(nn.Dense(_HIDDEN)(nn.LayerNorm()(features)))
        return nn.Dense(len(TREATMENTS))(h), nn.Dense(len(MEASURED))(h)


def train(config: DepthFeatureConfig, out: Path, *, quiet: bool = False) -> dict[str, Any]:
    """Trains, freezes the trunk into `out` and returns its manifest. Continues what is in `out`/.work.

    UserError if `out` holds a finished extractor, or one begun with another configuration, or if another
    process trains there.
    """
    out.mkdir(parents=True, exist_ok=True)
    with alone_in(out):
        return _train(config, out, quiet)


def _train(config: DepthFeatureConfig, out: Path, quiet: bool) -> dict[str, Any]:
    if (out / artifacts.MANIFEST).exists():
        raise UserError(f"{out} holds a finished extractor: choose another --out, or delete it.")
    work = out / WORK
    _check_begun(config, work)
    progress = Progress(work, "features", quiet=quiet)
    training, test = load_pools(config, work, progress)
    scale = _target_scale(training, config.seed)
    params = _optimise(config, training, scale, work, progress)
    result, tested = _frozen(params, training, config.seed), _test(params, test, scale, config.seed)
    save_params(out / depth_features.PARAMS_FILE, result)
    digest = depth_features.file_digest(out / depth_features.PARAMS_FILE)
    manifest = {
        "name": depth_features.name_of(digest),
        "sha256": digest,
        "config": config,
        "trained_on": {"pictures": len(training), "treatments": list(TREATMENTS)},
        "tested_on_new_cameras": tested,
        "versions": library_versions(),
        "seconds": round(progress.seconds),
    }
    progress.close()
    atomic_write_json(out / artifacts.MANIFEST, manifest)
    shutil.rmtree(work, ignore_errors=True)
    return to_json(manifest)


def _check_begun(config: DepthFeatureConfig, work: Path) -> None:
    path = work / attempts.STARTED
    wanted = to_json(config)
    if path.exists() and (other := next(differences(read_json(path), wanted), "")):
        raise UserError(
            f"{work} was begun with other settings ({other}): use those, another --out, or delete it."
        )
    atomic_write_json(path, wanted)


# --- pictures ------------------------------------------------------------------------------------


def load_pools(config: DepthFeatureConfig, work: Path, progress: Progress) -> tuple[Pool, Pool]:
    """(training, test) pictures; devices whose file is in `work` are not taken anew."""
    files = [work / f"device_{number:03d}.npz" for number in range(config.devices)]
    with progress.task("random cameras", config.devices) as task:
        task.start_at(sum(file.exists() for file in files))
        for number, file in enumerate(files):
            if not file.exists():
                _take_pictures(config, number, file)
                task.advance()
    pools = [Pool(**read_npz(file, "delete it and run the same command again")) for file in files]
    tested = max(1, round(config.devices * TEST_SHARE))
    return _joined(pools[:-tested]), _joined(pools[-tested:])


def _take_pictures(config: DepthFeatureConfig, number: int, file: Path) -> None:
    rng = np.random.default_rng((config.seed, number))
    device = random_device(rng, config.width_px)
    taken = [take_picture(rng, device) for _ in range(config.pictures)]
    arrays: dict[str, Any] = {name: np.stack([vars(p)[name] for p in taken]) for name in vars(taken[0])}
    with atomic_path(file) as path:
        np.savez_compressed(path, **arrays)


def _joined(pools: list[Pool]) -> Pool:
    return Pool(**{name: np.concatenate([vars(p)[name] for p in pools]) for name in vars(pools[0])})


def _draw(pool: Pool, count: int, *seed: int) -> Batch:
    rng = np.random.default_rng(seed)
    return make_batch(pool, rng.integers(len(pool), size=count), rng)


def _target_scale(pool: Pool, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(mean, deviation) of the regression targets."""
    measured = _draw(pool, _SCALE_MAPS, seed, 1).measured
    return measured.mean(0), measured.std(0) + 1e-3


# --- optimisation ----------------------------------------------------------------------------------


def _outputs(params: Any, depth_m: Array) -> tuple[Array, Array, Array]:
    features: Any = depth_features.Trunk().apply({"params": params["trunk"]}, depth_m)
    outputs: Any = Heads().apply({"params": params["heads"]}, features)
    logits, measured = outputs
    return features, logits, measured


def loss(
    params: Any,
    depth_m: Float[Array, "B H W"],
    family: Int[Array, " B"],
    target: Float[Array, "B measurements"],
) -> Float[Array, ""]:
    """Cross-entropy of the treatment + mean squared error of the standardised measurements."""
    _, logits, measured = _outputs(params, depth_m)
    named = optax.softmax_cross_entropy_with_integer_labels(logits, family).mean()
    return named + jnp.mean((measured - target) ** 2)


def _optimizer(config: DepthFeatureConfig) -> optax.GradientTransformation:
    return adamw(config.learning_rate, config.steps, warmup=WARMUP_STEPS)


@partial(jax.jit, static_argnums=0, donate_argnums=1)
def train_step(
    config: DepthFeatureConfig,
    state: TrainState,
    depth_m: Float[Array, "B H W"],
    family: Int[Array, " B"],
    target: Float[Array, "B measurements"],
) -> tuple[TrainState, Metrics]:
    """One optimiser step; `target` is standardised."""
    value, grads = jax.value_and_grad(loss)(state.params, depth_m, family, target)
    return updated(state, _optimizer(config), grads, ema_decay=0.0), {"loss": value}


def init_state(config: DepthFeatureConfig) -> TrainState:
    """State before the first step."""
    keys = jax.random.split(jax.random.key(config.seed))
    trunk = depth_features.Trunk().init(keys[0], jnp.zeros((1, 32, 32)))["params"]
    heads = Heads().init(keys[1], jnp.zeros((1, depth_features.FEATURES)))["params"]
    params = {"trunk": trunk, "heads": heads}
    return first_state(params, _optimizer(config), jax.random.key_data(keys[0]))


def _optimise(
    config: DepthFeatureConfig, pool: Pool, scale: tuple[np.ndarray, np.ndarray], work: Path,
    progress: Progress,
) -> Any:  # fmt: skip
    """Parameters after `config.steps`; batch n is a function of (seed, n) alone, so a resumed run equals an
    uninterrupted one."""

    def step_once(state: TrainState, number: int) -> tuple[TrainState, Metrics]:
        batch = _draw(pool, config.batch_size, config.seed, 2, number)
        target = (batch.measured - scale[0]) / scale[1]
        return train_step(config, state, batch.depth_m, batch.family, target)

    state, _ = run_steps(
        init_state(config), config.steps, step_once, work / CHECKPOINTS,
        every=config.checkpoint_every, label="training", progress=progress,
    )  # fmt: skip
    return state.params


def _frozen(params: Any, pool: Pool, seed: int) -> dict[str, Any]:
    """What is kept: the trunk, and the mean and deviation of its features over training pictures."""
    features = _features(params, _draw(pool, _TEST_MAPS, seed, 3).depth_m)
    return {"trunk": params["trunk"], "mean": features.mean(0), "std": features.std(0) + 1e-4}


def _test(params: Any, pool: Pool, scale: tuple[np.ndarray, np.ndarray], seed: int) -> dict[str, Any]:
    """Share of treatments named rightly and R^2 per measurement, on cameras that training never saw."""
    batch = _draw(pool, _TEST_MAPS, seed, 4)
    outputs = [_outputs_jit(params, part) for part in np.array_split(batch.depth_m, len(batch.depth_m) // 16)]
    logits, measured = (np.concatenate([np.asarray(o[i]) for o in outputs]) for i in (1, 2))
    target = (batch.measured - scale[0]) / scale[1]
    unexplained = ((measured - target) ** 2).mean(0) / (target.var(0) + 1e-6)
    return {
        "treatment_accuracy": float(np.mean(logits.argmax(1) == batch.family)),
        "r_squared": {name: round(1 - float(u), 3) for name, u in zip(MEASURED, unexplained, strict=True)},
    }


_outputs_jit = jax.jit(_outputs)


def _features(params: Any, depth_m: np.ndarray) -> np.ndarray:
    parts = np.array_split(depth_m, len(depth_m) // 16)
    return np.concatenate([np.asarray(_outputs_jit(params, part)[0]) for part in parts])
