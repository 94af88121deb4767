"""Random scenes of primitives seen by random active-stereo cameras: depth with its cause known. JAX-free.

What a measure of depth pictures learns from must not be the robot's scene nor the rig's camera, or it would
see those alone. Here rooms, objects, viewpoints, optics, projectors and matchers are all drawn anew.
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float, UInt16

from ddgrasp.config import StereoConfig
from ddgrasp.contract import D455, CameraProfile
from ddgrasp.depth import to_millimetres
from mjx_envs.camera import Buffers, Camera, look_at
from mjx_envs.render.raycast_numpy import render, render_depth
from sensors.models.active_stereo import ActiveStereo
from sensors.models.materials import Material

FAR_M = 10.0
"""Surfaces beyond are not drawn."""
MAX_OBJECTS = 9
_TYPES = ("box", "sphere", "capsule", "cylinder")


@dataclass(frozen=True)
class Picture:
    """A room as it is and as a camera reports it, planar millimetres."""

    clean_mm: UInt16[np.ndarray, "H W"]
    """0 = nothing in range."""
    stereo_mm: UInt16[np.ndarray, "H W"]
    """0 = invalid."""
    objects: int
    """How many."""
    camera_height_m: float
    camera_pitch_rad: float
    """0 looks along the floor, pi / 2 straight down."""


def random_device(rng: np.random.Generator, width_px: int) -> ActiveStereo:
    """A camera with another lens, baseline, projector and matcher; 16:9 pictures of `width_px`."""
    base = D455.scaled(width_px / D455.width_px)
    zoom = rng.uniform(0.85, 1.5)
    profile: CameraProfile = replace(
        base, fx_px=base.fx_px * zoom, fy_px=base.fy_px * zoom, baseline_m=float(rng.uniform(0.045, 0.1))
    )
    config = StereoConfig(
        projector_position=float(rng.uniform(0.2, 0.8)),
        dots=int(rng.integers(4000, 12_000)),
        dot_radius_mrad=float(rng.uniform(2.0, 5.0)),
        projector_power=float(rng.uniform(1.0, 5.0)),
        pattern_seed=int(rng.integers(2**31)),
        exposure_target=float(rng.uniform(0.2, 0.5)),
        full_well_electrons=float(10 ** rng.uniform(3.2, 4.3)),
        read_noise=float(10 ** rng.uniform(-2.7, -1.8)),
        lens_blur_px=float(rng.uniform(0.3, 0.8)),
        min_range_m=float(rng.uniform(0.2, 0.5)),
        max_range_m=float(rng.uniform(3.0, 9.0)),
        block_px=int(rng.choice((3, 5, 7))),
        smoothness=float(rng.uniform(0.5, 2.0)),
        uniqueness_percent=int(rng.integers(3, 16)),
        left_right_px=int(rng.integers(1, 3)),
        speckle_px=int(rng.integers(0, 40)),
        residual_limit=float(rng.uniform(0.8, 1.2)),
        refine_window_px=int(rng.choice((3, 5, 7))),
        subpixel_steps=int(rng.choice((8, 16, 32))),
    )
    return ActiveStereo(config, profile, texture_seed=config.pattern_seed)


def take_picture(rng: np.random.Generator, device: ActiveStereo) -> Picture:
    """A new room, seen once by `device`."""
    objects = int(rng.integers(0, MAX_OBJECTS + 1))
    model = mujoco.MjModel.from_xml_string(_room_xml(rng, objects))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    T_world_cam, pitch_rad = _viewpoint(rng)

    def draw(camera: Camera) -> Buffers:
        return render(model, data, camera, far_m=FAR_M)

    def draw_depth(camera: Camera) -> Float[np.ndarray, "H W"]:
        return render_depth(model, data, camera, far_m=FAR_M)

    stereo_mm = device.sense(draw, T_world_cam, rng, _materials(rng, model), draw_depth)
    clean_mm = to_millimetres(draw_depth(device.camera(T_world_cam)))
    return Picture(clean_mm, stereo_mm, objects, float(T_world_cam[2, 3]), pitch_rad)


def _viewpoint(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """(T_world_cam, pitch): a camera that looks at the objects from 0.35 to 2 m away."""
    distance_m, pitch_rad = np.exp(rng.uniform(np.log(0.35), np.log(2.0))), rng.uniform(0.15, 1.4)
    azimuth_rad = rng.uniform(-np.pi, np.pi)
    aim = np.array([*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.0, 0.2)])
    away = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), np.tan(pitch_rad)]) * np.cos(pitch_rad)
    return look_at(aim + distance_m * away, aim), float(pitch_rad)


def _room_xml(rng: np.random.Generator, objects: int) -> str:
    """A floor, up to three walls, and `objects` primitives on the floor or in the air."""
    geoms = ['<geom type="plane" size="20 20 0.1"/>']
    for _ in range(rng.integers(0, 4)):
        yaw_deg, distance_m = rng.uniform(-180, 180), rng.uniform(0.6, 5.0)
        x, y = distance_m * np.cos(np.radians(yaw_deg)), distance_m * np.sin(np.radians(yaw_deg))
        geoms.append(
            f'<geom type="box" size="0.02 {rng.uniform(0.3, 6):.3f} {rng.uniform(0.3, 3):.3f}" '
            f'pos="{x:.3f} {y:.3f} 0" euler="0 0 {yaw_deg:.1f}"/>'
        )
    for _ in range(objects):
        size = 10 ** rng.uniform(-1.9, -0.8, 3)
        x, y = rng.normal(0, 0.25, 2)
        z = size[2] if rng.random() < 0.7 else rng.uniform(0.05, 0.6)
        angles = rng.uniform(-180, 180, 3) if rng.random() < 0.4 else (0, 0, rng.uniform(0, 180))
        geoms.append(
            f'<geom type="{rng.choice(_TYPES)}" size="{size[0]:.4f} {size[1]:.4f} {size[2]:.4f}" '
            f'pos="{x:.3f} {y:.3f} {z:.3f}" euler="{angles[0]:.1f} {angles[1]:.1f} {angles[2]:.1f}"/>'
        )
    return f"<mujoco><worldbody>{''.join(geoms)}</worldbody></mujoco>"


def _materials(rng: np.random.Generator, model: mujoco.MjModel) -> dict[int, Material]:
    """Dark, bright, shiny and textured surfaces in the near infrared."""
    return {
        geom: Material(
            albedo=float(rng.uniform(0.03, 0.95)),
            specular=float(rng.choice((0.02, 0.1, 0.3, 0.8))),
            texture=float(rng.uniform(0, 0.3)),
        )
        for geom in range(model.ngeom)
    }
