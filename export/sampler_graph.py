"""ONNX nodes of the denoiser and the unrolled DDIM loop (student_jax/denoiser.py, learning/diffusion.py)."""

import numpy as np
import onnx

from ddgrasp import contract
from ddgrasp.config import StudentConfig
from export.builder import GraphBuilder
from export.layers import Params
from learning import diffusion
from student_jax import denoiser, policy


def write_sampler(
    g: GraphBuilder, cond: str, params: Params, student: StudentConfig, iterations: int
) -> None:
    """DDIM from the noise input to the action output."""
    schedule = policy.noise_schedule(student)
    network = _Denoiser(g, cond, params, student)
    size = student.head.chunk * contract.ACTION_SIZE
    x = g.reshape(contract.ONNX_INPUT_NOISE, [0, size])
    visited = diffusion.timesteps(schedule.steps, iterations, "trailing")
    for k, row in zip(visited, diffusion.ddim_table(schedule, visited), strict=True):
        x = _write_ddim_step(g, x, network.predict(x, int(k)), diffusion.DDIMCoefficients(row))
    shape = g.integers([0, student.head.chunk, contract.ACTION_SIZE])
    g.nodes.append(onnx.helper.make_node("Reshape", [x, shape], [contract.ONNX_OUTPUT_ACTION], name="action"))


def _write_ddim_step(g: GraphBuilder, x: str, eps: str, c: diffusion.DDIMCoefficients) -> str:
    """One step as `diffusion.ddim_sample` takes it; the last one is x0 itself."""
    scaled = g.mul(x, g.constant(c.x))
    x0 = g.op("Sub", scaled, g.mul(eps, g.constant(c.eps)))
    x0 = g.op("Clip", x0, g.constant(-1.0), g.constant(1.0))
    if c.next_eps == 0:
        return x0
    agreeing = g.op("Div", g.op("Sub", scaled, x0), g.constant(c.eps))
    return g.add(g.mul(x0, g.constant(c.next_x_0)), g.mul(agreeing, g.constant(c.next_eps)))


class _Denoiser:
    """Writes the denoiser once per diffusion step, sharing all that does not depend on the step.

    A Dense over the concatenation [cond, time] is cond @ its upper rows (shared) + time @ its lower rows
    (a constant).
    """

    def __init__(self, g: GraphBuilder, cond: str, params: Params, student: StudentConfig):
        self.g, self.params, self.student = g, params, student
        self.film = student.head.conditioning == "film"
        self.action_size = student.head.chunk * contract.ACTION_SIZE
        blocks = range(student.head.blocks) if self.film else []
        self.films = [self._shared(cond, np.asarray(params[f"block{i}"]["film"]["kernel"])) for i in blocks]
        if not self.film:
            self.input = self._shared(cond, np.asarray(params["input"]["kernel"])[self.action_size :])

    def _shared(self, cond: str, kernel: np.ndarray) -> str:
        return self.g.op("MatMul", cond, self.g.constant(kernel[: -self.student.head.time_features]))

    def predict(self, x: str, k: int) -> str:
        """Noise predicted for the flattened chunk x (B, chunk * 8) at diffusion step k."""
        g, params = self.g, self.params
        time = self._time(k)
        kernel, bias = np.asarray(params["input"]["kernel"]), np.asarray(params["input"]["bias"])
        if self.film:
            x = g.affine(x, kernel, bias)
        else:
            fixed = bias + time @ kernel[-len(time) :]
            x = g.add(g.affine(x, kernel[: self.action_size], fixed), self.input)
        for index in range(self.student.head.blocks):
            x = self._block(x, index, time)
        return g.dense(g.silu(self._layer_norm(x, params["norm"])), params["output"])

    def _time(self, k: int) -> np.ndarray:
        """The embedded step after its two Dense layers."""
        first, second = self.params["time_first"], self.params["time_second"]
        embedded = denoiser.embed_time(k, self.student.head.time_features, np)
        hidden = embedded @ first["kernel"] + first["bias"]
        hidden = hidden / (1.0 + np.exp(-hidden))
        return np.asarray(hidden @ second["kernel"] + second["bias"])

    def _block(self, x: str, index: int, time: np.ndarray) -> str:
        g, params = self.g, self.params[f"block{index}"]
        y = g.dense(self._layer_norm(x, params["norm"]), params["first"])
        if self.film:
            width = self.student.head.width
            fixed = (
                np.asarray(params["film"]["bias"]) + time @ np.asarray(params["film"]["kernel"])[-len(time) :]
            )
            one_plus = np.concatenate([1.0 + fixed[:width], fixed[width:]])
            film = g.add(self.films[index], g.constant(one_plus))
            y = g.mul(y, g.slice(film, [0], [width], [1]))
            y = g.add(y, g.slice(film, [width], [2 * width], [1]))
        return g.add(x, g.dense(g.silu(y), params["second"]))

    def _layer_norm(self, x: str, params: Params) -> str:
        scale, bias = self.g.constant(params["scale"]), self.g.constant(params["bias"])
        return self.g.op("LayerNormalization", x, scale, bias, axis=-1, epsilon=denoiser.LAYER_NORM_EPSILON)
