"""What differs from episode to episode: object, its pose and size, dynamics, joints, camera."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int, PRNGKeyArray, UInt32

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.config import RandomConfig
from ddgrasp.layout import QPOS
from mjx_envs import draws, inverse_kinematics, kinematics, scene
from mjx_envs.object_spec import ObjectModel, slot_layout
from mjx_envs.objects import get_object
from mjx_envs.physics.interface import ModelParams
from mjx_envs.precision import exact

PREGRASP_HEIGHT_M = 0.15

Key = PRNGKeyArray | UInt32[Array, "2"]
Index = Int[AnyArray, ""] | int
Share = Float[AnyArray, ""] | float
Angle = Float[AnyArray, ""] | float


class ObjectTable:
    """The objects' constants as arrays over variants: the objects in the order of `names`, then the other
    rest poses of those that have one."""

    def __init__(self, names: tuple[str, ...]):
        specs = [get_object(name) for name in names]
        self.layout = slot_layout(specs)
        self.rgb = np.stack([spec.slot_rgb(self.layout) for spec in specs])
        turning = [i for i, spec in enumerate(specs) if spec.other_pose is not None]
        self.other_variant = np.arange(len(specs))
        self.other_variant[turning] = len(specs) + np.arange(len(turning))
        specs += [specs[i].in_other_pose() for i in turning]
        self.names, self.variants = tuple(names), tuple(specs)
        models = [spec.model(self.layout) for spec in specs]
        self.model = ObjectModel(*(np.stack(values) for values in zip(*models, strict=True)))
        self.rest_height = np.array([s.rest_height_m for s in specs])
        self.symmetry = np.array([s.grasp_symmetry for s in specs])
        self.log_category = np.log([s.category_id for s in specs])
        self.grasp_offset = np.array([s.grasp_offset_m for s in specs])
        self.half_width = np.array([s.half_width_m() for s in specs])


def sample_variant(key: Key, config: RandomConfig, table: ObjectTable, index: Index) -> Int[Array, ""]:
    """() index into the table's arrays of object `index`, in one of its rest poses."""
    other = jax.random.uniform(key) < config.other_pose_share
    return jnp.where(other, jnp.asarray(table.other_variant)[index], index)


def sample_params(
    key: Key, config: RandomConfig, table: ObjectTable, variant: Index
) -> tuple[ModelParams, Float[Array, ""]]:
    """Model parameters of one episode with `variant` of the table; also the object's size factor ()."""
    keys = jax.random.split(key, 7)
    arm = (scene.N_ARM,)
    drawn = draws.dynamics(
        config,
        draws.Units(
            size=_unit(keys[0]),
            object_mass=_unit(keys[1]),
            object_friction=_unit(keys[2]),
            link_mass=_unit(keys[3], arm),
            damping=_unit(keys[4], arm),
            joint_friction=jax.random.uniform(keys[5], arm),
            stiffness=_unit(keys[6], arm),
        ),
    )
    nominal = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32)[variant], table.model)
    made = nominal.scaled(drawn.size, drawn.object_mass, drawn.object_friction)
    params = ModelParams(
        slot_size=made.slot_size,
        slot_pos=made.slot_pos,
        slot_quat=made.slot_quat,
        object_mass=made.mass_kg,
        object_inertia=made.inertia_kg_m2,
        object_friction=made.friction,
        link_mass_scale=drawn.link_mass,
        joint_damping=drawn.damping * scene.JOINT_DAMPING_NMS_RAD,
        joint_friction=drawn.joint_friction_nm,
        gain_scale=drawn.gain,
    )
    return params, drawn.size


def sample_qpos(key: Key, config: RandomConfig, rest_height_m: Float[Array, ""]) -> Float[Array, "16"]:
    """(16,) initial joints around home, gripper open, object on the table with any yaw."""
    k_joint, k_xy, k_yaw = jax.random.split(key, 3)
    joints, xy = _unit(k_joint, (scene.N_ARM,)), _unit(k_xy, (2,))
    yaw = jax.random.uniform(k_yaw, (), minval=-jnp.pi, maxval=jnp.pi)
    return draws.start_qpos(config, joints, xy, yaw, rest_height_m, jnp)


def maybe_pregrasp(
    key: Key, share: Share, turn_rad: Angle, qpos: Float[Array, "16"], grasp_pos: Float[Array, "3"],
    grasp_quat: Float[Array, "4"],
) -> Float[Array, "16"]:  # fmt: skip
    """qpos (16,) with the hand, in `share` of the episodes, up to PREGRASP_HEIGHT_M above the grasp pose and
    turned from it by up to `turn_rad` about the vertical."""
    k_choice, k_offset, k_turn = jax.random.split(key, 3)
    offset = _unit(k_offset, (3,))
    height = PREGRASP_HEIGHT_M * (0.5 + 0.5 * offset[2])
    target = grasp_pos + jnp.stack([0.005 * offset[0], 0.005 * offset[1], height])
    turn = kinematics.quat_about_z(turn_rad * _unit(k_turn), jnp)
    quat = kinematics.quat_mul(turn, grasp_quat, jnp)
    joints = inverse_kinematics.solve(qpos[QPOS.arm], target, quat)
    chosen = jax.random.uniform(k_choice) < share
    return qpos.at[QPOS.arm].set(jnp.where(chosen, joints, qpos[QPOS.arm]))


def maybe_held(
    key: Key, share: Share, qpos: Float[Array, "16"], grasp_pos: Float[Array, "3"],
    grasp_quat: Float[Array, "4"], half_width_m: Float[Array, ""],
) -> Float[Array, "16"]:  # fmt: skip
    """qpos (16,) with, in `share` of the episodes, the object between the fingers, raised by up to the way to
    the lift target.

    `half_width_m` () is the object's, along the fingers: they start on it, and press if so commanded.
    """
    k_choice, k_height = jax.random.split(key)
    way = contract.LIFT_TARGET_M[2] - qpos[QPOS.object_pos][2]
    up = jnp.array([0.0, 0.0, 1.0]) * way * jax.random.uniform(k_height)
    joints = inverse_kinematics.solve(qpos[QPOS.arm], grasp_pos + up, grasp_quat)
    opening = jnp.minimum(half_width_m, contract.GRIPPER_MAX_WIDTH_M / 2)
    held = qpos.at[QPOS.arm].set(joints).at[QPOS.fingers].set(opening).at[QPOS.object_pos].add(up)
    return jnp.where(jax.random.uniform(k_choice) < share, held, qpos)


@exact
def sample_camera(key: Key, config: RandomConfig, T_world_cam: Float[AnyArray, "4 4"]) -> Float[Array, "4 4"]:
    """(4, 4) the nominal camera pose, moved and turned within the configured range."""
    k_pos, k_rot = jax.random.split(key)
    rx, ry, rz = config.camera_angle_rad * _unit(k_rot, (3,))
    # First-order rotation, made orthonormal: the angles are a few hundredths of a radian.
    turn = jnp.array([1.0, rx / 2, ry / 2, rz / 2])
    turn = turn / jnp.linalg.norm(turn)
    T = jnp.asarray(T_world_cam, jnp.float32)
    return draws.displaced(T, config.camera_position_m * _unit(k_pos, (3,)), turn, jnp)


def _unit(key: jax.Array, shape: tuple[int, ...] = ()) -> jax.Array:
    """Uniform numbers in [-1, 1]."""
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
