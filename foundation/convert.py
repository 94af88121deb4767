"""A published checkpoint's arrays as Flax variables, after checking that all of them belong there.

A module's name is its path in the checkpoint, so only the last part of a name and the order of axes differ:
dense (out, in) -> (in, out), convolution (out, in, h, w) -> (h, w, in, out), transposed convolution
(in, out, h, w) -> (h, w, in, out).
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ddgrasp.errors import UserError
from foundation import catalog
from foundation.depth import DepthNetwork
from foundation.inception import FEATURES, FidInception
from foundation.resnet import ResNet18
from foundation.sizes import SIZES, get_size

NAMED = 5
"""Keys of each kind that an error names."""

_LEAVES = {
    "kernel": "weight",
    "transposed_kernel": "weight",
    "scale": "weight",
    "mean": "running_mean",
    "var": "running_var",
}
"""Flax's name of an array -> the checkpoint's, where they differ."""
_AXES = {("kernel", 2): (1, 0), ("kernel", 4): (2, 3, 1, 0), ("transposed_kernel", 4): (2, 3, 0, 1)}
"""(name, rank) -> the checkpoint's axes in Flax's order, where they differ."""
_BATCH_COUNT = "num_batches_tracked"
"""Kept by batch norms for training; files from before it existed lack it."""


@dataclass(frozen=True)
class Target:
    """Where an array of the checkpoint goes."""

    shape: tuple[int, ...]
    """In the checkpoint."""
    path: tuple[str, ...] = ()
    """In the Flax variables; empty if the network does not use it."""
    axes: tuple[int, ...] = ()
    """The checkpoint's axes in Flax's order; empty if they are the same."""
    optional: bool = False


def variable_shapes(network: str) -> dict[str, Any]:
    """Flax variables of the network called `network` as a tree of jax.ShapeDtypeStruct."""
    catalog.get_entry(network)
    if network in (catalog.RESNET18, catalog.FID_INCEPTION):
        module = ResNet18() if network == catalog.RESNET18 else FidInception()
        return dict(jax.eval_shape(module.init, jax.random.key(0), jnp.zeros((1, 96, 96, 3))))
    return {"params": depth_network(network).param_shapes()}


def depth_network(network: str, **options: Any) -> DepthNetwork:
    """The depth network of that name; `options` are fields of `DepthNetwork`."""
    family, _, size = catalog.get_entry(network).name.rpartition("_")
    return DepthNetwork(get_size(size), family == catalog.VIDEO_DEPTH, **options)


def targets(network: str) -> dict[str, Target]:
    """Every key of the network's published checkpoint."""
    found = {}
    for (collection, *modules, leaf), shape in _leaves(variable_shapes(network)):
        axes = _AXES.get((leaf, len(shape)), ())
        there = tuple(shape[axes.index(axis)] for axis in range(len(shape))) if axes else shape
        key = ".".join([*modules, _LEAVES.get(leaf, leaf)])
        found[key] = Target(there, (collection, *modules, leaf), axes)
        if leaf == "mean":
            found[".".join([*modules, _BATCH_COUNT])] = Target((), optional=True)
    return found | _unused(network)


def _leaves(tree: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], tuple]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, (*path, name))
        else:
            yield (*path, name), tuple(value.shape)


def _unused(network: str) -> dict[str, Target]:
    """Arrays that lie in the published file without being part of what is computed."""
    if network == catalog.RESNET18:
        return {}
    if network == catalog.FID_INCEPTION:
        return {"fc.weight": Target((1008, FEATURES)), "fc.bias": Target((1008,))}
    depth = depth_network(network)
    unit, features = f"{depth.head}.scratch.refinenet4.resConfUnit1", depth.size.features
    arrays = {"pretrained.mask_token": Target((1, depth.size.width))}
    for conv in ("conv1", "conv2"):
        arrays[f"{unit}.{conv}.weight"] = Target((features, features, 3, 3))
        arrays[f"{unit}.{conv}.bias"] = Target((features,))
    return arrays


def recognise(shapes: Mapping[str, tuple[int, ...]]) -> str:
    """The network whose checkpoint has such keys; UserError if none has."""
    signs = (
        ("head.motion_modules.", catalog.VIDEO_DEPTH),
        ("depth_head.", catalog.IMAGE_DEPTH),
        ("Mixed_5b.", catalog.FID_INCEPTION),
        ("layer1.0.", catalog.RESNET18),
    )
    family = next((family for prefix, family in signs if any(key.startswith(prefix) for key in shapes)), "")
    if not family:
        raise UserError(
            f"The checkpoint's {len(shapes)} keys ({_listed(list(shapes))}) belong to none of: "
            f"{', '.join(catalog.ENTRIES)}."
        )
    if family in catalog.ENTRIES:
        return family
    widths = Counter(
        shape[0] for key, shape in shapes.items() if key.startswith("pretrained.") and len(shape) == 1
    )
    width = widths.most_common(1)[0][0] if widths else 0
    for size in SIZES.values():
        if size.width == width:
            return f"{family}_{size.name}"
    known = ", ".join(f"{size.name} {size.width}" for size in SIZES.values())
    raise UserError(f"The checkpoint is a {family} of width {width}; known widths: {known}.")


def convert(network: str, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Flax variables (float32 NumPy) from a checkpoint's arrays.

    Raises UserError naming the first missing, surplus and misshapen keys, or one whose values are not finite.
    """
    wanted = targets(network)
    check_keys(network, wanted, {key: tuple(array.shape) for key, array in arrays.items()})
    variables: dict[str, Any] = {}
    for key, target in wanted.items():
        if not target.path:
            continue
        array = np.asarray(arrays[key], np.float32)
        if not np.isfinite(array).all():
            raise UserError(f"The checkpoint's {key} holds values that are not finite: get the file again.")
        here = variables
        for name in target.path[:-1]:
            here = here.setdefault(name, {})
        here[target.path[-1]] = np.ascontiguousarray(array.transpose(target.axes) if target.axes else array)
    return variables


def check_keys(network: str, wanted: Mapping[str, Target], given: Mapping[str, tuple[int, ...]]) -> None:
    """UserError unless `given` (key -> shape) is exactly what the network's checkpoint holds."""
    missing = [key for key, target in wanted.items() if key not in given and not target.optional]
    surplus = [key for key in given if key not in wanted]
    misshapen = [
        f"{key} is {list(given[key])}, expected {list(target.shape)}"
        for key, target in wanted.items()
        if key in given and given[key] != target.shape
    ]
    problems = [
        f"{len(keys)} {kind}: {_listed(keys)}"
        for kind, keys in (("missing", missing), ("surplus", surplus), ("misshapen", misshapen))
        if keys
    ]
    if problems:
        raise UserError(f"The checkpoint is not {network}'s. {'; '.join(problems)}.")


def _listed(keys: Sequence[str]) -> str:
    return ", ".join(keys[:NAMED]) + (", ..." if len(keys) > NAMED else "")
