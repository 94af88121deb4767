"""depthfeat: a small frozen network that turns depth maps into features for FID, KID and t-SNE.

Networks trained on photographs see depth only as an 8-bit picture. This one takes depth itself and was
trained (foundation/depth_feature_training.py) on random rooms and random cameras to tell what geometry a map
shows and what a sensor did to it. It knows neither the robot's scene, nor the rig's camera, nor a generator.
The version in its name changes with its weights: figures compare under one name only.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Float32

from ddgrasp import artifacts
from ddgrasp.errors import UserError
from ddgrasp.files import read_json
from ddgrasp.shipped import PRETRAINED
from foundation.pictures import in_batches
from learning.params import load_params

NAME = "depthfeat-v1"
DIRECTORY = PRETRAINED / NAME
PARAMS_FILE = "params.msgpack"
WIDTH_PX = 320
"""Maps are brought to this width, the one the network was trained at."""
NEAR_M, FAR_M = 0.2, 10.0
RESIDUAL_SCALE = 0.02
"""1/m: a local deviation of inverse depth this large is drawn at tanh 1 (a third of a pixel of disparity for
a D455 at 320 px; 1/32 px, the camera's own step, at a tenth)."""
WIDTHS = (24, 32, 64, 96)
FEATURES = sum(WIDTHS[1:])
_BATCH = 16


def picture(depth_m: Float[Array, "B H W"]) -> Float[Array, "B H W 3"]:
    """What the network sees of (B, H, W) metres, 0 = invalid: (B, H, W, 3).

    Inverse depth in [0, 1], validity, and how far a pixel's inverse depth lies from the mean of the valid
    ones around it (3 x 3), magnified: noise on surfaces is a thousandth of the range.
    """
    valid = (depth_m > 0).astype(jnp.float32)
    inverse = valid / jnp.maximum(depth_m, 1e-3)
    scaled = jnp.clip((inverse - 1 / FAR_M) / (1 / NEAR_M - 1 / FAR_M), 0, 1) * valid

    def around(x: Array) -> Array:
        return jax.lax.reduce_window(x, 0.0, jax.lax.add, (1, 3, 3), (1, 1, 1), "SAME")

    mean = around(inverse) / jnp.maximum(around(valid), 1)
    return jnp.stack([scaled, valid, jnp.tanh((inverse - mean) / RESIDUAL_SCALE) * valid], axis=-1)


class Trunk(nn.Module):
    """Strided convolutions with residual ones between; no normalisation, which would erase noise levels.

    The feature vector is the mean over the picture of every channel of the three last levels, so that fine
    texture (4 px), hole shapes (8 px) and layout (16 px) each have their share.
    """

    @nn.compact
    def __call__(self, depth_m: Float[Array, "B H W"]) -> Float[Array, f"B {FEATURES}"]:
        """(B, H, W) metres -> (B, FEATURES)."""
        x = nn.relu(nn.Conv(WIDTHS[0], (5, 5), 2)(picture(depth_m)))
        levels = []
        for width in WIDTHS[1:]:
            x = nn.relu(nn.Conv(width, (3, 3), 2)(x))
            x = nn.relu(x + nn.Conv(width, (3, 3), kernel_init=nn.initializers.zeros)(x))
            levels.append(x.mean((1, 2)))
        return jnp.concatenate(levels, axis=-1)


@dataclass(frozen=True)
class DepthFeatures:
    """The frozen extractor."""

    name: str
    source: dict[str, str]
    """For reports."""
    params: dict[str, Any]
    """`trunk`; `mean` and `std` (FEATURES,) of its features over the training pictures."""

    def __call__(self, depth_m: Float[np.ndarray, "N H W"]) -> Float32[np.ndarray, f"N {FEATURES}"]:
        """(N, H, W) metres, 0 = invalid -> (N, FEATURES) float32."""
        return in_batches(lambda maps: standardised(self.params, at_width(maps, WIDTH_PX)), depth_m, _BATCH)


@jax.jit
def standardised(params: dict[str, Any], depth_m: Float[Array, "B H W"]) -> Float[Array, f"B {FEATURES}"]:
    """(B, H, W) metres -> features with mean 0 and deviation 1 over the training pictures."""
    with jax.default_matmul_precision("highest"):
        features: Any = Trunk().apply({"params": params["trunk"]}, depth_m)
    return (features - params["mean"]) / params["std"]


def at_width(depth_m: Float[np.ndarray, "N H W"], width_px: int) -> Float32[np.ndarray, "N rows {width_px}"]:
    """(N, H, W) -> (N, H', width_px) by nearest neighbours, aspect ratio kept: holes stay holes."""
    height, width = depth_m.shape[1:]
    if width == width_px:
        return np.asarray(depth_m, np.float32)
    rows = ((np.arange(round(height * width_px / width)) + 0.5) * width / width_px).astype(int)
    columns = ((np.arange(width_px) + 0.5) * width / width_px).astype(int)
    return np.asarray(depth_m, np.float32)[:, np.minimum(rows, height - 1)[:, None], columns]


def load(directory: Path = DIRECTORY) -> DepthFeatures:
    """The extractor in `directory`; UserError if it is absent, damaged or not what its manifest names."""
    manifest = read_manifest(directory)
    digest = file_digest(directory / PARAMS_FILE)
    if digest != manifest["sha256"]:
        raise UserError(
            f"{directory / PARAMS_FILE} has SHA-256 {digest[:16]}, its manifest says "
            f"{manifest['sha256'][:16]}: restore both from the repository."
        )
    params = load_params(directory / PARAMS_FILE, jax.eval_shape(empty_params))
    return DepthFeatures(manifest["name"], {"network": manifest["name"], "sha256": digest}, params)


def read_manifest(directory: Path = DIRECTORY) -> dict[str, Any]:
    """What is known about the extractor in `directory`."""
    path = directory / artifacts.MANIFEST
    if not path.exists():
        raise UserError(
            f"{directory} holds no feature extractor: it is part of the repository (pretrained/{NAME}); "
            "another is trained by `ddgrasp ddg features`."
        )
    manifest = read_json(path)
    if not isinstance(manifest, dict) or not {"name", "sha256"} <= manifest.keys():
        raise UserError(f"{path} is no feature extractor's manifest: restore it from the repository.")
    return manifest


def name_of(digest: str) -> str:
    """The name of an extractor with weights of this SHA-256; NAME is that of the frozen one alone."""
    return f"depthfeat-{digest[:8]}"


def file_digest(path: Path) -> str:
    """SHA-256 of a file; UserError if it is absent."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: restore it from the repository.") from None


def empty_params() -> dict[str, Any]:
    """Parameters of the right shapes."""
    trunk = Trunk().init(jax.random.key(0), jnp.zeros((1, 32, 32)))["params"]
    return {"trunk": trunk, "mean": jnp.zeros(FEATURES), "std": jnp.ones(FEATURES)}
