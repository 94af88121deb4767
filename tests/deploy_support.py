"""Real, tiny policy files and devices for the tests of the robot side."""

import dataclasses
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from ddgrasp import contract
from ddgrasp import policy_metadata as metadata
from ddgrasp.config import ExportConfig, HeadConfig, StudentConfig
from deploy.interfaces import CameraError, Clock, Frame, RobotState

PROFILE = contract.D455.scaled(1 / 80)
"""16 x 9 pixels."""
SHAPE = (PROFILE.height_px, PROFILE.width_px)
HOME_RAD = np.array(contract.HOME_RAD)


def describe(
    depth_dtype: str = "uint16_mm",
    chunk: int = 4,
    execute_steps: int = 1,
    profile: contract.CameraProfile = PROFILE,
    **changes,
):
    """Metadata of a policy for `profile`."""
    described = metadata.describe(
        StudentConfig(
            head=HeadConfig(chunk=chunk, execute_steps=execute_steps, closing_steps=0),
        ),
        ExportConfig(depth_dtype=depth_dtype),
        profile,
    )
    return dataclasses.replace(described, **changes)


def write_policy(
    path: Path,
    info: metadata.PolicyMetadata | None = None,
    *,
    depth_gain: np.ndarray | None = None,
    state_gain: np.ndarray | None = None,
    noise_gain: float = 0.0,
    bias: np.ndarray | None = None,
    properties: dict[str, str] | None = None,
) -> Path:
    """An affine policy: action = d @ depth_gain + state @ state_gain + bias + noise_gain * noise.

    d (3,) is the top left pixel of the three frames in the input's own unit; depth_gain (3, chunk, 8),
    state_gain (9, chunk, 8), bias (chunk, 8).
    """
    info = describe() if info is None else info
    chunk = info.chunk
    weights = {
        "Wd": np.zeros((3, chunk, 8)) if depth_gain is None else depth_gain,
        "Ws": np.zeros((9, chunk, 8)) if state_gain is None else state_gain,
    }
    constants = {name: np.reshape(w, (len(w), -1)).astype(np.float32) for name, w in weights.items()}
    constants["bias"] = np.broadcast_to(0.0 if bias is None else bias, (chunk, 8)).astype(np.float32)
    constants["gain"] = np.float32(noise_gain)
    constants["corner"] = np.zeros(1, np.int64)
    constants["shape"] = np.array([-1, chunk, 8], np.int64)
    constants["flat"] = np.array([0, 3], np.int64)
    nodes = [
        helper.make_node("Cast", ["depth"], ["depth_f"], to=TensorProto.FLOAT),
        helper.make_node("Gather", ["depth_f", "corner"], ["row"], axis=2),
        helper.make_node("Gather", ["row", "corner"], ["pixel"], axis=3),
        helper.make_node("Reshape", ["pixel", "flat"], ["d"]),
        helper.make_node("MatMul", ["d", "Wd"], ["from_depth"]),
        helper.make_node("MatMul", ["state", "Ws"], ["from_state"]),
        helper.make_node("Add", ["from_depth", "from_state"], ["sum"]),
        helper.make_node("Reshape", ["sum", "shape"], ["chunks"]),
        helper.make_node("Add", ["chunks", "bias"], ["biased"]),
        helper.make_node("Mul", ["noise", "gain"], ["drawn"]),
        helper.make_node("Add", ["biased", "drawn"], ["action"]),
    ]
    depth_type = TensorProto.UINT16 if info.depth_dtype == "uint16_mm" else TensorProto.FLOAT
    inputs = [
        helper.make_tensor_value_info("depth", depth_type, ["B", 3, info.depth_height, info.depth_width]),
        helper.make_tensor_value_info("state", TensorProto.FLOAT, ["B", 9]),
        helper.make_tensor_value_info("noise", TensorProto.FLOAT, ["B", chunk, 8]),
    ]
    output = helper.make_tensor_value_info("action", TensorProto.FLOAT, ["B", chunk, 8])
    graph = helper.make_graph(
        nodes, "affine", inputs, [output], [numpy_helper.from_array(v, k) for k, v in constants.items()]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    helper.set_model_props(model, {"ddgrasp": info.to_json()} if properties is None else properties)
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path


def constant_bias(joint_step: float, gripper: float = -1.0, chunk: int = 4) -> np.ndarray:
    """(chunk, 8): joint 1 moves by `joint_step` (of the action scale) in every step."""
    bias = np.zeros((chunk, 8))
    bias[:, 0], bias[:, 7] = joint_step, gripper
    return bias


class KinematicRobot:
    """An arm without inertia: it is where it was told to be."""

    def __init__(self, clock: Clock, q_rad: np.ndarray = HOME_RAD):
        self._clock = clock
        self.q_rad = q_rad.copy()
        self.close = False
        self.calls: list[str] = []
        self.read_takes_s = 0.0

    def start(self) -> None:
        self.calls.append("start")

    def read_state(self) -> RobotState:
        if self.read_takes_s:
            self._clock.sleep_until(self._clock.now() + self.read_takes_s)
        return RobotState(self.q_rad.copy(), 0.0 if self.close else 0.08, self._clock.now())

    def command(self, q_target_rad: np.ndarray, close: bool) -> None:
        self.q_rad, self.close = q_target_rad.copy(), close
        self.calls.append("command")

    def hold(self) -> None:
        self.calls.append("hold")

    def stop(self) -> None:
        self.calls.append("stop")


class ScriptedCamera:
    """Shows one entry per read: a depth picture, an age in seconds with it, "repeat" or "unplugged"."""

    def __init__(self, clock: Clock, script: list):
        self._clock, self._script, self._index = clock, script, -1
        self._frame: Frame | None = None
        self.stopped = False

    def start(self) -> None:
        pass

    def read(self) -> Frame:
        self._index += 1
        entry = self._script[min(self._index, len(self._script) - 1)]
        if isinstance(entry, str) and entry == "unplugged":
            raise CameraError("unplugged")
        if isinstance(entry, str):
            assert self._frame is not None
            return self._frame
        depth, age_s = entry if isinstance(entry, tuple) else (entry, 0.0)
        self._frame = Frame(depth, self._clock.now() - age_s)
        return self._frame

    def stop(self) -> None:
        self.stopped = True


def depth_mm(value: int = 700) -> np.ndarray:
    """A flat wall at `value` millimetres."""
    return np.full(SHAPE, value, np.uint16)
