"""Configurations as earlier versions of this project wrote them, made readable: fields renamed or dropped.

Manifests, and the notes of unfinished stages (started.json), carry the whole configuration as JSON and the
version of its fields. Whoever changes a field raises VERSION and adds what moved to the tables below.
"""

import copy
from collections.abc import Iterable, Mapping
from typing import Any

VERSION = 18
"""Format of the fields this code writes. 1: flat sections ddg, student, deploy; without a number. 2: teachers
that start from `init_from`, else from the guide after `clone_rounds` of cloning, else from nothing. 3: the
generator knows no window. 4: a student's closing is not latched. 5: training knows no noise at
edges. 6: demos are trained on from their beginning. 7: a student leaves holes as they are. 8: a
generator does not know where in the picture it is. 9: the policy alone acts in the loop. 10: a Franka's hand
comes down at any speed; what was made then comes down slowly too, since no run has an arm. 11: a Franka
gives way to nothing before it stops itself; the same. 12: formulas have one strength. 13: what comes behind
a teacher's time limit counts. 14: a window is a Gaussian. 15: the rig has one table.
16: no ellipses are dropped. 17: formulas move nothing along normals."""

VERSION_FIELD = "manifest_version"


def _same(*names: str) -> dict[str, str]:
    return {name: name for name in names}


_GROUPS_OF_2: dict[str, dict[str, dict[str, str]]] = {
    "ddg": {
        "depth": _same("representation", "height_px", "width_px", "near_m", "far_m", "surface"),
        "graft": _same("noise_threshold", "deviation_threshold"),
        "prior": _same("decoy_holes") | {
            "source": "prior", "weights": "prior_weights", "in_sim": "prior_in_sim",
            "input_px": "prior_input_px", "dtype": "prior_dtype", "blur_px": "prior_blur_px",
            "noise": "prior_noise", "jitter": "prior_jitter",
        },
        "unet": _same("space_to_depth", "widths", "blocks", "attention_heads"),
        "diffusion": _same("schedule", "log_snr_shift") | {"steps": "diffusion_steps"},
        "training": _same(
            "batch_size", "learning_rate", "weight_decay", "hole_loss", "loss_weight", "snr_limits",
            "ema_decay", "checkpoint_every", "holdout_fraction", "distil_from", "distil_steps",
        ) | {"steps": "train_steps"},
        "sampling": _same("sampler", "eta", "frame_correlation", "deviation_correlation") | {
            "steps": "sample_steps", "spacing": "sample_spacing", "batch_size": "sample_batch",
        },
    },
    "student": {
        "picture": _same("channels", "min_depth_m", "max_depth_m") | {
            "height_px": "input_height_px", "width_px": "input_width_px",
        },
        "encoder": _same(
            "stem", "width", "stage_blocks", "max_channels", "output_stride", "norm", "pooling", "keypoints",
        ) | {"features": "feature_size", "weights": "encoder_weights"},
        "hand_view": {
            "size_px": "hand_view_px", "pitch_m": "hand_view_pitch_m", "width": "hand_view_width",
            "blocks": "hand_view_blocks", "channels": "hand_view_channels", "features": "hand_view_features",
        },
        "head": _same(
            "features_to_head", "aux_to_head", "chunk", "execute_steps", "state_features", "conditioning",
            "time_features", "diffusion_steps", "ddim_steps",
        ) | {
            "width": "denoiser_width", "blocks": "denoiser_blocks", "train_steps": "head_steps",
            "batch_size": "head_batch_size",
        },
        "training": _same(
            "batch_size", "noise_draws", "learning_rate", "weight_decay", "ema_decay", "aux_weight",
            "action_weight", "held_weight", "demo_held_steps", "clean_share", "crop_shift_px",
            "disparity_noise_px",
        ) | {"steps": "train_steps"},
        "poses": {"rounds": "pose_rounds", "episodes": "pose_episodes", "steps": "pose_steps"},
        "dagger": {
            "rounds": "dagger_rounds", "episodes": "dagger_episodes", "steps": "dagger_steps",
            "teacher_share": "dagger_teacher_share",
        },
    },
    "deploy": {
        "franka": {
            "host": "franka_host", "dynamics": "franka_dynamics", "grip_force_n": "franka_grip_force_n",
        },
        "realsense": {"serial": "realsense_serial"},
    },
}  # fmt: skip
"""Section -> group -> field -> the field's name in version 1, in the section itself."""

_DROPPED_AFTER_1 = {"world.random.crop_px": 24}
"""Fields of version 1 that version 2 lacks, with the value that they had."""

_ADDED_AFTER: dict[int, dict[str, Any]] = {
    1: {"student.depth_source": "learned"},
    2: {
        "scale": 1.0,
        "world.renderer": "jax",
        "deploy.clock": "machine",
        "deploy.arm_lower_m": [-0.55, -0.80, 0.0],
        "deploy.arm_upper_m": [0.95, 0.80, 1.30],
        "deploy.franka.model": "fr3",
        "deploy.franka.kernel": "realtime",
        "deploy.franka.start_dynamics": 0.05,
        "deploy.franka.contact_torque_nm": 20.0,
        "deploy.franka.contact_force_n": 30.0,
        "deploy.franka.load_kg": 0.0,
        "deploy.franka.stiffness_nm_rad": 400.0,
        "world.random.pregrasp_turn_rad": 0.0,
        "world.random.held_share": 0.0,
        "world.reward.distance": "funnel",
        "world.reward.grasp_switch": "touch",
        "teacher.target_kl": 0.0,
        "teacher.gripper_std": 0.15,
        "teacher.min_std": 0.01,
        "teacher.pregrasp_turn_rad": 0.0,
        "teacher.held_share": 0.0,
        "teacher.settle_from": 1.0,
    },
    3: {"ddg.graft.window_px": 0.0},
    4: {"student.head.closing_steps": 0, "student.training.unseen_share": 0.0},
    5: {"student.training.edge_noise_px": 0.0},
    6: {"student.training.demo_stretch_steps": 0},
    7: {"student.picture.fill_holes": False},
    8: {"ddg.unet.position": False},
    9: {"deploy.retry": False},
    10: {"deploy.franka.approach_m_s": 0.06, "deploy.franka.approach_below_m": 0.16},
    11: {"deploy.franka.give_way": 0.5},
    12: {"student.dextrah_scale": 1.0},
    13: {"teacher.bootstrap_time_limit": True},
    14: {"ddg.graft.window_shape": "gaussian"},
    15: {"record.other_tables": False},
    16: {"student.ellipse_dropout": 0.0, "student.ellipse_half_axis_px": 25.0},
    17: {"student.dextrah_normal_m": 0.0},
}
"""Version -> the fields that it lacked and the next one has, with what it did (10, 11: what is done now)."""

_CLONE_ROUNDS = 8
"""What stands in a configuration that does not clone: version 2 wrote 0."""


def upgraded(config: Mapping[str, Any], version: int) -> dict[str, Any]:
    """The JSON of a configuration of an earlier version with the fields of this one.

    Other fields that it lacks stay away, and fields that no version knows stay where they are.
    """
    made = copy.deepcopy(dict(config))
    if version < 2:
        _drop(made, _DROPPED_AFTER_1)
        _add(made, _ADDED_AFTER[1])
        for section, groups in _GROUPS_OF_2.items():
            if section in made:
                made[section] = _grouped(made[section], groups)
        _trim_picture(made.get("student", {}).get("picture", {}))
    for lacking in range(max(version, 2), VERSION):
        _add(made, _ADDED_AFTER[lacking])
    if version < 3 and "teacher" in made:
        _name_start(made["teacher"])
    return made


def without(config: Mapping[str, Any], version: int) -> dict[str, Any] | None:
    """The JSON of a configuration of today without what `version`, 2 or later, lacked; None where it has a
    value that could not be had then. Names that moved stay today's."""
    made = copy.deepcopy(dict(config))
    for lacking in range(version, VERSION):
        for name, value in _ADDED_AFTER[lacking].items():
            section, field = _section_of(made, name)
            if section.pop(field, value) != value:
                return None
    return made


def _name_start(teacher: dict[str, Any]) -> None:
    """Version 2 said by two fields what a policy starts from."""
    source, rounds = teacher.pop("init_from", ""), teacher.get("clone_rounds", _CLONE_ROUNDS)
    teacher["start"] = source or ("guide" if rounds else "nothing")
    if not rounds:
        teacher["clone_rounds"] = _CLONE_ROUNDS


def _add(config: dict[str, Any], added: Mapping[str, Any]) -> None:
    for name, value in added.items():
        section, field = _section_of(config, name)
        section.setdefault(field, value)


def _drop(config: dict[str, Any], names: Iterable[str]) -> None:
    for name in names:
        section, field = _section_of(config, name)
        section.pop(field, None)


def _grouped(flat: Mapping[str, Any], groups: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
    """A flat section with its fields in groups."""
    moved = {old for fields in groups.values() for old in fields.values()}
    kept = {name: value for name, value in flat.items() if name not in moved}
    made = {
        group: {new: flat[old] for new, old in fields.items() if old in flat}
        for group, fields in groups.items()
    }
    return kept | {group: fields for group, fields in made.items() if fields}


def _trim_picture(picture: dict[str, Any]) -> None:
    """Version 1 took any size and then refused to build the student's encoder, which needs multiples of 4."""
    for name in picture.keys() & {"height_px", "width_px"}:
        picture[name] -= picture[name] % 4


def _section_of(config: dict[str, Any], name: str) -> tuple[dict[str, Any], str]:
    """The section that holds the dotted field `name`, empty if there is none, and the field's own name."""
    *sections, field = name.split(".")
    for section in sections:
        config = config.get(section, {})
    return config, field
