"""Where do a camera and a generator see objects? Measured on the rig, where the truth is known.

    python -m benchmarks.objects_seen [--model RUN/ddg] [--windows 1 1.25 1.5] [--boxes 3 5 7] [--scenes 6]

The twelve objects on the table, the arm at its start, the same scenes for every line. Object pixels are those
more than 12 mm above the table within 10 cm of the object. A line has their number over clean depth's, how
many of clean depth's are holes, by how much inverse depth is off in the whole picture (median and 99th
percentile, 1/m), and how far the mean of the object's points is from clean depth's, in millimetres, robot's
base frame (x from the base to the camera, z up): mean, and root mean square over scenes; scenes in which a
line has no object pixels are not in these, and `none` counts them. Lines `window` and `box` are clean depth
through `ddg_jax.window.mixed`.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from app.commands.checks import stage_folder
from benchmarks.command import one_line
from ddg_jax.sample import Generator, generate
from ddg_jax.window import mixed
from ddgrasp import contract
from ddgrasp.config import GraftConfig
from ddgrasp.depth import to_metres
from ddgrasp.layout import QPOS
from ddgrasp.presets import get_preset
from mjx_envs.camera import nominal_camera
from rig.camera import camera_pose, make_camera
from rig.world import make_world

ABOVE_TABLE_M, NEAR_M = 0.012, 0.10
_STREAM = 0x5E


@one_line
def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--model", type=Path, help="a run with a fitted generator, or its folder ddg")
    parser.add_argument("--windows", type=float, nargs="*", default=[1.0, 1.25, 1.5], help="Gaussians, px")
    parser.add_argument("--boxes", type=int, nargs="*", default=[3, 5, 7], help="odd widths, px")
    parser.add_argument("--scenes", type=int, default=6, help="of each object")
    args = parser.parse_args()
    generator = Generator.load(stage_folder("--model", args.model, "ddg")) if args.model else None
    windows = {f"window {w:g} px": GraftConfig(window_px=w) for w in args.windows}
    windows |= {f"box {w} px": GraftConfig(window_px=w, window_shape="box") for w in args.boxes}
    rows: dict[str, list[np.ndarray]] = {}
    for number, clean_m, sensed_m, T_world_cam, object_m in scenes(args.scenes):
        seen = {"camera": sensed_m}
        seen |= {name: mixed(clean_m[None], window)[0] for name, window in windows.items()}
        if generator is not None:
            made = generate(jax.random.key(0), generator, clean_m[None], episode=number)
            seen["generator"] = made.depth_m[0]
        shown, truth = object_points(clean_m, T_world_cam, object_m)
        for name, depth_m in seen.items():
            _, points = object_points(depth_m, T_world_cam, object_m)
            moved_mm = 1e3 * (points.mean(0) - truth.mean(0)) if len(points) else np.full(3, np.nan)
            values = [len(points) / len(truth), np.mean(depth_m[shown] == 0), *off_per_m(depth_m, clean_m)]
            rows.setdefault(name, []).append(np.array([*values, *moved_mm]))
    print(
        f"{'':16}{'pixels':>8}{'none':>6}{'holes':>8}   off, 1/m: p50, p99   x, y, z, mm: mean        "
        "root mean square"
    )
    for name, values in rows.items():
        print(_line(name, np.stack(values)))


def scenes(count: int) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """(number, clean (H, W) m, the camera's (H, W) m, T_world_cam (4, 4), object's position (3,) m)."""
    config = get_preset("laptop")
    names = contract.SEEN_OBJECTS + contract.UNSEEN_OBJECTS
    config = replace(config, world=replace(config.world, objects=names))
    world = make_world(config.world)
    camera = make_camera(config, world)
    for number in range(count * len(names)):
        name = names[number % len(names)]
        rng = np.random.default_rng([_STREAM, number])
        world.reset(int(rng.integers(2**31)), name)
        pose = camera_pose(config, rng)
        clean_mm = camera.clean_mm(world.data, pose)
        sensed_mm = camera.depth_mm(world.data, pose, rng, name)
        yield number, to_metres(clean_mm), to_metres(sensed_mm), pose, world.data.qpos[QPOS.object_pos].copy()


def off_per_m(depth_m: np.ndarray, clean_m: np.ndarray) -> np.ndarray:
    """(2,) median and 99th percentile of |1/d - 1/d_clean|, 1/m, where (H, W) depth has both."""
    valid = (depth_m > 0) & (clean_m > 0)
    return np.percentile(np.abs(1 / depth_m[valid] - 1 / clean_m[valid]), [50, 99])


def object_points(
    depth_m: np.ndarray, T_world_cam: np.ndarray, object_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """((H, W) bool pixels of the object in (H, W) depth, (N, 3) metres: their points, world frame)."""
    lens = nominal_camera(contract.D455.scaled(depth_m.shape[1] / contract.D455.width_px))
    v, u = np.mgrid[: depth_m.shape[0], : depth_m.shape[1]] + 0.5
    rays = np.stack([(u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px, np.ones_like(u)], axis=-1)
    points = (depth_m[..., None] * rays) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    near = np.linalg.norm(points[..., :2] - object_m[:2], axis=-1) < NEAR_M
    pixels = (depth_m > 0) & near & (points[..., 2] > ABOVE_TABLE_M)
    return pixels, points[pixels]


def _line(name: str, values: np.ndarray) -> str:
    (pixels, holes, p50, p99), moved = np.nanmean(values[:, :4], 0), values[:, 4:]
    texts: Sequence[str] = [
        "".join(f"{v:7.1f}" for v in row) for row in (np.nanmean(moved, 0), np.sqrt(np.nanmean(moved**2, 0)))
    ]
    none = int(np.isnan(moved).any(1).sum())
    return f"{name:16}{pixels:8.2f}{none:6}{holes:8.1%}{p50:14.5f}{p99:9.5f}{texts[0]}    {texts[1]}"


if __name__ == "__main__":
    main()
