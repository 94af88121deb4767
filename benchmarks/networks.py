"""Frames per second of the foundation networks: batch sizes, dtypes, against onnxruntime on the same network.

    python -m benchmarks.networks

Random weights (speed does not depend on their values). `/ ONNX` is this line's speed over onnxruntime's at
the same batch, on all cores (JAX on an accelerator where there is one); `error` the mean difference from
JAX's float32, or without that from onnxruntime's, over its standard deviation.
Lines alternate between the two, so that other work on the machine slows both.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx

from benchmarks import network_graphs
from benchmarks.compare import seconds_in_turns
from ddgrasp.onnx_runtime import ort
from foundation import catalog
from foundation.convert import depth_network, variable_shapes
from foundation.depth import DTYPES
from foundation.inception import FidInception
from foundation.resnet import ResNet18
from foundation.sizes import PATCH_PX

ONNX = "onnxruntime"


@dataclass(frozen=True)
class Case:
    """A network at an input size."""

    title: str
    shape: tuple[int, ...]
    """(frames, rows, columns, 3) of one batch entry; frames > 1 for clips."""
    variables: dict[str, Any]
    run: Callable[[str, Any, jax.Array], jax.Array]
    """(dtype, variables, (N, rows, columns, 3)) -> the network's output."""
    graph: Callable[[dict[str, Any], Sequence[int]], onnx.ModelProto]
    """(variables, NCHW shape) -> the same network for onnxruntime."""


def random_variables(network: str) -> dict[str, Any]:
    """Weights of a size that keeps activations of order one."""
    rng = np.random.default_rng(0)

    def draw(path: tuple[Any, ...], leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        name = path[-1].key
        if name in ("scale", "var", "gamma"):
            return np.ones(leaf.shape, np.float32)
        fan_in = np.prod(leaf.shape[:-1]) if "kernel" in name else 25.0
        return (rng.standard_normal(leaf.shape) / np.sqrt(fan_in)).astype(np.float32)

    return jax.tree_util.tree_map_with_path(draw, variable_shapes(network))


def depth_case(network: str, frames: int, side: int) -> Case:
    """A depth network on square pictures."""

    def run(dtype: str, variables: Any, x: jax.Array) -> jax.Array:
        made = depth_network(network, dtype=dtype)
        return made(variables["params"], x[None] if made.video else x).reshape(x.shape[:3])

    def graph(variables: dict[str, Any], shape: Sequence[int]) -> onnx.ModelProto:
        return network_graphs.depth_model(depth_network(network), variables["params"], shape)

    title = f"{network} {side}x{side}" + (f", clip of {frames}" if frames > 1 else "")
    return Case(title, (frames, side, side, 3), random_variables(network), run, graph)


def classifier_case(network: str, side: int) -> Case:
    """ResNet-18 or FID Inception, to their features."""
    resnet = network == catalog.RESNET18

    def run(dtype: str, variables: Any, x: jax.Array) -> jax.Array:
        module = ResNet18(jnp.dtype(dtype)) if resnet else FidInception(jnp.dtype(dtype))
        with jax.default_matmul_precision("highest" if dtype == "float32" else "default"):
            made: Any = module.apply(variables, x)
        return made[0] if resnet else made

    graph = network_graphs.resnet18_model if resnet else network_graphs.inception_model
    return Case(f"{network} {side}x{side}", (1, side, side, 3), random_variables(network), run, graph)


def cases(side: int) -> list[Case]:
    """All four networks, the depth ones at `side`."""
    clip = min(side, 20 * PATCH_PX)
    return [
        depth_case("depth_anything_v2_small", 1, side),
        depth_case("video_depth_anything_small", 8, clip),
        classifier_case(catalog.RESNET18, 224),
        classifier_case(catalog.FID_INCEPTION, 299),
    ]


def open_session(model: onnx.ModelProto) -> ort.InferenceSession:
    """On all cores; threads that wait do not spin, which on a busy machine would slow both sides."""
    options = ort.SessionOptions()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return ort.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def measure(case: Case, batch: int, dtypes: Sequence[str], runs: int) -> None:
    """Prints onnxruntime's line and JAX's, one per dtype."""
    frames, height, width, _ = case.shape
    count = frames * batch
    x = np.random.default_rng(1).random((count, height, width, 3), np.float32)
    first = np.ascontiguousarray(np.moveaxis(x, -1, 1))
    session = open_session(case.graph(case.variables, first.shape))
    variables, on_device = jax.device_put((case.variables, x))

    def run_jax(function: Callable[[Any, jax.Array], jax.Array]) -> np.ndarray:
        return np.asarray(function(variables, on_device))

    runners: dict[str, Callable[[], np.ndarray]] = {
        ONNX: lambda: np.asarray(session.run(None, {network_graphs.INPUT: first})[0])
    }
    for dtype in dtypes:
        runners[dtype] = partial(run_jax, jax.jit(partial(case.run, dtype)))
    results = {name: runner().reshape(-1) for name, runner in runners.items()}
    exact = results.get("float32", results[ONNX])
    seconds = {name: float(np.median(times)) for name, times in seconds_in_turns(runners, runs).items()}
    for name in runners:
        runner, dtype = (ONNX, "float32") if name == ONNX else (f"JAX {jax.default_backend()}", name)
        error = float(np.abs(results[name] - exact).mean() / exact.std())
        print(
            f"{case.title:<50}{runner:<13}{dtype:<10}{batch:>6}{count / seconds[name]:>10.2f}"
            f"{seconds[ONNX] / seconds[name]:>8.2f}{error:>10.1e}",
            flush=True,
        )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--side", type=int, default=518, help="side of the depth networks' pictures")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--dtypes", nargs="+", default=list(DTYPES), choices=DTYPES)
    parser.add_argument("--runs", type=int, default=5)
    arguments = parser.parse_args()
    print(f"{'network':<50}{'runner':<13}{'dtype':<10}{'batch':>6}{'frames/s':>10}{'/ ONNX':>8}{'error':>10}")
    for case in cases(arguments.side):
        for batch in arguments.batches:
            if case.shape[0] == 1 or batch == 1:  # a batch of clips is what one clip is, several times
                measure(case, batch, arguments.dtypes, arguments.runs)


if __name__ == "__main__":
    main()
