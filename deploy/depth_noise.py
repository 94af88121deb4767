"""An exported generator in any simulator: clean depth in, what the camera would have reported out.

    generator = DepthGenerator("generator.onnx")
    reported_m = generator(depth_m)  # (N, H, W), (N, 1, H, W) or (N, H, W, 1); NumPy or PyTorch

Imports NumPy and onnxruntime; PyTorch only where tensors come in, JAX never.
"""

import importlib
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ddgrasp import generator_metadata as names
from ddgrasp.errors import UserError
from ddgrasp.onnx_runtime import ort
from ddgrasp.shipped import shipped

_OUTPUTS = {names.OUTPUT_DEPTH: np.float32, names.OUTPUT_PREDICTED: np.float32, names.OUTPUT_MASK: np.bool_}

Array = Any
"""A NumPy array or a PyTorch tensor."""


class Reported(NamedTuple):
    """What the camera would have reported, in the library and the shape of the depth that came in; depth in
    float32."""

    depth_m: Array
    """Simulated depth with the camera's artefacts, 0 = hole."""
    predicted_m: Array
    """The generator's own map."""
    mask: Array
    """Where an artefact was grafted; everywhere else `depth_m` is the simulation's, to the bit of float32
    unless the generator has a window (`ddg.graft.window_px`), through which it goes first."""


class DepthGenerator:
    """A file of `ddgrasp ddg export`, ready to run."""

    def __init__(
        self, path: Path | str, *, device: str = "cpu", threads: int = 0, seed: int = 0, batch: int = 32
    ):
        """Loads and checks the file.

        Args:
          path: the file.
          device: cpu, cuda or cuda:1, where the network runs; cuda needs onnxruntime-gpu.
          threads: of the CPU; 0 takes all cores.
          seed: of the noise of calls that are given none.
          batch: frames that go through the network at once; a call may have more, for as much memory.

        Raises:
          UserError: no such file, no generator, a device that onnxruntime does not have, or no number where
            one is wanted.
        """
        self.path = shipped(path)
        check_count("threads", threads, 0)
        check_count("seed", seed, 0)
        check_count("batch", batch, 1)
        self._batch = batch
        self._kind, self._device_number = _device(device)
        self._session = _open(self.path, self._kind, self._device_number, threads)
        self.info = names.read(self._session.get_modelmeta().custom_metadata_map, str(self.path))
        inputs = {one.name: one.shape for one in self._session.get_inputs()}
        names.validate_shapes(self.info, inputs, str(self.path))
        self._seed, self._normals, self._looked = seed, {}, False

    def __call__(self, depth_m: Array, noise: Array | None = None, *, steps: int | None = None) -> Array:
        """`generate`, the grafted depth alone."""
        return self.generate(depth_m, noise, steps=steps).depth_m

    def generate(self, depth_m: Array, noise: Array | None = None, *, steps: int | None = None) -> Reported:
        """Gives clean frames the camera's artefacts.

        Args:
          depth_m: (N, H, W), (N, 1, H, W) or (N, H, W, 1) floating-point planar metres, 0 = nothing in range;
            any size with the generator's shape.
          noise: (N, P, h, w) standard normal numbers, of an `EpisodeNoise` for frames that follow each other;
            None draws them, frames then have nothing to do with each other.
          steps: network evaluations, the file's own by default.

        Raises:
          UserError: depth of another type, rank, shape or unit, noise that does not fit, or steps that the
            file does not have.

        Warns in the first call if most of the scene is nearer or farther than what it was fitted on.
        """
        steps = self._checked_steps(steps)
        frames = _frames(depth_m)
        self._check(frames)
        given = self._drawn(frames, steps) if noise is None else noise
        wanted = (len(frames), self.info.planes(steps), self.info.height_px, self.info.width_px)
        shape = tuple(getattr(given, "shape", ()))
        if shape != wanted:
            raise UserError(
                f"Noise is {type(given).__name__} {shape}; {steps} evaluations of {len(frames)} frames take "
                f"{wanted}: let the generator's noise() make it."
            )
        return Reported(*(made.reshape(depth_m.shape) for made in self._run(frames, given, steps)))

    def noise(self, count: int, *, seed: int = 0, device: str = "") -> "EpisodeNoise":
        """Noise of `count` cameras that run side by side, for a call per frame.

        Args:
          count: cameras, or environments.
          seed: of the noise.
          device: PyTorch's name of a device, for tensors there; empty makes NumPy arrays.

        Raises:
          UserError: no whole number of cameras, or no seed.
        """
        check_count("count", count, 1)
        check_count("seed", seed, 0)
        return EpisodeNoise(self.info, count, _Normals(seed, device))

    # --- checks ------------------------------------------------------------------------------------

    def _checked_steps(self, steps: int | None) -> int:
        if steps is None:
            return self.info.steps
        check_count("steps", steps, 1)
        least = self.info.steps if self.info.fixed_steps else 1
        if not least <= steps <= self.info.most_steps:
            raise UserError(f"steps is {steps}; {self.path} takes {least} to {self.info.most_steps}.")
        return steps

    def check_shape(self, height_px: int, width_px: int, count: int = 1) -> None:
        """UserError unless the generator takes `count` frames of that size."""
        shape, tolerance = self.info.width_px / self.info.height_px, names.ASPECT_TOLERANCE
        if not (height_px and width_px and count) or abs(width_px / height_px / shape - 1) > tolerance:
            raise UserError(
                f"Depth is {count} frames of {width_px}x{height_px}; {self.path} takes the shape of "
                f"{self.info.width_px}x{self.info.height_px}: render with that aspect ratio, or crop."
            )

    def _check(self, frames: Array) -> None:
        count, height, width = frames.shape
        self.check_shape(height, width, count)
        low, high = float(frames.min()), float(frames.max())
        if not (low >= 0 and high <= names.FARTHEST_SANE_M):  # neither is so for NaN
            raise UserError(
                f"Depth reaches from {low:g} to {high:g}; expected finite metres, 0 where nothing is in "
                "range (put 0 for infinity and NaN; divide millimetres by 1000)."
            )
        self._warn_once(frames)

    def _warn_once(self, frames: Array) -> None:
        """Says so in the first call if most of the scene is where the camera had no readings."""
        near_m, far_m = (self.info.camera.get(name) for name in ("near_m", "far_m"))
        if self._looked or near_m is None or far_m is None:
            return
        self._looked = True
        seen = int((frames > 0).sum())
        outside = seen - int(((frames >= near_m) & (frames <= far_m)).sum())
        if 2 * outside > seen:
            warnings.warn(
                f"{outside / seen:.0%} of the depth lies outside of the {near_m:g} to {far_m:g} m of "
                f"readings that {self.path} was fitted on: what it draws there, it has not seen.",
                stacklevel=4,
            )

    # --- running -----------------------------------------------------------------------------------

    def _drawn(self, frames: Array, steps: int) -> Array:
        device = "" if isinstance(frames, np.ndarray) else str(frames.device)
        if device not in self._normals:
            self._normals[device] = _Normals(self._seed, device)
        shape = (len(frames), self.info.planes(steps), self.info.height_px, self.info.width_px)
        return self._normals[device].draw(shape)

    def _feed(self, depth: Array, noise: Array, steps: int) -> dict[str, Array]:
        given = {names.INPUT_DEPTH: depth, names.INPUT_NOISE: noise}
        return given if self.info.fixed_steps else given | {names.INPUT_STEPS: np.array(steps, np.int64)}

    def _run(self, frames: Array, noise: Array, steps: int) -> Sequence[Array]:
        host = isinstance(frames, np.ndarray)
        run, join = (
            (self._run_numpy, np.concatenate)
            if host
            else (self._run_torch, importlib.import_module("torch").cat)
        )
        cuts = [slice(at, at + self._batch) for at in range(0, len(frames), self._batch)]
        parts = [run(frames[cut], noise[cut], steps) for cut in cuts]
        return parts[0] if len(parts) == 1 else [join(made) for made in zip(*parts, strict=True)]

    def _run_numpy(self, frames: np.ndarray, noise: Array, steps: int) -> Sequence[np.ndarray]:
        depth, normal = (np.ascontiguousarray(_host(values), np.float32) for values in (frames, noise))
        made = self._session.run(list(_OUTPUTS), self._feed(depth, normal, steps))
        return [np.asarray(one) for one in made]

    def _run_torch(self, frames: Array, noise: Array, steps: int) -> Sequence[Array]:
        """Inputs and outputs stay where the network runs; tensors elsewhere are copied there and back."""
        torch = importlib.import_module("torch")
        here = torch.device("cpu") if self._kind == "cpu" else torch.device(self._kind, self._device_number)
        binding, kept = self._session.io_binding(), []
        for name, value in self._feed(frames, noise, steps).items():
            if name == names.INPUT_STEPS:
                binding.bind_cpu_input(name, value)
                continue
            tensor = torch.as_tensor(value).to(device=here, dtype=torch.float32).contiguous()
            kept.append(tensor)  # the binding knows only where it lies
            where = (tuple(tensor.shape), tensor.data_ptr())
            binding.bind_input(name, self._kind, self._device_number, np.float32, *where)
        made = []
        for name, kind in _OUTPUTS.items():
            kind_there = torch.bool if kind is np.bool_ else torch.float32
            made.append(torch.empty(tuple(frames.shape), dtype=kind_there, device=here))
            where = (tuple(frames.shape), made[-1].data_ptr())
            binding.bind_output(name, self._kind, self._device_number, kind, *where)
        if here.type != "cpu":
            torch.cuda.current_stream(here).synchronize()  # what writes the inputs has to have ended
        self._session.run_with_iobinding(binding)
        binding.synchronize_outputs()
        return [tensor.to(frames.device) for tensor in made]


class EpisodeNoise:
    """Noise of cameras side by side: sqrt(r) of an episode's own + sqrt(1 - r) of each frame's.

    r is what the generator was set to; by it holes stay where they are between frames, as on a camera.
    """

    def __init__(self, info: names.GeneratorMetadata, count: int, normals: "_Normals"):
        self._info, self._count, self._normals = info, count, normals
        self._shared: Array | None = None
        self._steps = 0

    def next(self, steps: int | None = None) -> Array:
        """(count, P, h, w) for the next frame of every camera. `steps` stays the first one's."""
        steps = self._info.steps if steps is None else steps
        check_count("steps", steps, 1)
        if self._shared is None:
            self._steps = steps
            self._shared = self._normals.draw(self._shape(self._count))
        if steps != self._steps:
            raise UserError(f"steps is {steps}; this noise was begun with {self._steps}: make another one.")
        share = self._correlations()
        root, rest = (self._normals.array(np.sqrt(part)) for part in (share, 1 - share))
        return root * self._shared + rest * self._normals.draw(self._shape(self._count))

    def reset(self, cameras: Sequence[int] | Sequence[bool] | None = None) -> None:
        """Begins new episodes, of the given cameras or of all: their numbers, or a mask of all of them.

        UserError for what is neither.
        """
        if self._shared is None:
            return
        try:
            chosen = list(range(self._count)) if cameras is None else self._numbers(cameras)
        except (TypeError, ValueError):
            raise UserError(
                f"Cameras {cameras!r} are to be reset; expected numbers, as in [0, 2], or a mask of "
                f"{self._count}."
            ) from None
        if not all(0 <= number < self._count for number in chosen):
            raise UserError(f"Cameras {chosen} are to be reset; there are 0 to {self._count - 1}.")
        if chosen:
            self._shared[chosen] = self._normals.draw(self._shape(len(chosen)))

    def _numbers(self, cameras: Sequence[int] | Sequence[bool]) -> list[int]:
        given = getattr(cameras, "tolist", lambda: list(cameras))()  # tensors of any device, too
        kinds = {isinstance(number, bool | np.bool_) for number in given}
        if True not in kinds:
            return [int(number) for number in given]
        if False in kinds or len(given) != self._count:
            raise ValueError
        return [number for number, done in enumerate(given) if done]

    def _shape(self, count: int) -> tuple[int, ...]:
        return (count, self._info.planes(self._steps), self._info.height_px, self._info.width_px)

    def _correlations(self) -> np.ndarray:
        """(P, 1, 1): that of deviations where a plane is theirs, else that of holes."""
        share = np.full(self._info.planes(self._steps), self._info.frame_correlation, np.float32)
        if self._info.channels == 2:
            share[2::2] = self._info.deviation_correlation
        return share[:, None, None]


class _Normals:
    """Standard normal float32 numbers: NumPy's or, with the name of a device, PyTorch's there."""

    def __init__(self, seed: int, device: str):
        self._device = device
        if device:
            self._torch = importlib.import_module("torch")
            self._source = self._torch.Generator(device=device).manual_seed(seed)
        else:
            self._rng = np.random.default_rng(seed)

    def draw(self, shape: tuple[int, ...]) -> Array:
        if self._device:
            return self._torch.randn(shape, generator=self._source, device=self._device)
        return self._rng.standard_normal(shape, dtype=np.float32)

    def array(self, values: np.ndarray) -> Array:
        return self._torch.as_tensor(values, device=self._device) if self._device else values


def check_count(name: str, value: Any, least: int) -> None:
    """UserError if `value` is no whole number from `least` on."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise UserError(f"{name} is {value!r}; expected a whole number of at least {least}.")


def _frames(depth: Array) -> Array:
    """(N, H, W) of what came in; UserError for another rank or integers."""
    shape: tuple[int, ...] = tuple(getattr(depth, "shape", ()))
    if isinstance(depth, np.ndarray):
        floating = depth.dtype.kind == "f"
    else:
        floating = hasattr(depth, "is_floating_point") and depth.is_floating_point()
    if floating and len(shape) == 4 and 1 in (shape[1], shape[3]):
        return depth.reshape(shape[0], *(shape[2:] if shape[1] == 1 else shape[1:3]))
    if not floating or len(shape) != 3:
        raise UserError(
            f"Depth is {getattr(depth, 'dtype', type(depth).__name__)} {shape}; expected (N, H, W), "
            "(N, 1, H, W) or (N, H, W, 1) floating-point metres, NumPy or PyTorch (divide millimetres by "
            "1000)."
        )
    return depth


def _host(values: Array) -> np.ndarray:
    return values if isinstance(values, np.ndarray) else values.detach().cpu().numpy()


def _device(name: str) -> tuple[str, int]:
    """(cpu or cuda, number) of `cpu`, `cuda`, `cuda:1`; UserError for another name."""
    kind, _, number = str(name).partition(":")
    if kind not in ("cpu", "cuda") or (number and not number.isdecimal()):
        raise UserError(f"device is {name!r}; expected cpu, cuda or cuda:1.")
    return kind, int(number or 0)


def _open(path: Path, kind: str, number: int, threads: int) -> ort.InferenceSession:
    if path.is_dir():
        raise UserError(f"{path} is a folder: give the file, {path / 'generator.onnx'} if it is there.")
    if not path.is_file():
        raise UserError(f"{path}: no such file; {names.REMEDY}.")
    providers: list[Any] = ["CPUExecutionProvider"]
    if kind == "cuda":
        providers.insert(0, ("CUDAExecutionProvider", {"device_id": number}))
    if kind == "cuda" and "CUDAExecutionProvider" not in ort.get_available_providers():
        raise UserError("device is cuda, which this onnxruntime does not have: install onnxruntime-gpu.")
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = ort.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime raises classes of its own, without a common base
        reason = str(error).splitlines()[0]
        raise UserError(f"{path}: onnxruntime cannot load it ({reason}); {names.REMEDY}.") from error
    if kind == "cuda" and "CUDAExecutionProvider" not in session.get_providers():
        raise UserError(
            "device is cuda, which onnxruntime could not load (its warning above says why): install the CUDA "
            "and cuDNN that this onnxruntime-gpu was built for, or take device cpu."
        )
    return session
