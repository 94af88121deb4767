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
from mjx_envs import inverse_kinematics, kinematics, scene
from mjx_envs.objects import get_object, slot_layout
from mjx_envs.physics.interface import ModelParams

PREGRASP_HEIGHT_M = 0.15

Key = PRNGKeyArray | UInt32[Array, "2"]
Index = Int[AnyArray, ""] | int


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
        slots = [spec.slot_arrays(self.layout) for spec in specs]
        self.names = tuple(names)
        self.slot_size = np.stack([s[0] for s in slots])
        self.slot_pos = np.stack([s[1] for s in slots])
        self.slot_quat = np.stack([s[2] for s in slots])
        self.mass = np.array([s.mass_kg for s in specs])
        self.inertia = np.stack([s.inertia_kg_m2() for s in specs])
        self.friction = np.array([s.friction for s in specs])
        self.rest_height = np.array([s.rest_height_m for s in specs])
        self.symmetry = np.array([s.grasp_symmetry for s in specs])
        self.log_category = np.log([s.category_id for s in specs])
        self.grasp_offset = np.array([s.grasp_offset_m for s in specs])


def sample_variant(key: Key, config: RandomConfig, table: ObjectTable, index: Index) -> Int[Array, ""]:
    """() index into the table's arrays of object `index`, in one of its rest poses."""
    other = jax.random.uniform(key) < config.other_pose_share
    return jnp.where(other, jnp.asarray(table.other_variant)[index], index)


def _around(key, half_range, shape=()):
    """Uniform factors in [1 - half_range, 1 + half_range]."""
    return 1.0 + half_range * jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def sample_params(
    key: Key, config: RandomConfig, table: ObjectTable, variant: Index
) -> tuple[ModelParams, Float[Array, ""]]:
    """Model parameters of one episode with `variant` of the table; also the object's size factor ()."""
    keys = jax.random.split(key, 7)
    size = _around(keys[0], config.size)
    mass = _around(keys[1], config.object_mass)
    take = lambda a: jnp.asarray(a, jnp.float32)[variant]  # noqa: E731
    params = ModelParams(
        slot_size=take(table.slot_size) * size,
        slot_pos=take(table.slot_pos) * size,
        slot_quat=take(table.slot_quat),
        object_mass=take(table.mass) * mass,
        object_inertia=take(table.inertia) * mass * size**2,
        object_friction=take(table.friction) * _around(keys[2], config.object_friction),
        link_mass_scale=_around(keys[3], config.link_mass, (scene.N_ARM,)),
        joint_damping=_around(keys[4], config.damping, (scene.N_ARM,)) * scene.JOINT_DAMPING_NMS_RAD,
        joint_friction=config.friction_nm * jax.random.uniform(keys[5], (scene.N_ARM,)),
        gain_scale=_around(keys[6], config.stiffness, (scene.N_ARM,)),
    )
    return params, size


def sample_qpos(key: Key, config: RandomConfig, rest_height_m: Float[Array, ""]) -> Float[Array, "16"]:
    """(16,) initial joints around home, gripper open, object on the table with any yaw."""
    k_joint, k_xy, k_yaw = jax.random.split(key, 3)
    joints = jnp.asarray(scene.HOME_RAD) + config.joint_rad * jax.random.uniform(
        k_joint, (scene.N_ARM,), minval=-1.0, maxval=1.0
    )
    half = jnp.asarray(contract.WORKSPACE_SIZE_M) / 2
    xy = jnp.asarray(contract.WORKSPACE_CENTER_M) + half * jax.random.uniform(
        k_xy, (2,), minval=-1.0, maxval=1.0
    )
    yaw = jax.random.uniform(k_yaw, (), minval=-jnp.pi, maxval=jnp.pi)
    fingers = jnp.full(2, contract.GRIPPER_MAX_WIDTH_M / 2)
    return jnp.concatenate([joints, fingers, xy, rest_height_m[None], kinematics.quat_about_z(yaw, jnp)])


def maybe_pregrasp(
    key: Key, config: RandomConfig, qpos: Float[Array, "16"], grasp_pos: Float[Array, "3"],
    grasp_quat: Float[Array, "4"],
) -> Float[Array, "16"]:  # fmt: skip
    """qpos (16,) with the hand, in a share of the episodes, up to PREGRASP_HEIGHT_M above the grasp pose."""
    k_choice, k_offset = jax.random.split(key)
    offset = jax.random.uniform(k_offset, (3,), minval=-1.0, maxval=1.0)
    height = PREGRASP_HEIGHT_M * (0.5 + 0.5 * offset[2])
    target = grasp_pos + jnp.stack([0.005 * offset[0], 0.005 * offset[1], height])
    joints = inverse_kinematics.solve(qpos[QPOS.arm], target, grasp_quat)
    chosen = jax.random.uniform(k_choice) < config.pregrasp_share
    return qpos.at[QPOS.arm].set(jnp.where(chosen, joints, qpos[QPOS.arm]))


def sample_camera(key: Key, config: RandomConfig, T_world_cam: Float[AnyArray, "4 4"]) -> Float[Array, "4 4"]:
    """(4, 4) the nominal camera pose, moved and turned within the configured range."""
    k_pos, k_rot = jax.random.split(key)
    shift = config.camera_position_m * jax.random.uniform(k_pos, (3,), minval=-1.0, maxval=1.0)
    rx, ry, rz = config.camera_angle_rad * jax.random.uniform(k_rot, (3,), minval=-1.0, maxval=1.0)
    # First-order rotation, made orthonormal: the angles are a few hundredths of a radian.
    quat = jnp.array([1.0, rx / 2, ry / 2, rz / 2])
    turn = kinematics.quat_to_mat(quat / jnp.linalg.norm(quat), jnp)
    T = jnp.asarray(T_world_cam, jnp.float32)
    return T.at[:3, :3].set(T[:3, :3] @ turn).at[:3, 3].add(shift)
