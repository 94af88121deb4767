"""Depth noise that simulators offer beside a generator's file, on frames of a real camera it has not seen.

    python -m benchmarks.simulator_noise recordings/room --generator generator.onnx --score-frames 40

Geometry is made of the recording's odd frames, recorded depth is the even ones
(evaluation/depth_score/data.py), as in `ddgrasp ddg score --real`: the generator has to be fitted on the
frames before. `FID` is over that of clean depth, with a 95 % interval from resampling blocks of frames;
features depthfeat-v1. `CPU ms` is processor time per frame, all threads together, which other work on the
machine changes less than frames/s.
"""

import argparse
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, Float32

from benchmarks.command import one_line
from ddgrasp import contract
from ddgrasp.config import DextrahConfig, KinectConfig, StereoConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.depth import inverse_depth, to_metres, to_millimetres
from ddgrasp.errors import UserError
from deploy.depth_noise import DepthGenerator
from evaluation.depth_score import features as score_features
from evaluation.depth_score import real as real_score
from evaluation.depth_score.data import BLOCK_FRAMES, REAL, SIM, Episode, load_real, real_episodes
from evaluation.depth_score.distances import fid
from evaluation.depth_score.resampling import Sample, bootstrap_pairs, draws, interval
from sensors.models.procedural import dextrah, kinect
from sensors.models.sense import Sense
from sensors.models.stereo_sensor import stereo
from sensors.statistics.stats import hole_sizes_px

Noise = Callable[[Float32[np.ndarray, "T H W"]], Float[np.ndarray, "T H W"]]
"""Clean depth in metres to noisy depth."""
GAUSSIAN_M = 0.005
"""A usual strength of plain Gaussian noise on depth."""
DRAWS = 200
NORMAL_MEDIAN = 0.6745
"""Median of |x| for a standard normal x."""


@dataclass(frozen=True)
class Row:
    """One noise: its maps, and what it took."""

    name: str
    depth_m: Float[np.ndarray, "N H W"]
    cpu_ms: float = float("nan")
    frames_s: float = float("nan")


def gaussian(deviation_m: float) -> Noise:
    """Independent Gaussian noise on every valid pixel."""
    rng = np.random.default_rng(0)

    def add(depth_m: np.ndarray) -> np.ndarray:
        noisy = depth_m + rng.normal(0, deviation_m, depth_m.shape).astype(np.float32)
        return np.where(depth_m > 0, np.maximum(noisy, 0), 0)

    return add


def gaussian_and_dropout(recorded: Sequence[Episode]) -> Noise:
    """Independent noise with the recording's own strengths: share of holes, and spread of inverse depth."""
    sensed, clean = (to_metres(np.concatenate([getattr(e, n) for e in recorded])) for n in _PAIR)
    valid = sensed > 0
    spread = np.median(np.abs(inverse_depth(sensed) - inverse_depth(clean))[valid]) / NORMAL_MEDIAN
    holes, rng = 1 - valid.mean(), np.random.default_rng(0)

    def add(depth_m: np.ndarray) -> np.ndarray:
        inverse = np.maximum(inverse_depth(depth_m) + rng.normal(0, spread, depth_m.shape), 0.02)
        dropped = rng.random(depth_m.shape) < holes
        return np.where((depth_m > 0) & ~dropped, 1 / inverse, 0).astype(np.float32)

    return add


_PAIR = ("sensed_mm", "clean_mm")


def camera_model(sense: Sense) -> Noise:
    """One of sensors/models/, compiled."""
    compiled, keys = jax.jit(sense), map(jax.random.key, itertools.count())
    return lambda depth_m: np.asarray(compiled(next(keys), depth_m, None))


def noises(recorded: Sequence[Episode], files: Sequence[Path], threads: int) -> dict[str, Noise]:
    """Every noise by name, of the optics of the recording."""
    profile = _profile(recorded[0])
    made = {
        f"Gaussian, {GAUSSIAN_M * 1000:g} mm": gaussian(GAUSSIAN_M),
        "Gaussian and dropout, the recording's strengths": gaussian_and_dropout(recorded),
        "Kinect, formulas (Handa et al.)": camera_model(kinect(KinectConfig(), profile)),
        "DextrAH-G, formulas": camera_model(dextrah(DextrahConfig(), profile)),
        "active stereo, simulated (the rig's matcher)": camera_model(stereo(StereoConfig(), profile)),
    }
    for file in files:
        made[f"generator, {file}"] = DepthGenerator(file, threads=threads)
    return made


def _profile(episode: Episode) -> CameraProfile:
    _, height, width = episode.clean_mm.shape
    return replace(
        contract.D455,
        width_px=width,
        height_px=height,
        fx_px=episode.focal_px,
        fy_px=episode.focal_px,
        cx_px=width / 2,
        cy_px=height / 2,
        baseline_m=episode.baseline_m,
    )


def timed(name: str, noise: Noise, episodes: Sequence[Episode]) -> Row:
    """The noise on every episode, a batch each; time without the first call, which compiles."""
    clean = [to_metres(episode.clean_mm) for episode in episodes]
    noise(clean[0])
    cpu, wall = time.process_time(), time.perf_counter()
    made = np.concatenate([noise(depth_m) for depth_m in clean])
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return Row(name, made, 1000 * cpu / len(made), len(made) / wall)


def measure(episodes: Sequence[Episode], files: Sequence[Path], threads: int) -> None:
    """Prints a line per noise. UserError for fewer blocks of frames than can be resampled."""
    real, sim = ([e for e in episodes if e.side == side] for side in (REAL, SIM))
    if len(real) < real_score.FEWEST_BLOCKS:
        raise UserError(
            f"the frames scored hold {len(real)} run(s) of {2 * BLOCK_FRAMES} of one recording; expected "
            f"{real_score.FEWEST_BLOCKS} or more: give a larger --score-frames."
        )
    sensed, clean = (to_metres(np.concatenate([getattr(e, n) for e in sim])) for n in _PAIR)
    rows = [Row("none (clean depth)", clean)]
    rows += [timed(name, noise, sim) for name, noise in noises(real, files, threads).items()]
    rows += [Row("the camera's own holes, clean surfaces", np.where(sensed > 0, clean, 0))]
    rows += [Row("the camera itself, the other frames", sensed)]
    extract = score_features.load("depthfeat-v1")

    def sample(depth_m: np.ndarray, side: Sequence[Episode]) -> Sample:
        groups = np.repeat([e.group for e in side], [len(e.clean_mm) for e in side])
        return Sample(extract(to_metres(to_millimetres(depth_m.astype(np.float32)))), groups)

    recorded_m = to_metres(np.concatenate([e.sensed_mm for e in real]))
    recorded = sample(recorded_m, real)
    drawn = [(d, d) for d in draws(recorded.groups, DRAWS, np.random.default_rng(0))]
    unit, units = _distance(recorded, sample(clean, sim), drawn)
    print(f"recorded: {np.mean(recorded_m == 0):.1%} holes, {_regions(recorded_m):.0f} regions a frame")
    for row in rows:
        value, values = _distance(recorded, sample(row.depth_m, sim), drawn)
        spread = interval(value / unit, [v / u for v, u in zip(values, units, strict=True)])
        print(
            f"{row.name:50} FID {spread['value']:6.3f} ({spread['low']:.3f} to {spread['high']:.3f})  "
            f"holes {np.mean(row.depth_m == 0):6.1%}  regions {_regions(row.depth_m):5.0f}  "
            f"CPU ms {row.cpu_ms:7.1f}  frames/s {row.frames_s:7.1f}",
            flush=True,
        )


def _distance(
    real: Sample, sim: Sample, drawn: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[float, list[float]]:
    resampled = bootstrap_pairs(real, sim, drawn, lambda r, s: fid(real.features[r], sim.features[s]))
    return fid(real.features, sim.features), resampled


def _regions(depth_m: np.ndarray) -> float:
    return float(np.mean([len(hole_sizes_px(frame)) for frame in depth_m]))


@one_line
def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path, help="a recording, or a folder of them")
    parser.add_argument("--generator", type=Path, action="append", default=[], help="an exported file")
    parser.add_argument("--score-frames", type=int, default=40, help="the last frames, which are used")
    parser.add_argument("--width-px", type=int, default=320, help="pictures are brought to this width")
    parser.add_argument("--threads", type=int, default=0, help="of onnxruntime; 0 takes all cores")
    options = parser.parse_args()
    frames = load_real(options.data, options.width_px, options.score_frames)
    measure(real_episodes(frames, with_rgb=False), options.generator, options.threads)


if __name__ == "__main__":
    main()
