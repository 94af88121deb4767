"""A fitted generator -> one ONNX file that is the whole of it, checked against JAX before it is written."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float32, Key

from ddg_jax.representation import channels, correlations
from ddg_jax.sample import Generator, frame_noise, generate
from ddgrasp import artifacts, generator_metadata
from ddgrasp.artifacts import Artifact
from ddgrasp.config import PROGRESSIVE, DDGConfig
from ddgrasp.depth import crop_nearest, inverse_depth, window
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes
from ddgrasp.generator_metadata import GeneratorMetadata
from ddgrasp.onnx_runtime import ort
from ddgrasp.versions import project_version
from export.generator_graph import build_model
from export.parity import open_session
from export.sampler_tables import MOST_STEPS, is_stochastic
from learning import diffusion
from mjx_envs.precision import exact
from sensors.recordings.recording import Recording, find_recordings, recording_folders

PARITY_SCENES = 4
MOST_SHARE = 2e-3
"""Share of pixels that may be grafted, or holes, in one and not in the other."""
MOST_DIFFERENCE_PER_M = 1e-3
"""Largest difference of inverse depth, 1/m, at all others."""
RANGE_QUANTILES = (0.001, 0.999)
"""Where the nearest and the farthest depth that the file names lie among valid recorded depth."""


@dataclass(frozen=True)
class Parity:
    """ONNX against JAX on scenes with the same noise."""

    share: float
    """Pixels that are grafted, or holes, in one alone: next to a threshold."""
    inverse_depth_per_m: float
    """Largest difference of the reported inverse depth elsewhere, 1/m."""
    median_m: float
    """Median difference of the generator's own map, metres."""


def export_generator(
    directory: Path,
    out: Path,
    *,
    data: Path | None = None,
    licence: str = "",
    sampler: str = "",
    steps: int = 0,
) -> Parity:
    """Writes the generator in the stage directory `directory` to the file `out`.

    Args:
      directory: of a finished `ddg` stage.
      out: the file.
      data: recordings that it was fitted on, whose camera, licence and range the file shall name; without,
        the run's own camera if it recorded itself.
      licence: of the generator; the recordings' own by default.
      sampler: as in `Generator.load`.
      steps: as in `Generator.load`.

    Raises:
      UserError: no generator there, a prior that needs colour, more than MOST_STEPS evaluations, or ONNX and
        JAX disagree (the file is then not written).
    """
    generator = Generator.load(directory, sampler, steps)
    if generator.config.sampling.steps > MOST_STEPS:
        raise UserError(
            f"The generator takes {generator.config.sampling.steps} evaluations; a file holds tables for up "
            f"to {MOST_STEPS}: give --steps."
        )
    metadata = describe(artifacts.read_artifact(directory), generator.config, data, licence)
    model = build_model(generator.params, generator.config, metadata).SerializeToString()
    measured = parity(generator, open_session(model))
    if not (measured.share <= MOST_SHARE and measured.inverse_depth_per_m <= MOST_DIFFERENCE_PER_M):
        raise UserError(
            f"The ONNX generator differs from JAX: {measured.share:.2%} of the pixels grafted otherwise, "
            f"inverse depth by {measured.inverse_depth_per_m:.1e} 1/m; nothing was written: fit for longer "
            "(or, if the sampler is new, mend export/sampler_tables.py)."
        )
    atomic_write_bytes(out, model)
    return measured


# --- what the file says about itself ---------------------------------------------------------------


def describe(
    artifact: Artifact, config: DDGConfig, data: Path | None = None, licence: str = ""
) -> GeneratorMetadata:
    """Metadata of this stage's generator, sampled as `config` says. Other arguments: `export_generator`."""
    size = config.depth.height_px, config.depth.width_px
    camera, from_licence, source = _recorded(data, size) if data else _rig(artifact)
    fixed = config.sampling.sampler == PROGRESSIVE
    return GeneratorMetadata(
        format=generator_metadata.FORMAT,
        project_version=project_version(),
        height_px=config.depth.height_px,
        width_px=config.depth.width_px,
        channels=channels(config),
        sampler=config.sampling.sampler,
        steps=config.sampling.steps,
        most_steps=config.sampling.steps if fixed else min(MOST_STEPS, config.diffusion.steps),
        stochastic=is_stochastic(config),
        frame_correlation=config.sampling.frame_correlation,
        deviation_correlation=config.sampling.deviation_correlation,
        unit="planar metres, 0 = nothing in range or no reading",
        camera=camera,
        knows_position=config.unet.position,
        licence=licence or from_licence,
        source=source,
        manifest_hash=artifact.hash,
    )


def _rig(artifact: Artifact) -> tuple[dict[str, Any], str, str]:
    """The camera that a run recorded itself; nothing of a generator that was fitted on other recordings, or
    taken from elsewhere (`ddg.init_from`)."""
    if "record" not in artifact.manifest.parents or artifact.manifest.origin == "loaded":
        return {}, "", ""
    config = artifacts.config_from_json(artifact.manifest.config)
    if config.ddg.init_from:  # distilled here, and fitted elsewhere
        return {}, "", ""
    profile, stereo = config.world.profile, config.record.stereo
    camera = {
        "name": "the rig's simulated stereo camera, with a D455's optics",
        "width_px": profile.width_px,
        "height_px": profile.height_px,
        "fx_px": profile.fx_px,
        "near_m": stereo.min_range_m,
        "far_m": stereo.max_range_m,
    }
    return camera, "Apache-2.0", "recorded in the project's own simulation"


def _recorded(data: Path, size: tuple[int, int]) -> tuple[dict[str, Any], str, str]:
    """What the recordings' meta.json say of the centred window that a generator of `size` (H, W) is fitted
    to, and the range of its depth; no focal length where the recordings are of several.
    """
    recordings = _readable(data)
    metas = [recording.meta for recording in recordings]
    seen = (crop_nearest(r.depth_m(i), size) for r in recordings for i in range(len(r)))
    depth = np.concatenate([frame[::4, ::4].ravel() for frame in seen])
    near, far = np.quantile(depth[depth > 0], RANGE_QUANTILES)
    optics = [(*window((r.height_px, r.width_px), size), r.fx_px) for r in recordings]
    height, width, fx_px = optics[0]
    camera = {
        "name": _joined(metas, "sensor"),
        "width_px": width,
        "height_px": height,
        "fx_px": fx_px if len({*optics}) == 1 else None,
        "near_m": round(float(near), 3),
        "far_m": round(float(far), 3),
    }
    return camera, _joined(metas, "licence"), _joined(metas, "source")


def _readable(data: Path) -> list[Recording]:
    """Recordings at or directly below `data` but for refused ones, which a fit leaves out as well; UserError
    if none is left.
    """
    recordings: list[Recording] = []
    refused: list[UserError] = []
    for folder in (recording_folders(data) if data.is_dir() else []) or [data]:
        try:
            recordings += find_recordings(folder)
        except UserError as error:
            refused.append(error)
    if not recordings:
        raise refused[0]
    return recordings


def _joined(metas: list[dict[str, Any]], key: str) -> str:
    return "; ".join(dict.fromkeys(str(meta[key]) for meta in metas if meta.get(key)))


# --- parity ----------------------------------------------------------------------------------------


@exact
def parity(generator: Generator, session: ort.InferenceSession) -> Parity:
    """The file against `ddg_jax.sample.generate`, every scene an episode of its own, the same noise in both.

    Args:
      generator: what the file was made of.
      session: the file.
    """
    config, steps = generator.config, generator.config.sampling.steps
    size = (config.depth.height_px, config.depth.width_px)
    depth_m = scenes(np.random.default_rng(0), PARITY_SCENES, size)
    key, episode = jax.random.key(0), np.arange(PARITY_SCENES)
    wanted = generate(key, generator, depth_m, episode=episode, steps=steps)
    noise = jax_noise(config, key, PARITY_SCENES, steps)
    reported, predicted, mask = run(session, depth_m, noise, steps)
    alike = (mask == wanted.mask) & ((reported > 0) == (wanted.depth_m > 0))
    both = (predicted > 0) & (wanted.predicted_m > 0)
    inverse = np.abs(inverse_depth(reported) - inverse_depth(wanted.depth_m))
    return Parity(
        share=float(np.mean(~alike)),
        inverse_depth_per_m=float(inverse[alike].max(initial=0)),
        median_m=float(np.median(np.abs(predicted - wanted.predicted_m)[both])),
    )


def run(
    session: ort.InferenceSession,
    depth_m: Float32[np.ndarray, "B H W"],
    noise: Float32[np.ndarray, "B P h w"],
    steps: int,
) -> list[np.ndarray]:
    """reported and predicted depth and the mask, (B, H, W) each, by the file itself."""
    feed: Mapping[str, np.ndarray] = {
        generator_metadata.INPUT_DEPTH: depth_m,
        generator_metadata.INPUT_NOISE: noise,
        generator_metadata.INPUT_STEPS: np.array(steps, np.int64),
    }
    taken = {one.name for one in session.get_inputs()}
    names = [
        generator_metadata.OUTPUT_DEPTH,
        generator_metadata.OUTPUT_PREDICTED,
        generator_metadata.OUTPUT_MASK,
    ]
    return [np.asarray(made) for made in session.run(names, {k: v for k, v in feed.items() if k in taken})]


def jax_noise(
    config: DDGConfig, key: Key[jax.Array, ""], frames: int, steps: int
) -> Float32[np.ndarray, "frames P h w"]:
    """The random numbers that `ddg_jax.sample.sample` draws for frames 0, 1, ... of episodes 0, 1, ..., as
    the file takes them.
    """
    size, numbers = (config.depth.height_px, config.depth.width_px), np.arange(frames)
    draw = partial(frame_noise, episode=numbers, frame=numbers)
    prior_key, start_key, step_key = jax.random.split(key, 3)
    prior = draw(prior_key, shape=size, correlation=config.sampling.frame_correlation)

    def block(block_key: jax.Array) -> np.ndarray:
        made = draw(block_key, shape=(*size, channels(config)), correlation=correlations(config))
        return np.moveaxis(np.asarray(made), -1, 1)

    visited = diffusion.timesteps(config.diffusion.steps, steps, config.sampling.spacing)
    fresh = [block(jax.random.fold_in(step_key, int(k))) for k in visited[:-1] if is_stochastic(config)]
    return np.concatenate([np.asarray(prior)[:, None], block(start_key), *fresh], axis=1)


def scenes(rng: np.random.Generator, count: int, size: tuple[int, int]) -> Float32[np.ndarray, "B H W"]:
    """Tilted floors with boxes on them, and a patch without depth, (B, H, W) metres."""
    rows, columns = np.mgrid[: size[0], : size[1]].astype(np.float32)
    made = np.empty((count, *size), np.float32)
    for picture in made:
        near, far = rng.uniform(0.5, 1.0), rng.uniform(1.2, 2.5)
        picture[:] = 1 / (1 / far + (1 / near - 1 / far) * rows / size[0])
        for _ in range(3):
            centre, half = rng.uniform(0, size), rng.uniform(0.05, 0.2, 2) * size
            inside = (abs(rows - centre[0]) < half[0]) & (abs(columns - centre[1]) < half[1])
            picture[inside] *= np.float32(rng.uniform(0.6, 0.9))
        picture[: size[0] // 8, : size[1] // 8] = 0
    return made
