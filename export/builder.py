"""A thin writer of ONNX nodes: every method adds one operator and returns the name of its output."""

from collections.abc import Callable, Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np
import onnx
from jaxtyping import Real, Shaped
from onnx import TensorProto, helper, numpy_helper

from ddgrasp.arrays import AnyArray

OPSET = 18
IR_VERSION = 10
"""Understood by every onnxruntime that understands OPSET; newer onnx would write a newer one."""
Part = slice
"""Named anew, since a method of the builder is called slice."""


class GraphBuilder:
    """Collects nodes and constants; equal constants are stored once."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, onnx.TensorProto] = {}
        self._names_of_constants: dict[tuple, str] = {}
        self._number = count()

    def op(self, kind: str, *inputs: str, spare: int = 0, **attributes: Any) -> str:
        """One operator; its first output, after which it has `spare` others."""
        output = f"{kind.lower()}_{next(self._number)}"
        others = [f"{output}_spare_{i}" for i in range(spare)]
        self.nodes.append(helper.make_node(kind, inputs, [output, *others], name=output, **attributes))
        return output

    def constant(
        self, value: Shaped[AnyArray, "..."] | Sequence[float] | float, dtype: type = np.float32
    ) -> str:
        """An initializer."""
        return self._kept(np.ascontiguousarray(value, dtype))

    def _kept(self, array: np.ndarray) -> str:
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._names_of_constants:
            name = f"constant_{len(self.constants)}"
            self.constants[name] = numpy_helper.from_array(array, name)
            self._names_of_constants[key] = name
        return self._names_of_constants[key]

    def integers(self, values: Sequence[int]) -> str:
        """An int64 initializer: shapes, axes, indices."""
        return self.constant(values, np.int64)

    def scalar(self, value: int) -> str:
        """An int64 initializer without axes: lengths, loop counts, one index."""
        return self._kept(np.array(value, np.int64))

    def add(self, a: str, b: str) -> str:
        """a + b."""
        return self.op("Add", a, b)

    def mul(self, a: str, b: str) -> str:
        """a * b."""
        return self.op("Mul", a, b)

    def relu(self, x: str) -> str:
        """max(x, 0)."""
        return self.op("Relu", x)

    def silu(self, x: str) -> str:
        """x * sigmoid(x)."""
        return self.mul(x, self.op("Sigmoid", x))

    def concat(self, parts: Sequence[str], axis: int) -> str:
        """Joins tensors along an axis."""
        return self.op("Concat", *parts, axis=axis)

    def reshape(self, x: str, shape: Sequence[int]) -> str:
        """0 keeps an axis, -1 infers one."""
        return self.op("Reshape", x, self.integers(shape))

    def slice(self, x: str, starts: Sequence[int], ends: Sequence[int], axes: Sequence[int]) -> str:
        """x[start:end] along each of the axes."""
        return self.op("Slice", x, self.integers(starts), self.integers(ends), self.integers(axes))

    def columns(self, x: str, part: Part) -> str:
        """The columns of (B, n) in `part`, one of a `ddgrasp.layout`."""
        return self.slice(x, [part.start], [part.stop], [1])

    def column(self, x: str, index: int) -> str:
        """(B, 1), one of (B, n)."""
        return self.columns(x, slice(index, index + 1))

    def dense(self, x: str, params: Mapping[str, AnyArray]) -> str:
        """Flax Dense on (B, n): x @ kernel + bias."""
        return self.affine(x, params["kernel"], params.get("bias"))

    def affine(self, x: str, kernel: Real[AnyArray, "n m"], bias: Real[AnyArray, " m"] | None = None) -> str:
        """(B, n) @ (n, m) + (m,); both become float32, as all constants."""
        inputs = [x, self.constant(kernel)] + ([] if bias is None else [self.constant(bias)])
        return self.op("Gemm", *inputs)

    def conv(
        self,
        x: str,
        kernel: Real[AnyArray, "h w channels_in channels"],
        bias: Real[AnyArray, " channels"] | None = None,
        *,
        stride: int = 1,
        pad: int = 0,
    ) -> str:
        """NCHW convolution with a Flax (h, w, in, out) kernel and symmetric padding."""
        weights = np.transpose(kernel, (3, 2, 0, 1))
        inputs = [x, self.constant(weights)] + ([] if bias is None else [self.constant(bias)])
        return self.op("Conv", *inputs, kernel_shape=weights.shape[2:], strides=[stride] * 2, pads=[pad] * 4)

    def output(self, name: str, x: str) -> None:
        """Gives `x` a name of the model's outputs."""
        self.nodes.append(helper.make_node("Identity", [x], [name], name=name))

    def loop(
        self, trips: str, carried: Sequence[str], body: Callable[[str, list[str]], list[str]]
    ) -> list[str]:
        """Float tensors `carried` after `trips` (a scalar int64) repetitions of `body`.

        Args:
          body: writes the nodes of one repetition, given its number (a scalar int64) and what is carried into
            it, and returns what is carried on; it may use everything written before the loop.
        """
        label = f"loop_{next(self._number)}"
        number, going, going_on = (f"{label}_{part}" for part in ("number", "going", "going_on"))
        taken = [f"{label}_in_{i}" for i in range(len(carried))]
        results = [f"{label}_out_{i}" for i in range(len(carried))]
        around, self.nodes = self.nodes, []
        left = body(number, taken)
        self.nodes.append(helper.make_node("Identity", [going], [going_on], name=going_on))
        scalars = [tensor(number, [], TensorProto.INT64), tensor(going, [], TensorProto.BOOL)]
        graph = helper.make_graph(
            self.nodes,
            f"{label}_body",
            [*scalars, *(_any_shape(name) for name in taken)],
            [tensor(going_on, [], TensorProto.BOOL), *(_any_shape(name) for name in left)],
        )
        self.nodes = around
        self.nodes.append(helper.make_node("Loop", [trips, "", *carried], results, name=label, body=graph))
        return results

    def model(
        self,
        inputs: Sequence[onnx.ValueInfoProto],
        outputs: Sequence[onnx.ValueInfoProto],
        metadata: dict[str, str],
        *,
        name: str = "policy",
    ) -> onnx.ModelProto:
        """The finished model, checked by onnx.checker with full shape inference."""
        graph = helper.make_graph(
            self.nodes, name, list(inputs), list(outputs), initializer=list(self.constants.values())
        )
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="ddgrasp",
        )
        helper.set_model_props(model, metadata)
        onnx.checker.check_model(model, full_check=True)
        return model


def tensor(name: str, shape: Sequence[int | str], dtype: int = TensorProto.FLOAT) -> onnx.ValueInfoProto:
    """An input or output of the model."""
    return helper.make_tensor_value_info(name, dtype, shape)


def _any_shape(name: str) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, None)
