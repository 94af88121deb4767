"""How near are surfaces made of recorded depth to the truth? Measured where the truth is known.

    python -m benchmarks.surfaces runs/laptop/score/data --trajectories 8

The folder holds what `ddgrasp ddg score` recorded of the rig: sensed depth beside the simulator's own. Each
line makes geometry of the sensed depth. FIDs are relative to Sim GT's (recorded against true geometry). `to
truth` is the distance of made to true geometry, 0 at best; `Sim GT` and `Inpaint` are those columns with made
geometry in place of the true one, which the first line has. `error`: mean |1/d - 1/d_true| in 1/m.
"""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.command import one_line
from ddg_jax.geometry import surfaces
from ddgrasp.config import SURFACES
from ddgrasp.depth import inverse_depth, to_metres, to_millimetres
from ddgrasp.errors import UserError
from evaluation.depth_score import features as score_features
from evaluation.depth_score.data import REAL, SIM, Episode, load_episode
from evaluation.depth_score.distances import fid
from sensors.inpainting import inpainted

Make = Callable[[np.ndarray], np.ndarray]
"""Sensed depth (T, H, W) metres -> geometry, the same."""


def telea(depth_m: np.ndarray) -> np.ndarray:
    """Inpainted."""
    return to_metres(inpainted(to_millimetres(depth_m)))


WAYS: dict[str, Make] = {
    "inpainted": telea,
    **{kind: partial(surfaces, kind=kind) for kind in SURFACES},
}


def measure(real: Sequence[Episode], sim: Sequence[Episode]) -> None:
    """Prints one line per way."""
    features = score_features.load("depthfeat-v1")

    def of(maps_m: Sequence[np.ndarray]) -> np.ndarray:
        return np.concatenate([features(to_metres(to_millimetres(depth_m))) for depth_m in maps_m])

    sensed, truth_m = [to_metres(e.sensed_mm) for e in sim], [to_metres(e.clean_mm) for e in sim]
    recorded, truth = of([to_metres(e.sensed_mm) for e in real]), of(truth_m)
    whole = of([telea(to_metres(e.sensed_mm)) for e in real])
    unit = fid(recorded, truth)
    print(f"{'':24}{'to truth':>10}{'Sim GT':>10}{'Inpaint':>10}{'error':>10}")
    print(f"{'truth':24}{0:10.4f}{1:10.3f}{fid(whole, truth) / unit:10.4f}{0:10.5f}")
    for name, make in WAYS.items():
        made_m = [make(depth_m) for depth_m in sensed]
        made = of(made_m)
        error = np.mean(
            [np.abs(inverse_depth(m) - inverse_depth(t)).mean() for m, t in zip(made_m, truth_m, strict=True)]
        )
        print(
            f"{name:24}{fid(made, truth) / unit:10.4f}{fid(recorded, made) / unit:10.3f}"
            f"{fid(whole, made) / unit:10.4f}{error:10.5f}",
            flush=True,
        )


@one_line
def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path, help="RUN/score/data")
    parser.add_argument("--trajectories", type=int, default=8, help="per side")
    options = parser.parse_args()
    real, sim = (
        [load_episode(file) for file in sorted(options.data.glob(f"{side}_*.npz"))[: options.trajectories]]
        for side in (REAL, SIM)
    )
    if not real or not sim:
        raise UserError(
            f"{options.data} has no trajectories: run `ddgrasp ddg score` and give its score/data."
        )
    measure(real, sim)


if __name__ == "__main__":
    main()
