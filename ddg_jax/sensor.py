"""Camera models by name: those of sensors/models/ and the learned one, behind one call (its sense.py)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ddg_jax.graft import graft
from ddg_jax.representation import decode
from ddg_jax.sample import Generator, check_aspect, sample
from ddg_jax.window import mixed
from ddgrasp.config import Sensor, SensorConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.depth import resize_nearest
from ddgrasp.errors import UserError
from sensors.models import procedural
from sensors.models.sense import Sense, batched, ideal
from sensors.models.stereo_sensor import stereo

SENSORS: dict[Sensor, Callable[[SensorConfig, CameraProfile], Sense]] = {
    "ideal": lambda config, profile: ideal(),
    "dextrah": lambda config, profile: procedural.dextrah(config.dextrah, profile),
    "kinect": lambda config, profile: procedural.kinect(config.kinect, profile),
    "stereo": lambda config, profile: stereo(config.stereo, profile),
    "learned": lambda config, profile: learned(_fitted(config.learned_from)),
}
"""Every camera model that a configuration can name."""


def make_sensor(config: SensorConfig, profile: CameraProfile) -> Sense:
    """The camera model that `config` names, for pictures of `profile`.

    Raises:
        UserError: no fitted generator where `learned` looks for one.
    """
    return SENSORS[config.name](config, profile)


def learned(generator: Generator) -> Sense:
    """Sampling and grafting by a fitted generator; every picture is an episode of one frame.

    Sampling is traced with the rest; the prior, a function of NumPy arrays, runs on the host. For whole
    data sets `ddg_jax.sample.generate` is quicker: it batches. It also refuses depth that is not in finite
    metres, which a traced function cannot.

    Raises:
        UserError: the generator's prior needs a network on colour pictures, which cannot run in a callback.
    """
    config = generator.config
    if generator.prior.needs_sim_rgb:
        raise UserError(
            f"A learned sensor with the prior {config.prior.source!r} on rgb cannot be jitted: fit with "
            "--ddg.prior.in-sim depth, or use ddg_jax.sample.generate."
        )
    size = (config.depth.height_px, config.depth.width_px)

    def prior_on_host(depth_m) -> np.ndarray:
        depth = np.asarray(depth_m)
        frames = [generator.prior.from_sim(frame[None], None) for frame in depth.reshape(-1, *size)]
        return np.concatenate(frames).astype(np.float32).reshape(depth.shape)

    def window_on_host(depth_m) -> np.ndarray:
        depth = np.asarray(depth_m)
        return mixed(depth.reshape(-1, *depth.shape[-2:]), config.graft).reshape(depth.shape)

    def sense_frame(key: Array, depth_m: Array, rgb: Array | None) -> Array:
        check_aspect(depth_m.shape, config)
        if config.graft.window_px:
            seen = jax.ShapeDtypeStruct(depth_m.shape, jnp.float32)
            depth_m = jax.pure_callback(window_on_host, seen, depth_m, vmap_method="broadcast_all")
        clean = resize_nearest(depth_m, size)
        shape = jax.ShapeDtypeStruct(size, jnp.float32)
        c = jax.pure_callback(prior_on_host, shape, clean, vmap_method="broadcast_all")[None]
        first = jnp.zeros(1, jnp.int32)
        x = sample(config, key, generator.params, c, first[0], first, steps=config.sampling.steps)[0]
        sized = jnp.moveaxis(resize_nearest(jnp.moveaxis(x, -1, 0), depth_m.shape), 0, -1)
        predicted = decode(config, sized, depth_m)
        return graft(depth_m, predicted.depth_m, predicted.mask)

    return batched(sense_frame)


def _fitted(directory: str) -> Generator:
    if not directory:
        raise UserError(
            "sensor.learned_from is empty; expected the stage directory of a fitted generator, for example "
            "runs/demo/ddg (`ddgrasp ddg fit` makes one)."
        )
    return Generator.load(directory)
