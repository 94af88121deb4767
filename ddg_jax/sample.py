"""Sampling: prior c -> noisy depth; simulated depth -> grafted noisy depth, per batch or per episode."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Float32, Int, Key, UInt8

from ddg_jax.distil import X_LIMIT, params_file
from ddg_jax.graft import graft
from ddg_jax.prior import Prior, make_prior
from ddg_jax.representation import channels, correlations, decode
from ddg_jax.train import config_schedule, init_params, predict_noise
from ddg_jax.window import mixed
from ddgrasp import artifacts
from ddgrasp.arrays import AnyArray
from ddgrasp.config import DDIM, DDPM, DPM_SOLVER, PROGRESSIVE, DDGConfig
from ddgrasp.depth import resize_nearest
from ddgrasp.errors import UserError
from ddgrasp.generator_metadata import ASPECT_TOLERANCE, FARTHEST_SANE_M
from ddgrasp.shipped import holding, shipped
from learning import diffusion
from learning.convolutions import compiler_options
from learning.params import Params, load_params, save_params

PARAMS_FILE = "params.msgpack"
SHARED = 2**31 - 1
"""Stands for the frame number in the key of the noise that an episode's frames share."""


@dataclass(frozen=True)
class Generator:
    """A generator ready to sample: what `generate` needs."""

    config: DDGConfig
    params: Params
    """Parameters of the fitted network, or of the distilled one for sampler progressive."""
    prior: Prior

    @classmethod
    def load(cls, directory: Path | str, sampler: str = "", steps: int = 0) -> "Generator":
        """The generator in a finished `ddg` stage directory, or in a run's; UserError if there is none.

        Args:
          sampler: instead of the one it was made with; dpm_solver takes quadratic steps then, since those of
            another one make it leave specks (docs/generator.md).
          steps: the same for network evaluations per map; for sampler progressive a number to which the stage
            distilled on its way.
        """
        directory = holding(directory, artifacts.MANIFEST, "ddg") or shipped(directory)
        manifest = artifacts.read_manifest(directory)
        if manifest.stage != "ddg":
            raise UserError(f"{directory} holds a {manifest.stage!r} artifact; expected one of stage 'ddg'.")
        config = artifacts.config_from_json(manifest.config).ddg
        sampler, steps = sampler or config.sampling.sampler, steps or config.sampling.steps
        file = directory / (params_file(steps) if sampler == PROGRESSIVE else PARAMS_FILE)
        if sampler == PROGRESSIVE and not file.exists():
            raise UserError(
                f"{directory} holds no {file.name}: distil one with `ddgrasp ddg distil --model {directory} "
                f"--evaluations {steps} --data RECORDINGS --out RUN` on the recordings that it was fitted on."
            )
        spacing = config.sampling.spacing
        if sampler == DPM_SOLVER != config.sampling.sampler:
            spacing = "quadratic"
        sampling = replace(config.sampling, sampler=sampler, steps=steps, spacing=spacing)
        config = replace(config, sampling=sampling)
        params = load_params(file, init_params.eval_shape(config, jax.random.key(0)))
        return cls(config, params, make_prior(config))

    def on_devices(self, sharding: NamedSharding) -> Params:
        """The parameters there, brought once."""
        placed = self.__dict__.get("_placed")
        if placed is None or placed[0] != sharding:
            placed = sharding, jax.device_put(self.params, sharding)
            object.__setattr__(self, "_placed", placed)
        return placed[1]

    def save(self, directory: Path | str) -> None:
        """Writes a fitted network's parameters; the manifest, written by the stage, makes them loadable."""
        save_params(Path(directory) / PARAMS_FILE, self.params)


# --- noise shared between the frames of an episode ------------------------------------------------


def frame_noise(
    key: Key[Array, ""],
    episode: Int[ArrayLike, ""] | Int[ArrayLike, " B"],
    frame: Int[AnyArray, " B"],
    shape: tuple[int, ...],
    correlation: float | tuple[float, ...],
) -> Float[Array, "B ..."]:
    """Standard normal noise (B, *shape): sqrt(r) g_episode + sqrt(1 - r) g_frame, r = `correlation`.

    Frames of one episode share g_episode, so holes stay where they are between frames, as on a camera; every
    frame's noise depends on (key, episode, frame) alone, however the frames are batched.

    Args:
      episode: its number, a scalar if all frames are of one episode (cheaper), else (B,).
      frame: (B,) int, numbers within the episode.
      correlation: r, or one for each entry of the last axis.
    """
    r = jnp.asarray(correlation)

    def own(e: AnyArray, t: ArrayLike) -> Array:
        return jax.random.normal(jax.random.fold_in(jax.random.fold_in(key, e), t), shape)

    over_episodes = None if jnp.ndim(episode) == 0 else 0
    shared = own(episode, SHARED) if over_episodes is None else jax.vmap(own, (0, None))(episode, SHARED)
    single = jax.vmap(own, (over_episodes, 0))(episode, frame)
    return jnp.sqrt(r) * shared + jnp.sqrt(1 - r) * single


# --- the reverse process --------------------------------------------------------------------------


@partial(jax.jit, static_argnums=(0,), static_argnames=("steps",))
def sample(
    config: DDGConfig,
    key: Key[Array, ""],
    params: Params,
    c: Float[Array, "B H W"],
    episode: Int[Array, ""] | Int[Array, " B"],
    frame: Int[Array, " B"],
    *,
    steps: int,
) -> Float32[Array, "B H W C"]:
    """Generated maps x (see ddg_jax/representation.py), (B, H, W, C) float32.

    Args:
      key: the whole data set's key; c: (B, H, W); episode, frame: see `frame_noise`.
      steps: network evaluations per map.
    """
    if config.sampling.sampler == PROGRESSIVE and steps != config.sampling.steps:
        raise UserError(
            f"This generator was distilled to {config.sampling.steps} evaluations, not {steps}: load the one "
            "for those, or sampler ddim."
        )
    made = config_schedule(config)
    visited = diffusion.timesteps(made.steps, steps, config.sampling.spacing)
    size = c.shape[1], c.shape[2]
    numbered = partial(frame_noise, episode=episode, frame=frame)
    noise = partial(numbered, shape=(*size, channels(config)), correlation=correlations(config))
    prior_key, start_key, step_key = jax.random.split(key, 3)
    c = c + config.prior.noise * numbered(
        prior_key, shape=size, correlation=config.sampling.frame_correlation
    )

    def body(last: tuple[Array, Array], now: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], None]:
        (x, x_0_before), (before, k, previous) = last, now
        eps = predict_noise(config, params, x, c, jnp.full(x.shape[:1], k))
        fresh = partial(noise, jax.random.fold_in(step_key, k))
        x_0 = jnp.clip(diffusion.predict_x_0(made, x, k, eps), -X_LIMIT, X_LIMIT)
        if config.sampling.sampler == DPM_SOLVER:
            x = diffusion.dpm_solver_step(made, x, k, previous, x_0, before, x_0_before)
        elif config.sampling.sampler == DDPM:
            x = diffusion.ddpm_step(made, x, k, previous, eps, fresh(), X_LIMIT)
        elif config.sampling.sampler == PROGRESSIVE:
            x = diffusion.ddim_step(diffusion.ddim_coefficients(made, k, previous, x), x, eps, None)
        elif config.sampling.sampler == DDIM:
            extra = fresh() if config.sampling.eta else 0.0
            step = diffusion.ddim_coefficients(made, k, previous, x, config.sampling.eta)
            x = diffusion.ddim_step(step, x, eps, X_LIMIT, noise=extra)
        else:
            raise ValueError(f"sampler {config.sampling.sampler!r} has no step")
        return (x, x_0), None

    start = noise(start_key)
    before = np.append(visited[:1], visited[:-1])
    path = jnp.asarray(before), jnp.asarray(visited), jnp.asarray(diffusion.previous_steps(visited))
    (x, _), _ = jax.lax.scan(body, (start, start), path)
    return x


# --- from simulated depth to noisy depth ----------------------------------------------------------


@dataclass(frozen=True)
class Generated:
    """Simulated depth with a camera's artefacts; 0 = hole."""

    depth_m: Float32[np.ndarray, "B H W"]
    """The result, grafted (paper III-B2)."""
    predicted_m: Float32[np.ndarray, "B H W"]
    """The generator's own map."""
    mask: Bool[np.ndarray, "B H W"]
    """M, the artefacts that were grafted."""


def generate(
    key: Key[Array, ""],
    generator: Generator,
    depth_m: np.ndarray,
    rgb: UInt8[np.ndarray, "B h w 3"] | None = None,
    *,
    episode: int | Int[np.ndarray, " B"] = 0,
    frame: Int[np.ndarray, " B"] | None = None,
    steps: int | None = None,
) -> Generated:
    """Gives simulated frames the camera's artefacts: one episode, or a batch from many environments.

    Args:
      depth_m: (B, H, W) clean planar depth, 0 = nothing within range; in time order if of one episode. Any
        size with the generator's aspect ratio; the artefacts are made at the generator's size.
      rgb: (B, h, w, 3) uint8, for priors that need it.
      episode: number of the episode, which decides its noise; (B,) if every frame has its own.
      frame: (B,) numbers within the episode, 0, 1, ... by default.
      steps: network evaluations per map, the configuration's by default.

    Raises UserError for depth of another type, rank, unit or aspect ratio, and for numbers that are not of
    its frames.
    """
    _check_depth(depth_m, generator.config)
    _check_numbers("episode", np.asarray(episode), len(depth_m), alone=True)
    if frame is not None:
        _check_numbers("frame", np.asarray(frame), len(depth_m), alone=False)
    depth_m = mixed(depth_m, generator.config.graft)
    c = condition(generator, depth_m, rgb, one_episode=np.ndim(episode) == 0)
    x = predict(key, generator, c, episode=episode, frame=frame, steps=steps)
    return grafted(generator.config, depth_m, x)


def condition(
    generator: Generator,
    depth_m: np.ndarray,
    rgb: UInt8[np.ndarray, "B H W 3"] | None,
    *,
    one_episode: bool,
) -> Float32[np.ndarray, "B h w"]:
    """c (B, h, w) at the generator's size of one sequence, or of frames that have nothing to do with each
    other. Arguments and errors of `generate`.
    """
    config, prior = generator.config, generator.prior
    _check_depth(depth_m, config)
    clean = resize_nearest(depth_m, (config.depth.height_px, config.depth.width_px))
    if one_episode:
        return prior.from_sim(clean, rgb)
    pictures = [None] * len(clean) if rgb is None else [picture[None] for picture in rgb]
    return np.concatenate([prior.from_sim(d[None], p) for d, p in zip(clean, pictures, strict=True)])


def grafted(
    config: DDGConfig, depth_m: Float[np.ndarray, "B H W"], x: Float[np.ndarray, "B h w C"]
) -> Generated:
    """Maps x (B, h, w, C) of `predict` on clean depth_m (B, H, W), in batches of one compiled size."""
    sized = np.moveaxis(resize_nearest(np.moveaxis(x, -1, 1), depth_m.shape[1:]), 1, -1)
    size = batch_size(config)
    parts = []
    for start in range(0, len(depth_m), size):
        now = slice(start, start + size)
        made = graft_maps(config, _batch(depth_m[now], size), _batch(sized[now], size))
        parts.append([np.asarray(part)[: len(depth_m[now])] for part in made])
    return Generated(*map(np.concatenate, zip(*parts, strict=True)))


@partial(jax.jit, static_argnums=0)
def graft_maps(
    config: DDGConfig, depth_m: Float[Array, "B H W"], x: Float[Array, "B H W C"]
) -> tuple[Float[Array, "B H W"], Float[Array, "B H W"], Bool[Array, "B H W"]]:
    """The program of `grafted`: metres, grafted and the generator's own, and the mask of artefacts."""
    predicted = decode(config, x, depth_m)
    return graft(depth_m, predicted.depth_m, predicted.mask), predicted.depth_m, predicted.mask


def batch_size(config: DDGConfig) -> int:
    """Frames that one call of the network takes, over all devices of this process."""
    return config.sampling.batch_size * jax.local_device_count()


_sample_here = jax.jit(
    sample, static_argnums=(0,), static_argnames=("steps",), compiler_options=compiler_options()
)
"""`sample`, which other programs contain, as a program of its own."""


def predict(
    key: Key[Array, ""],
    generator: Generator,
    c: Float[np.ndarray, "B H W"],
    *,
    episode: int | Int[np.ndarray, " B"] = 0,
    frame: Int[np.ndarray, " B"] | None = None,
    steps: int | None = None,
) -> Float32[np.ndarray, "B H W C"]:
    """Maps x (B, H, W, C) for priors c (B, H, W), in batches of one compiled size, split over this
    process's devices. Arguments of `generate`.
    """
    config, size = generator.config, batch_size(generator.config)
    frame = np.arange(len(c)) if frame is None else np.asarray(frame)
    number = np.asarray(episode)
    mesh = Mesh(np.array(jax.local_devices()), ("frames",))
    split, everywhere = (NamedSharding(mesh, PartitionSpec(*axes)) for axes in (("frames",), ()))
    params, made = generator.on_devices(everywhere), []
    for start in range(0, len(c), size):
        now = slice(start, start + size)
        x = _sample_here(
            config,
            key,
            params,
            jax.device_put(_batch(c[now], size), split),
            jnp.asarray(number) if number.ndim == 0 else jax.device_put(_batch(number[now], size), split),
            jax.device_put(_batch(frame[now], size), split),
            steps=steps or config.sampling.steps,
        )
        made.append(x)
        if len(made) > 1:  # while the devices are at this one
            made[-2] = np.asarray(made[-2])
    return np.concatenate([np.asarray(x) for x in made])[: len(c)]


def _batch(values: np.ndarray, size: int) -> np.ndarray:
    """`filled_up` as float32, or int32 of whole numbers."""
    floats = np.issubdtype(values.dtype, np.floating)
    return filled_up(np.asarray(values, np.float32 if floats else np.int32), size)


def filled_up(values: np.ndarray, size: int) -> np.ndarray:
    """`values` (n <= size, ...) with zeros behind them up to `size`."""
    return np.concatenate([values, np.zeros((size - len(values), *values.shape[1:]), values.dtype)])


def check_aspect(size: tuple[int, ...], config: DDGConfig) -> None:
    """UserError if simulated depth of (H, W) `size` is not of the generator's shape."""
    (height, width), maps = size, config.depth
    if abs(width / height / (maps.width_px / maps.height_px) - 1) > ASPECT_TOLERANCE:
        raise UserError(
            f"Simulated depth is {width}x{height}, the generator's {maps.width_px}x{maps.height_px}: render "
            f"with that aspect ratio, or fit one with --ddg.depth.height-px "
            f"{round(maps.width_px * height / width)}."
        )


def _check_depth(depth_m: np.ndarray, config: DDGConfig) -> None:
    if depth_m.ndim != 3 or not np.issubdtype(depth_m.dtype, np.floating):
        raise UserError(
            f"Simulated depth is {depth_m.dtype} {depth_m.shape}; expected (T, H, W) floating-point metres."
        )
    if not depth_m.size:
        raise UserError(f"Simulated depth is {depth_m.shape}; expected a frame or more.")
    _check_metres(depth_m)
    check_aspect(depth_m.shape[1:], config)


def _check_metres(depth_m: Float[np.ndarray, "..."]) -> None:
    """UserError if simulated depth is in another unit, negative or not finite."""
    low, high = np.min(depth_m, initial=0), np.max(depth_m, initial=0)
    if not (low >= 0 and high <= FARTHEST_SANE_M):  # neither is so for NaN
        raise UserError(
            f"Simulated depth reaches from {low:g} to {high:g}; expected finite metres, 0 for nothing in "
            "range (divide millimetres by 1000)."
        )


def _check_numbers(name: str, numbers: np.ndarray, count: int, alone: bool) -> None:
    """UserError unless there is a whole number for each of `count` frames, or, `alone`, one for all."""
    fits = numbers.shape == (count,) or (alone and numbers.ndim == 0)
    if not (fits and np.issubdtype(numbers.dtype, np.integer)):
        raise UserError(
            f"{name} is {numbers.dtype} {numbers.shape} of {count} frames; expected a whole number for each"
            f"{' or one for all' if alone else ''}."
        )
