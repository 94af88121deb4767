"""The exported policy, an ONNX file."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from ddgrasp.config.checks import Count, Range, Section

DepthDtype = Literal["uint16_mm", "float32_m"]
DEPTH_DTYPES: tuple[DepthDtype, ...] = get_args(DepthDtype)


@dataclass(frozen=True)
class ExportConfig(Section, name="export"):
    """ONNX file."""

    depth_dtype: DepthDtype = "uint16_mm"
    """What the file's depth input takes: uint16_mm (as cameras deliver it) or float32_m."""
    ddim_steps: Annotated[int, Range(0, 10000)] = 0
    """Denoising iterations inside the file; 0 means the student's own."""
    parity_batches: Annotated[int, Range(1, 100000)] = 25
    """Batches of four on which JAX and onnxruntime are compared."""
    latency_runs: Count = 200
    """Single inferences timed on one thread."""
    max_abs_diff: Annotated[float, Range(0, 1, above=True)] = 1e-4
    """Largest accepted difference between the JAX and the ONNX action."""
