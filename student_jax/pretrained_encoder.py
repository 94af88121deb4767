"""First weights of the student's encoder from ImageNet's ResNet-18 (paper III-C3).

The published network has RGB in and batch norms; the student has depth frames in and group norms.
Convolutions and the norms' gains and offsets are taken over; of the first convolution, colour c serves frame
c (the paper stacks three depth frames where ImageNet has three colours), and channels besides depth start at
zero.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from ddgrasp import contract
from ddgrasp.config import StudentConfig
from ddgrasp.errors import UserError
from foundation import catalog, store
from foundation.resnet import BLOCKS, STAGE_CHANNELS

DEPTH_CHANNELS = ("relief", "depth")
"""The student's channels that a colour can stand for, in order of preference."""
_RESNET18 = {
    "stem": "conv7",
    "width": STAGE_CHANNELS[0],
    "max_channels": STAGE_CHANNELS[-1],
    "stage_blocks": (BLOCKS,) * len(STAGE_CHANNELS),
}


def source(config: StudentConfig) -> str | dict[str, str]:
    """For reports: "built-in", or the weights that the encoder starts from.

    Raises UserError if `config.encoder.weights` holds none of ResNet-18, or the student's encoder is none.
    """
    if not config.encoder.weights:
        return store.BUILT_IN
    _check(config)
    return store.manifest_of(Path(config.encoder.weights), (catalog.RESNET18,)).summary()


def load_into(encoder: Mapping[str, Any], config: StudentConfig) -> dict[str, Any]:
    """The encoder's parameters with those of `config.encoder.weights` in place; unchanged without weights.

    Raises UserError as `source`.
    """
    if not config.encoder.weights:
        return dict(encoder)
    _check(config)
    _, variables = store.load(Path(config.encoder.weights), (catalog.RESNET18,))
    return from_resnet18(encoder, variables["params"], config)


def _check(config: StudentConfig) -> None:
    """UserError naming the first option that makes the encoder another network."""
    for name, wanted in _RESNET18.items():
        if (value := getattr(config.encoder, name)) != wanted:
            raise UserError(
                f"student.encoder.{name} is {value!r}; ResNet-18 (student.encoder.weights) needs {wanted!r}."
            )
    if not set(DEPTH_CHANNELS) & set(config.picture.channels):
        raise UserError(
            f"student.picture.channels is {config.picture.channels}; student.encoder.weights needs depth or "
            "relief."
        )


def from_resnet18(
    encoder: Mapping[str, Any], params: Mapping[str, Any], config: StudentConfig
) -> dict[str, Any]:
    """The encoder's tree with ResNet-18's arrays; what ResNet-18 lacks (pooling, features) stays."""
    stem = {"conv7": _conv_norm(encoder["stem"]["conv7"], params["conv1"], params["bn1"])}
    stem["conv7"]["conv"]["kernel"] = first_kernel(np.asarray(params["conv1"]["kernel"]), config)
    made = {**encoder, "stem": stem}
    for stage in range(len(STAGE_CHANNELS)):
        for block in range(BLOCKS):
            name, there = f"stage{stage}_block{block}", params[f"layer{stage + 1}.{block}"]
            parts = {"first": ("conv1", "bn1"), "second": ("conv2", "bn2")}
            if "downsample.0" in there and "shortcut" in encoder[name]:
                parts["shortcut"] = ("downsample.0", "downsample.1")
            made[name] = {
                part: _conv_norm(encoder[name][part], there[conv], there[norm])
                for part, (conv, norm) in parts.items()
            }
    return made


def first_kernel(
    kernel: Float[np.ndarray, "7 7 3 64"], config: StudentConfig
) -> Float32[np.ndarray, "7 7 C 64"]:
    """(7, 7, 3, 64) over RGB -> (7, 7, 3 * channels, 64) over frames and, faster, their channels."""
    depth = next(name for name in DEPTH_CHANNELS if name in config.picture.channels)
    rows, columns, _, outputs = kernel.shape
    made = np.zeros((rows, columns, contract.DEPTH_FRAMES, len(config.picture.channels), outputs), np.float32)
    made[:, :, :, config.picture.channels.index(depth)] = kernel
    return made.reshape(rows, columns, -1, outputs)


def _conv_norm(
    here: Mapping[str, Any], conv: Mapping[str, Any], norm: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """The student's ConvNorm from a convolution and its batch norm, whose values go if there is no norm."""
    made = {"conv": {**here["conv"], "kernel": np.asarray(conv["kernel"])}}
    if "norm" in here:
        made["norm"] = {name: np.asarray(norm[name]) for name in ("scale", "bias")}
    return made
