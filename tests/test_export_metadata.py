"""Metadata of exported policies: what is written, and one-line errors for what is not ours. No JAX."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest

from ddgrasp import contract
from ddgrasp import policy_metadata as metadata
from ddgrasp.config import ExportConfig, StudentConfig, WorldConfig
from ddgrasp.errors import UserError

PROFILE = WorldConfig().profile
GOOD = metadata.describe(StudentConfig(), ExportConfig(), PROFILE, student_manifest_hash="abc")


def properties(**changes) -> dict[str, str]:
    return {contract.ONNX_METADATA_KEY: json.dumps(json.loads(GOOD.to_json()) | changes)}


def with_camera(**changes) -> dict[str, dict]:
    return {"camera": GOOD.camera | changes}


def test_what_is_written_is_read_back():
    read = metadata.validate(properties())
    assert read.joint_names == contract.ARM_JOINTS
    assert (read.depth_height, read.depth_width, read.depth_frames) == (180, 320, 3)
    assert read.crop == {"row": 34, "column": 87, "height": 112, "width": 145}
    assert read.camera["position"] == list(contract.CAMERA_POSITION_M)
    assert read.student_manifest_hash == "abc"
    assert read.to_json() == GOOD.to_json()


@pytest.mark.parametrize("scale", [*(n / 200 for n in range(20, 201)), 1 / 3, 5 / 32])
def test_a_policy_s_camera_is_the_one_of_its_training_at_every_scale(scale):
    profile = contract.D455.scaled(scale)
    described = metadata.describe(StudentConfig(), ExportConfig(), profile)
    read = metadata.validate({contract.ONNX_METADATA_KEY: described.to_json()})
    assert (read.depth_height, read.depth_width) == (read.profile.height_px, read.profile.width_px)
    assert read.profile.fx_px == pytest.approx(profile.fx_px)


def test_a_file_of_before_does_not_latch_a_closing():
    described = json.loads(GOOD.to_json())
    assert described.pop("closing_steps") == 8
    assert metadata.validate({contract.ONNX_METADATA_KEY: json.dumps(described)}).closing_steps == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contract_version": 99}, "contract version 99, this code has 1: export it again"),
        ({"depth_dtype": "uint8"}, "depth_dtype is 'uint8', expected one of uint16_mm, float32_m"),
        ({"depth_height": "180"}, "depth_height is '180', expected a positive integer"),
        ({"execute_steps": 5, "chunk": 4}, "execute_steps is 5, more than the chunk of 4"),
        ({"control_hz": 30.0}, "control_hz is 30.0, this code expects 10.0"),
        ({"action_scale_rad": -0.1}, "action_scale_rad is -0.1, this code expects 0.1"),
        ({"joint_names": ["a"]}, "joint_names"),
        ({"camera": {"fx": "640"}}, "camera's fx is '640', expected pixels"),
        ({"camera": None}, "camera's fx is None, expected pixels"),
        (with_camera(fx=10**400), r"camera's fx is 10+\.\.\.0+, expected pixels"),
        (with_camera(fx=sys.float_info.max), r"camera's fx is 1.79\S+, expected pixels"),
        (with_camera(fx=float("nan")), r"camera's fx is nan, expected pixels"),
        (with_camera(position="abc"), "camera's position is 'abc', expected 3 numbers"),
        (with_camera(position=None), "camera's position is None, expected 3 numbers"),
        (with_camera(position=[0.0, 0.0]), r"camera's position is \[0.0, 0.0\], expected 3 numbers"),
        (
            with_camera(position=[0.0, float("nan"), 0.0]),
            r"position is \[0.0, nan, 0.0\], expected 3 numbers",
        ),
        (with_camera(look_at=[0.0, "1", None]), r"camera's look_at is \[.*\], expected 3 numbers"),
        (
            with_camera(look_at=[0, 0, 10**400]),
            r"camera's look_at is \[0, 0, 10+\.\.\.0+\], expected 3 numbers",
        ),
        (with_camera(look_at=[0, 0, 1e300]), "expected 3 numbers, metres up to 100"),
        (with_camera(look_at=contract.CAMERA_POSITION_M), "camera's look_at is its position"),
        ({"joint_upper_rad": (*GOOD.joint_upper_rad[:6], 10**400)}, "expected 7 numbers"),
        ({"joint_upper_rad": (*GOOD.joint_upper_rad[:6], float("inf"))}, "expected 7 numbers"),
        ({"closing_steps": -1}, "closing_steps is -1, expected 0 or more"),
        ({"joint_lower_rad": None}, "joint_lower_rad is None, expected 7 numbers"),
        ({"joint_lower_rad": GOOD.joint_lower_rad[:6]}, r"joint_lower_rad is \(.*\), expected 7 numbers"),
        ({"joint_upper_rad": (*GOOD.joint_upper_rad[:6], "3")}, "expected 7 numbers"),
        (
            {"joint_lower_rad": GOOD.joint_upper_rad, "joint_upper_rad": GOOD.joint_lower_rad},
            r"may be at 2\.\d+ to -2\.\d+ rad, and starts at 0",
        ),
        ({"joint_lower_rad": 7 * (0.5,)}, r"may be at 0\.5 to 2\.\d+ rad, and starts at 0"),
        ({"depth_width": 640}, "is of 320x180 pixels, its depth has 640x180"),
    ],
)
def test_contradictions_are_one_line_errors(changes, message):
    with pytest.raises(UserError, match=message) as caught:
        metadata.validate(properties(**changes), "policy.onnx")
    assert "policy.onnx" in str(caught.value) and "\n" not in str(caught.value)


def test_files_of_others_and_damaged_ones():
    with pytest.raises(UserError, match="yolo.onnx has no 'ddgrasp' metadata"):
        metadata.validate({"author": "someone"}, "yolo.onnx")
    with pytest.raises(UserError, match="damaged metadata"):
        metadata.validate({contract.ONNX_METADATA_KEY: "{"})
    deep = f'{{"joint_names": {"[" * 700}{"]" * 700}}}'
    for text in ("[" * 100_000, "1" * 5000, deep):
        with pytest.raises(UserError, match="damaged metadata") as caught:
            metadata.validate({contract.ONNX_METADATA_KEY: text})
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 300
    with pytest.raises(UserError, match="expected a JSON object"):
        metadata.validate({contract.ONNX_METADATA_KEY: "[]"})
    short = dataclasses.asdict(GOOD)
    del short["chunk"]
    with pytest.raises(UserError, match="metadata without 'chunk'"):
        metadata.validate({contract.ONNX_METADATA_KEY: json.dumps(short)})


def test_a_file_that_does_not_say_where_its_camera_stood_is_read():
    camera = {name: GOOD.camera[name] for name in ("fx", "fy", "cx", "cy")}
    assert metadata.validate(properties(camera=camera)).camera == camera


def test_graph_shapes_must_be_those_promised():
    shapes = {
        "depth": ["batch", 3, 180, 320], "state": ["batch", 9],
        "noise": ["batch", GOOD.chunk, 8], "action": ["batch", GOOD.chunk, 8],
    }  # fmt: skip
    metadata.validate_shapes(GOOD, shapes)
    with pytest.raises(UserError, match="'depth' has shape"):
        metadata.validate_shapes(GOOD, shapes | {"depth": ["batch", 3, 90, 160]})
    del shapes["noise"]
    with pytest.raises(UserError, match="no input or output 'noise'"):
        metadata.validate_shapes(GOOD, shapes)


def test_reading_metadata_needs_neither_jax_nor_onnx():
    code = "import sys, ddgrasp.policy_metadata; print(sorted({'jax', 'onnx', 'flax'} & set(sys.modules)))"
    root = Path(__file__).parents[1]
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert out.stdout.strip() == "[]"
