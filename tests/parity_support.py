"""Recorded values of the original networks: where they lie, and the weights and pictures they were made with.

A fixture holds `in/*`, `act/*`, `out/*` and `meta_json`. Weights are not in it: they are drawn anew from the
seed it names, array by array, and `check/weights` tells whether the same ones came out.
"""

import json
import os
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

DIRECTORY = Path(
    os.environ.get("PARITY_DIR") or Path(__file__).resolve().parents[1].parent / "shared/parity/public"
)
if os.environ.get("PARITY_DIR") and not any(DIRECTORY.glob("*.npz")):
    raise FileNotFoundError(f"PARITY_DIR is {DIRECTORY}, which has no *.npz: nothing would be compared")
ABSENT = f"no parity fixtures in {DIRECTORY} (set PARITY_DIR)"
FLOOR = 2e-5
"""Errors up to this are always accepted."""
ROUNDING_FACTOR = 10
"""So are errors up to this multiple of the reference's own rounding."""
SIZES = {"vits": "small", "vitb": "base", "vitl": "large"}
FAMILIES = {"dav2": "depth_anything_v2", "vda": "video_depth_anything"}


@dataclass(frozen=True)
class Fixture:
    """One recorded case."""

    name: str
    arrays: dict[str, np.ndarray]
    meta: dict[str, Any]

    @property
    def network(self) -> str:
        """Our name of the network."""
        family, _, size = self.meta["net"].partition("_")
        return (
            f"{FAMILIES[family]}_{SIZES[size]}"
            if family in FAMILIES
            else {"inception": "fid_inception"}.get(family, family)
        )

    def tolerance(self, key: str) -> float:
        """Largest accepted absolute error of the array `key`."""
        return max(ROUNDING_FACTOR * self.meta.get("f32_vs_f64_max_abs", {}).get(key, 0.0), FLOOR)

    def image(self) -> np.ndarray:
        """The input picture, uint8, channels before rows and columns."""
        if "in/image_u8" in self.arrays:
            return self.arrays["in/image_u8"]
        text = f"{self.meta.get('image', '')} {self.meta.get('notes', '')}"
        found = re.search(r'image_u8\(weight_seed,\s*"([^"]+)",\s*\(([\d, ]+)\)\)', text)
        assert found, f"{self.name} has no picture and does not say how to draw it"
        shape = tuple(int(side) for side in found[2].split(",") if side.strip())
        image = draw_image(self.meta["weight_seed"], found[1], shape)
        assert zlib.crc32(image.tobytes()) == self.meta["image_crc32"]
        return image


def names(pattern: str) -> list[str]:
    """Fixtures whose file name matches, [] if there are none."""
    return sorted(path.stem for path in DIRECTORY.glob(f"{pattern}.npz"))


def load(name: str) -> Fixture:
    """The fixture in `name`.npz."""
    with np.load(DIRECTORY / f"{name}.npz") as file:
        arrays = {key: file[key] for key in file.files}
    return Fixture(name, arrays, json.loads(bytes(arrays.pop("meta_json"))))


def checksums(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """(keys, 2) float64: sum and sum of squares of each array, keys sorted."""
    wide = (arrays[key].astype(np.float64) for key in sorted(arrays))
    return np.array([(array.sum(), np.square(array).sum()) for array in wide])


def draw_normal(seed: int, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Standard normal float64 that depends on (seed, name, shape) alone."""
    generator = np.random.Generator(np.random.PCG64([seed, zlib.crc32(name.encode())]))
    return generator.standard_normal(shape)


def draw_parameter(key: str, shape: tuple[int, ...], seed: int, gain: float) -> np.ndarray:
    """One array of a checkpoint, of a size that keeps activations of order one through the network."""
    leaf = key.rpartition(".")[2]
    if leaf == "num_batches_tracked":
        return np.zeros((), np.int64)
    if leaf == "pe":
        time = np.arange(shape[1])[:, None] * np.exp(
            np.arange(0, shape[2], 2) * (-np.log(10000.0) / shape[2])
        )
        return np.stack([np.sin(time), np.cos(time)], -1).reshape(shape).astype(np.float32)
    n = draw_normal(seed, key, shape)
    if leaf == "weight" and len(shape) > 1:
        transposed = re.search(r"resize_layers\.[01]\.weight$", key)
        fan_in = shape[0] if transposed else np.prod(shape[1:])
        return (n * (gain / np.sqrt(fan_in))).astype(np.float32)
    made = {
        "running_mean": lambda: 0.1 * n,
        "running_var": lambda: np.exp(0.25 * n),
        "gamma": lambda: 0.5 + 0.1 * n,
        "bias": lambda: 0.1 * n + (1.0 if key.endswith("output_conv2.2.bias") else 0.0),
        "weight": lambda: 1.0 + 0.1 * n,
    }.get(leaf, lambda: 0.2 * n)
    return made().astype(np.float32)


def draw_image(seed: int, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """(..., 3, H, W) uint8: four waves per channel that drift along the leading axes, and noise."""
    generator = np.random.Generator(np.random.PCG64([seed, zlib.crc32(f"image:{name}".encode())]))
    *lead, channels, height, width = shape
    count = int(np.prod(lead)) if lead else 1
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    out = np.zeros((count, channels, height, width))
    for channel in range(channels):
        for _ in range(4):
            fy, fx = generator.uniform(-3, 3, 2)
            phase = generator.uniform(0, 2 * np.pi)
            amplitude, drift = generator.uniform(20, 45), generator.uniform(-0.5, 0.5)
            for i in range(count):
                wave = 2 * np.pi * (fy * y / height + fx * x / width) + phase + drift * i
                out[i, channel] += amplitude * np.sin(wave)
    out = out + 128 + 12 * generator.standard_normal(out.shape)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8).reshape(shape)
