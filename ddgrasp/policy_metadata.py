"""What an exported policy says about itself, written by export and checked by deploy. No JAX, no ONNX."""

import dataclasses
import json
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ddgrasp import contract
from ddgrasp.config import DEPTH_DTYPES, Config, ExportConfig, StudentConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.errors import UserError
from ddgrasp.files import DAMAGED_JSON, is_number, to_tuples

POLICY_FILE = "policy.onnx"
"""As the stage `export` names it."""
STATE_LAYOUT = "q7 rad + gripper width m + its change since the control step before m"
REMEDY = "make one with `ddgrasp export`"
_DIGITS = 12
"""Digits of a camera's scale: a quotient one unit in its last place off could round a side otherwise."""
_LARGEST_FX_PX, _FURTHEST_M = 1e6, 100.0
"""Beyond what any camera has, and any table."""


@dataclass(frozen=True)
class PolicyMetadata:
    """Contents of metadata_props["ddgrasp"]."""

    contract_version: int
    project_version: str
    joint_names: tuple[str, ...]
    action_scale_rad: float
    """s in q_target = q + s * action[:7]."""
    control_hz: float
    depth_frames: int
    depth_height: int
    """Rows of a raw frame."""
    depth_width: int
    """Columns of a raw frame."""
    depth_dtype: str
    """uint16_mm or float32_m."""
    chunk: int
    """Actions predicted at once."""
    execute_steps: int
    """Actions to execute before the next inference."""
    ddim_steps: int
    joint_lower_rad: tuple[float, ...]
    joint_upper_rad: tuple[float, ...]
    state: str
    crop: dict[str, int]
    """row, column, height, width of the centred window, in pixels of the raw frame."""
    camera: dict[str, Any]
    """fx, fy, cx, cy (pixels), position, look_at (metres, robot base frame): what training assumed."""
    student_manifest_hash: str
    closing_steps: int = 0
    """Control steps that a closing of the gripper lasts at least, once begun; files of before have none."""

    @property
    def profile(self) -> CameraProfile:
        """The camera of its training: `contract.D455` at the scale of its focal length. Its width alone would
        not do, since both sides are rounded."""
        return contract.D455.scaled(round(self.camera["fx"] / contract.D455.fx_px, _DIGITS))

    def to_json(self) -> str:
        """The value of the metadata property."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)


def describe(
    student: StudentConfig,
    export: ExportConfig,
    profile: CameraProfile,
    *,
    project_version: str = "",
    student_manifest_hash: str = "",
) -> PolicyMetadata:
    """Metadata of the policy that this configuration exports."""
    row, column = profile.crop_origin_px
    return PolicyMetadata(
        contract_version=contract.CONTRACT_VERSION,
        project_version=project_version,
        joint_names=contract.ARM_JOINTS,
        action_scale_rad=contract.ACTION_SCALE_RAD,
        control_hz=contract.CONTROL_HZ,
        depth_frames=contract.DEPTH_FRAMES,
        depth_height=profile.height_px,
        depth_width=profile.width_px,
        depth_dtype=export.depth_dtype,
        chunk=student.head.chunk,
        execute_steps=student.head.execute_steps,
        ddim_steps=export.ddim_steps or student.head.ddim_steps,
        joint_lower_rad=contract.JOINT_LOWER_RAD,
        joint_upper_rad=contract.JOINT_UPPER_RAD,
        state=STATE_LAYOUT,
        crop={
            "row": row,
            "column": column,
            "height": profile.crop_height_px,
            "width": profile.crop_width_px,
        },
        camera={
            "fx": profile.fx_px,
            "fy": profile.fy_px,
            "cx": profile.cx_px,
            "cy": profile.cy_px,
            "position": contract.CAMERA_POSITION_M,
            "look_at": contract.CAMERA_LOOK_AT_M,
        },
        student_manifest_hash=student_manifest_hash,
        closing_steps=student.head.closing_steps,
    )


def describe_run(config: Config, *, project_version: str, student_manifest_hash: str) -> PolicyMetadata:
    """`describe` for a whole run's configuration."""
    return describe(
        config.student,
        config.export,
        config.world.profile,
        project_version=project_version,
        student_manifest_hash=student_manifest_hash,
    )


def validate(properties: Mapping[str, str], source: str = "The ONNX file") -> PolicyMetadata:
    """Reads and checks a file's metadata.

    Args:
        properties: all of the file's metadata_props (onnxruntime: `get_modelmeta().custom_metadata_map`).
        source: the file's name, for messages.

    Raises:
        UserError: not a policy of this project, damaged metadata, another contract version, or values
            that contradict the contract.
    """
    if contract.ONNX_METADATA_KEY not in properties:
        raise UserError(
            f"{source} has no {contract.ONNX_METADATA_KEY!r} metadata, so it is not a policy of this "
            f"project: {REMEDY}."
        )
    raw = _parse(properties[contract.ONNX_METADATA_KEY], source)
    if raw.get("contract_version") != contract.CONTRACT_VERSION:
        raise UserError(
            f"{source} was exported for contract version {raw.get('contract_version')!r}, this code has "
            f"{contract.CONTRACT_VERSION}: export it again."
        )
    fields = dataclasses.fields(PolicyMetadata)
    names = [field.name for field in fields if field.name in raw]
    missing = [
        field.name for field in fields if field.name not in raw and field.default is dataclasses.MISSING
    ]
    if missing:
        raise UserError(f"{source} has metadata without {missing[0]!r}: {REMEDY}.")
    metadata = PolicyMetadata(**{name: raw[name] for name in names})
    _check_values(metadata, source)
    return metadata


def validate_shapes(
    metadata: PolicyMetadata, shapes: Mapping[str, list], source: str = "The ONNX file"
) -> None:
    """UserError unless the graph's inputs and output (name -> shape) are what its metadata promises.

    The batch axis (first) is free; symbolic sizes elsewhere are refused.
    """
    action = [metadata.chunk, contract.ACTION_SIZE]
    expected = {
        contract.ONNX_INPUT_DEPTH: [metadata.depth_frames, metadata.depth_height, metadata.depth_width],
        contract.ONNX_INPUT_STATE: [contract.POLICY_STATE_SIZE],
        contract.ONNX_INPUT_NOISE: action,
        contract.ONNX_OUTPUT_ACTION: action,
    }
    for name, shape in expected.items():
        if name not in shapes:
            raise UserError(f"{source} has no input or output {name!r}: {REMEDY}.")
        if list(shapes[name][1:]) != shape:
            raise UserError(
                f"{source}: {name!r} has shape {list(shapes[name])}, its metadata says "
                f"{['batch', *shape]}: {REMEDY}."
            )


def _parse(text: str, source: str) -> dict[str, Any]:
    """The fields, lists as tuples; UserError for text that has none."""
    try:
        raw = json.loads(text)
        if isinstance(raw, dict):
            return {name: to_tuples(value) for name, value in raw.items()}
    except DAMAGED_JSON as error:
        raise UserError(f"{source} has damaged metadata ({error}): {REMEDY}.") from None
    raise UserError(f"{source} has metadata {text[:40]!r}, expected a JSON object: {REMEDY}.")


def _check_values(metadata: PolicyMetadata, source: str) -> None:
    fixed = {
        "joint_names": contract.ARM_JOINTS,
        "depth_frames": contract.DEPTH_FRAMES,
        "control_hz": contract.CONTROL_HZ,
        "action_scale_rad": contract.ACTION_SCALE_RAD,
        "state": STATE_LAYOUT,
    }
    for name, expected in fixed.items():
        value = getattr(metadata, name)
        if value != expected:
            raise UserError(f"{source}: {name} is {value!r}, this code expects {expected!r}: {REMEDY}.")
    if metadata.depth_dtype not in DEPTH_DTYPES:
        raise UserError(
            f"{source}: depth_dtype is {metadata.depth_dtype!r}, expected one of {', '.join(DEPTH_DTYPES)}."
        )
    sizes = ("depth_height", "depth_width", "chunk", "execute_steps", "ddim_steps")
    for name in sizes:
        value = getattr(metadata, name)
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise UserError(f"{source}: {name} is {value!r}, expected a positive integer: {REMEDY}.")
    focal_px = metadata.camera.get("fx") if isinstance(metadata.camera, dict) else None
    if not is_number(focal_px) or not 0 < focal_px < _LARGEST_FX_PX:
        raise UserError(f"{source}: camera's fx is {reprlib.repr(focal_px)}, expected pixels: {REMEDY}.")
    closing = metadata.closing_steps
    if not isinstance(closing, int) or isinstance(closing, bool) or closing < 0:
        raise UserError(f"{source}: closing_steps is {closing!r}, expected 0 or more: {REMEDY}.")
    _check_limits(metadata, source)
    _check_place(metadata.camera, source)
    seen = metadata.profile
    if (seen.height_px, seen.width_px) != (metadata.depth_height, metadata.depth_width):
        raise UserError(
            f"{source}: camera's fx {focal_px:g} is of {seen.width_px}x{seen.height_px} pixels, its depth "
            f"has {metadata.depth_width}x{metadata.depth_height}: {REMEDY}."
        )
    if metadata.execute_steps > metadata.chunk:
        raise UserError(
            f"{source}: execute_steps is {metadata.execute_steps}, more than the chunk of {metadata.chunk}."
        )


def _check_limits(metadata: PolicyMetadata, source: str) -> None:
    """Limits that the start pose is beyond would have the safety filter drive the arm, whatever is asked."""
    for name in ("joint_lower_rad", "joint_upper_rad"):
        value = getattr(metadata, name)
        if (
            not isinstance(value, tuple)
            or len(value) != len(contract.ARM_JOINTS)
            or not all(map(is_number, value))
        ):
            raise UserError(
                f"{source}: {name} is {value!r}, expected {len(contract.ARM_JOINTS)} numbers: {REMEDY}."
            )
    limits = zip(metadata.joint_lower_rad, contract.HOME_RAD, metadata.joint_upper_rad, strict=True)
    for name, (lower, home, upper) in zip(contract.ARM_JOINTS, limits, strict=True):
        if not lower < home < upper:
            raise UserError(
                f"{source}: {name} may be at {lower:g} to {upper:g} rad, and starts at {home:g}: {REMEDY}."
            )


def _check_place(camera: Mapping[str, Any], source: str) -> None:
    """Where training's camera stood and what it looked at; the contract's where it says nothing."""
    place = {"position": contract.CAMERA_POSITION_M, "look_at": contract.CAMERA_LOOK_AT_M}
    place |= {name: camera[name] for name in place if name in camera}
    for name, point in place.items():
        is_point = isinstance(point, list | tuple) and len(point) == 3 and all(map(is_number, point))
        if not is_point or max(map(abs, point)) > _FURTHEST_M:
            raise UserError(
                f"{source}: camera's {name} is {reprlib.repr(point)}, expected 3 numbers, metres up to "
                f"{_FURTHEST_M:g}: {REMEDY}."
            )
    if list(place["position"]) == list(place["look_at"]):
        raise UserError(f"{source}: camera's look_at is its position, {place['look_at']!r}: {REMEDY}.")
