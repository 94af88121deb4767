"""Random weights of published networks' shapes, made once for all tests of a process."""

from functools import cache
from pathlib import Path

import numpy as np

import parity_support as parity
from ddgrasp.files import atomic_write_json
from foundation import convert, store


@cache
def resnet18() -> dict[str, np.ndarray]:
    """What the published file holds, by its keys. To be left as it is: other tests get the same."""
    shapes = {key: target.shape for key, target in convert.targets("resnet18").items()}
    return {key: parity.draw_parameter(key, shape, 5, 1.0) for key, shape in shapes.items()}


def depth_anything_v2_small(base: Path) -> Path:
    """The small image network's folder in `base`, as `weights convert` would leave it."""
    network = "depth_anything_v2_small"
    directory = base / network
    if (directory / store.MANIFEST).exists():
        return directory
    rng = np.random.default_rng(0)
    arrays = {
        key: (rng.normal(0, 0.3, target.shape) / max(1, np.prod(target.shape[1:])) ** 0.5).astype(np.float32)
        for key, target in convert.targets(network).items()
    }
    arrays["depth_head.scratch.output_conv2.2.bias"] += 1
    store._save(directory / store.CHECKPOINT, convert.convert(network, arrays))
    manifest = store.WeightsManifest(network, "x.pth", "ab12", "Apache-2.0", "here", 1, {}, "today")
    atomic_write_json(directory / store.MANIFEST, manifest)
    return directory
