"""Pictures to feature vectors, for metrics that compare sets of pictures (FID, KID, t-SNE).

With published weights: the Inception that FID is defined by, or ImageNet's ResNet-18. Without any: a
ResNet-18 with fixed random weights, whose features tell distributions apart as well (Naeem et al. 2020,
section 4.2), but whose figures compare only with each other. The extractor's name says which one it was.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, UInt8

from foundation import catalog, pictures, store
from foundation.convert import variable_shapes
from foundation.inception import FidInception
from foundation.resnet import ResNet18

RANDOM = "resnet18_random_v1"
"""Name of the built-in extractor; the number changes if its weights ever do."""
_RANDOM_SEED = 2015
_BATCH = 16


@dataclass(frozen=True)
class Extractor:
    """A network that turns pictures into features."""

    name: str
    source: str | dict[str, str]
    """For reports: "built-in", or which weights were used."""
    variables: dict[str, Any]

    def __call__(self, rgb: UInt8[np.ndarray, "N H W 3"]) -> Float32[np.ndarray, "N d"]:
        """(N, H, W, 3) uint8 -> (N, 2048) (FID Inception) or (N, 512) (ResNet-18), float32."""
        function = _inception if self.name == catalog.FID_INCEPTION else _resnet18
        return pictures.in_batches(partial(function, self.variables), rgb, _BATCH)


def load_extractor(weights: Path | None = None) -> Extractor:
    """The extractor whose converted weights lie in the folder `weights`; the built-in one without.

    Raises UserError if the folder holds none, or another network's.
    """
    if weights is None:
        return Extractor(RANDOM, store.BUILT_IN, random_resnet18())
    manifest, variables = store.load(weights, (catalog.FID_INCEPTION, catalog.RESNET18))
    return Extractor(manifest.network, manifest.summary(), variables)


def random_resnet18() -> dict[str, Any]:
    """ResNet-18 with He-normal kernels (He et al. 2015, eq. 10), the same on every machine."""
    rng = np.random.default_rng(_RANDOM_SEED)

    def draw(path: tuple[Any, ...], leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        name = path[-1].key
        if name == "kernel":
            fan_in = int(np.prod(leaf.shape[:-1]))
            return (rng.standard_normal(leaf.shape) * np.sqrt(2 / fan_in)).astype(np.float32)
        return np.full(leaf.shape, 1.0 if name in ("scale", "var") else 0.0, np.float32)

    return jax.tree_util.tree_map_with_path(draw, variable_shapes(catalog.RESNET18))


@jax.jit
def _inception(variables: dict[str, Any], rgb: jax.Array) -> jax.Array:
    with jax.default_matmul_precision("highest"):
        features = FidInception().apply(variables, jnp.asarray(rgb, jnp.float32) / 255)
    assert isinstance(features, jax.Array)
    return features


@jax.jit
def _resnet18(variables: dict[str, Any], rgb: jax.Array) -> jax.Array:
    with jax.default_matmul_precision("highest"):
        features, _ = ResNet18().apply(variables, pictures.standardise(rgb))
    assert isinstance(features, jax.Array)
    return features
