"""A stage `demos` and a folder of deployments, small and random, for the tests of datasets."""

import json
from pathlib import Path

import numpy as np

from ddgrasp import artifacts
from ddgrasp.presets import get_preset
from demos.store import EpisodeStore
from sensors.recordings.writer import RecordingWriter

SIZE = (48, 64)
LENGTHS = (7, 4, 5)
OBJECTS = (1, 0, 1)
"""Positions in the debug preset's objects."""


def write_demos(run: Path, *, with_rgb: bool = True, largest_mm: int = 4095) -> list[dict[str, np.ndarray]]:
    """Makes the finished stage in `run`; returns the arrays of each episode."""
    rng = np.random.default_rng(0)
    store = EpisodeStore(run / "demos" / "episodes.zarr", create=True)
    written = []
    for length, object_index in zip(LENGTHS, OBJECTS, strict=True):
        steps = {
            "depth_mm": rng.integers(0, largest_mm + 1, (length, *SIZE)).astype(np.uint16),
            "state": rng.normal(size=(length, 8)).astype(np.float32),
            "action": rng.uniform(-1, 1, (length, 8)).astype(np.float32),
            "observation": rng.normal(size=(length, 40)).astype(np.float32),
            "held": rng.random(length) > 0.5,
        }
        if with_rgb:
            steps["rgb"] = rng.integers(0, 256, (length, *SIZE, 3)).astype(np.uint8)
        pose = rng.normal(size=(4, 4)).astype(np.float32)
        store.append(steps, {"object_index": np.int32(object_index), "T_world_cam": pose})
        written.append({**steps, "T_world_cam": pose})
    artifacts.finish(run / "demos", "demos", get_preset("debug"), seconds=1.0, metrics={})
    return written


def write_noisy(run: Path) -> list[np.ndarray]:
    """Makes the finished stage `noisy` of the run's demonstrations; returns the depth of each episode."""
    rng = np.random.default_rng(1)
    store = EpisodeStore(run / "noisy" / "depth.zarr", create=True)
    written = [rng.integers(0, 4096, (length, *SIZE)).astype(np.uint16) for length in LENGTHS]
    for depth_mm in written:
        store.append({"depth_mm": depth_mm}, {"invalid_fraction": np.float64(0.03)})
    artifacts.finish(
        run / "noisy", "noisy", get_preset("debug"), seconds=1.0, metrics={"invalid_fraction": 0.03},
        parents=[artifacts.read_artifact(run / "demos")],
    )  # fmt: skip
    return written


def write_deployment(
    folder: Path,
    *,
    success: bool | None = True,
    frames: int = 4,
    held: tuple[int, ...] = (),
    by: tuple[str, ...] = ("policy",) * 4,
    colour: tuple[int, int] = SIZE,
    **about: str | int,
) -> tuple[np.ndarray, np.ndarray]:
    """Makes a deployment of four steps as `deploy.record` leaves it; returns (states, depth_mm).

    Without `by` as before 2026-11-28.
    """
    rng = np.random.default_rng(len(folder.name))
    states = rng.normal(size=(4, 8))
    depth_mm = rng.integers(500, 900, (frames, *SIZE)).astype(np.uint16)
    with RecordingWriter(folder, {"sensor": "stereo, D455 profile"}) as writer:
        for picture in depth_mm:
            writer.add(np.full((*colour, 3), 90, np.uint8), picture)
    rows = [
        {
            "step": step,
            "q_rad": state[:7].tolist(),
            "width_m": state[7],
            "action": None if step in held else [*np.full(7, 0.1 * step).tolist(), 1.0 if step else -1.0],
            **({"by": None if step in held else by[step]} if by else {}),
        }
        for step, state in enumerate(states)
    ]
    (folder / "steps.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    report = {"robot": "sim", "camera": "stereo", "policy": "p.onnx", "success": success, "fault": ""}
    report |= {"holds": len(held), "missed_deadlines": 0, "events": [], "latency_ms": {"p50": 9, "p99": 12}}
    (folder / "report.json").write_text(json.dumps({**report, "steps": 4, "frames": frames, **about}))
    return states, depth_mm
