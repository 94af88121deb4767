"""The two ray casters against each other and against MuJoCo's OpenGL renderer."""

import dataclasses
import math

import jax
import mujoco
import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.errors import UserError
from mjx_envs import scene
from mjx_envs.camera import Camera, look_at, nominal_camera
from mjx_envs.render import raycast, raycast_numpy, render_check
from mjx_envs.render.visible_geoms import BACKGROUND_RGB, visible_geoms

HEIGHT, WIDTH, FY = 120, 160, 130.0
EVERY_TYPE = """
<mujoco>
  <visual><quality numslices="128" numstacks="128" numquads="32"/></visual>
  <statistic extent="1" center="0 0 0"/>
  <asset><material name="red" rgba="1 0 0 1"/></asset>
  <worldbody>
    <geom type="plane" size="0 0 1" rgba="0.5 0.4 0.3 1"/>
    <geom type="plane" size="0.2 0.3 1" pos="0.1 0 0.02" rgba="0.9 0.9 0.9 1"/>
    <geom type="sphere" size="0.06" material="red"/>
    <geom type="capsule" size="0.03 0.08" rgba="0 1 0 1"/>
    <geom type="box" size="0.05 0.07 0.09" rgba="0 0 1 1"/>
    <geom type="cylinder" size="0.05 0.07" rgba="1 1 0 1"/>
    <geom type="capsule" size="0.02 0.12" rgba="0 1 1 1" group="2"/>
    <geom type="box" size="0.2 0.2 0.2" pos="0 0 0.2" group="3"/>
    <geom type="sphere" size="0.2" pos="0 0 0.2" rgba="1 1 1 0"/>
  </worldbody>
</mujoco>
"""
MOVED = list(range(2, 7))
HIDDEN = (7, 8)  # collision group, transparent


def _every_type(seed: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Solids at random poses above two planes."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_string(EVERY_TYPE)
    for geom_id in MOVED:
        spec.geoms[geom_id].pos = rng.uniform([-0.25, -0.25, 0.0], [0.25, 0.25, 0.3])
        quat = rng.normal(size=4)
        spec.geoms[geom_id].quat = quat / np.linalg.norm(quat)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert np.ptp(data.geom_xpos[MOVED], axis=0).min() > 0.05
    return model, data


def _robot(seed: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The grasping scene with random joint angles."""
    rng = np.random.default_rng(seed)
    model = scene.build_model()
    model.vis.quality.numslices = model.vis.quality.numstacks = 128
    data = mujoco.MjData(model)
    data.qpos[: scene.N_ARM] = np.array(contract.HOME_RAD) + rng.uniform(-0.4, 0.4, scene.N_ARM)
    mujoco.mj_forward(model, data)
    return model, data


def _camera(seed: int) -> Camera:
    rng = np.random.default_rng(100 + seed)
    azimuth, radius = rng.uniform(-math.pi, math.pi), rng.uniform(0.5, 0.9)
    position = (radius * math.cos(azimuth), radius * math.sin(azimuth), rng.uniform(0.3, 0.7))
    return Camera(FY, FY, WIDTH / 2, HEIGHT / 2, HEIGHT, WIDTH, look_at(position, (0, 0, 0.1)))


def _robot_camera(seed: int) -> Camera:
    T = nominal_camera(contract.D455).T_world_cam.copy()
    T[:3, 3] += np.random.default_rng(seed).uniform(-0.05, 0.05, 3)
    return Camera(FY, FY, WIDTH / 2, HEIGHT / 2, HEIGHT, WIDTH, T)


SCENES = [
    pytest.param(_every_type, _camera, id="every_type"),
    pytest.param(_robot, _robot_camera, id="robot"),
]


# --- against MuJoCo's OpenGL ------------------------------------------------------------------


@pytest.mark.parametrize(("make_scene", "make_camera"), SCENES)
def test_depth_agrees_with_open_gl(make_scene, make_camera, open_gl) -> None:
    errors, off_edge, wrong, edge_count, geom_mismatch = [], 0, 0, 0, 0
    for seed in range(6):
        (model, data), camera = make_scene(seed), make_camera(seed)
        with open_gl(model, camera.height_px, camera.width_px) as renderer:
            renderer.enable_depth_rendering()
            render_check.aim(renderer, data, camera)
            expected = renderer.render().copy()
            renderer.disable_depth_rendering()
            renderer.enable_segmentation_rendering()
            render_check.aim(renderer, data, camera)
            expected_geom = renderer.render()[..., 0].copy()
        ours = raycast_numpy.render(model, data, camera)
        both = (ours.depth_m > 0) & (expected < 2.0)
        edges = render_check.edges_of(ours.segmentation)
        error = abs(ours.depth_m - expected)
        errors.append(error[both])
        plain = ~edges & (expected < 2.0)
        off_edge += plain.sum()
        wrong += (plain & (error > 0.005)).sum()
        geom_mismatch += (plain & (ours.segmentation != expected_geom)).sum()
        edge_count += edges.sum()
    median = np.median(np.concatenate(errors))
    print(
        f"\nmedian depth error {median * 1e3:.4f} mm; off by > 5 mm outside edges {wrong / off_edge:.4%} "
        f"of {off_edge} pixels; other geom {geom_mismatch / off_edge:.4%}; {edge_count} edge pixels"
    )
    assert off_edge > 50_000
    assert median <= 0.001
    assert wrong <= 0.005 * off_edge
    assert geom_mismatch <= 0.005 * off_edge
    assert edge_count <= 0.2 * off_edge


# --- NumPy against JAX ------------------------------------------------------------------------


@pytest.mark.parametrize(("make_scene", "make_camera"), SCENES)
def test_numpy_and_jax_agree(make_scene, make_camera) -> None:
    for seed in range(4):
        (model, data), camera = make_scene(seed), make_camera(seed)
        expected = raycast_numpy.render(model, data, camera)
        geoms = raycast.Geoms.of_model(model, data.geom_xpos, data.geom_xmat)
        actual = raycast.render(geoms, camera)
        same = expected.segmentation == np.asarray(actual.segmentation)
        assert same.mean() > 0.9995
        assert np.isin(expected.segmentation, visible_geoms(model).ids).mean() > 0.5
        np.testing.assert_allclose(actual.depth_m[same], expected.depth_m[same], atol=2e-5)
        off = np.abs(np.asarray(actual.normal_w) - expected.normal_w).max(axis=-1)[same] > 1e-3
        assert off.mean() < 1e-3  # creases of boxes and cylinders
        np.testing.assert_allclose(actual.rgb[same][~off], expected.rgb[same][~off], atol=1e-3)
        np.testing.assert_array_equal(raycast_numpy.render_depth(model, data, camera), expected.depth_m)
        depth = raycast.render_depth(geoms, camera)
        assert (abs(depth - actual.depth_m) > 2e-5).mean() < 5e-4


def test_a_cropped_camera_under_vmap_sees_the_window_of_the_whole_picture() -> None:
    scenes = [_every_type(seed) for seed in (0, 1)]
    cameras = [_camera(seed) for seed in (0, 1)]
    geoms = [raycast.Geoms.of_model(m, d.geom_xpos, d.geom_xmat) for m, d in scenes]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *geoms)
    camera = dataclasses.replace(cameras[0], T_world_cam=np.stack([c.T_world_cam for c in cameras]))
    window = jax.vmap(raycast.render)(stacked, camera.cropped(30, 60, 40, 50))
    assert window.depth_m.shape == (2, 40, 50) and window.rgb.shape == (2, 40, 50, 3)
    cut = np.s_[30:70, 60:110]
    for i in range(2):
        for name, whole in raycast.render(geoms[i], cameras[i])._asdict().items():
            differs = abs(np.asarray(getattr(window, name)[i]) - np.asarray(whole[cut])) > 1e-4
            assert differs.mean() < 1e-3, name
        cropped = raycast_numpy.render(*scenes[i], cameras[i].cropped(30, 60, 40, 50))
        np.testing.assert_allclose(
            cropped.depth_m, raycast_numpy.render(*scenes[i], cameras[i]).depth_m[cut], atol=1e-6
        )


# --- what a picture means ---------------------------------------------------------------------


def _one_sphere() -> tuple[mujoco.MjModel, mujoco.MjData, Camera]:
    """A 0.1 m sphere 1 m in front of a camera that looks along world +x."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="sphere" size="0.1" pos="1 0 0"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data, Camera(100.0, 100.0, 20.5, 15.5, 31, 41, look_at((0, 0, 0), (1, 0, 0)))


def test_pixel_centres_planar_depth_far_limit_and_background() -> None:
    model, data, camera = _one_sphere()
    seen = raycast_numpy.render(model, data, camera)
    assert seen.depth_m[15, 20] == pytest.approx(0.9, abs=1e-6)  # principal point at a pixel's centre
    np.testing.assert_allclose(seen.normal_w[15, 20], [-1, 0, 0], atol=1e-6)
    # 5 columns off: ray (0.05, 0, 1), planar t solves 1.0025 t^2 - 2 t + 0.99 = 0.
    t = (2 - math.sqrt(4 - 4 * 1.0025 * 0.99)) / (2 * 1.0025)
    assert seen.depth_m[15, 25] == pytest.approx(t, abs=1e-6)
    np.testing.assert_array_equal(seen.depth_m, seen.depth_m[::-1, ::-1])
    # The silhouette is a circle of 0.1 / sqrt(0.99) * 100 = 10.05 pixels about the centre.
    rows, cols = np.mgrid[-15:16, -20:21]
    np.testing.assert_array_equal(seen.segmentation == 0, np.hypot(rows, cols) < 10.05)
    assert seen.segmentation[0, 0] == -1 and seen.depth_m[0, 0] == 0
    np.testing.assert_allclose(seen.rgb[0, 0], BACKGROUND_RGB)
    assert not seen.normal_w[0, 0].any()
    near = raycast_numpy.render(model, data, camera, far_m=0.9025)
    assert near.depth_m[15, 20] > 0 and near.depth_m[15, 25] == 0  # t = 0.9128
    assert near.segmentation[15, 25] == 0


def test_geoms_behind_beside_and_around_the_camera_do_no_harm() -> None:
    model, data, camera = _one_sphere()
    for position in ((-1, 0, 0), (0, 5, 0), (0, 0, 0)):
        data.geom_xpos[0] = position
        assert not raycast_numpy.render(model, data, camera).depth_m.any()
    data.geom_xpos[0] = (0.105, 0, 0)  # crosses the near plane of the bounding boxes
    assert raycast_numpy.render_depth(model, data, camera)[15, 20] == pytest.approx(0.005, abs=1e-6)


def test_hidden_geoms_are_not_drawn_and_materials_give_colours() -> None:
    model, _ = _every_type(0)
    geoms = visible_geoms(model)
    assert not set(HIDDEN) & set(geoms.ids.tolist())
    assert geoms.types == ("plane", "plane", "sphere", "capsule", "box", "cylinder", "capsule")
    np.testing.assert_array_equal(geoms.rgb[2], [1, 0, 0])


def test_a_type_that_cannot_be_drawn_is_named() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom name="egg" type="ellipsoid" size="1 1 2"/></worldbody></mujoco>'
    )
    with pytest.raises(UserError, match="'egg'.*mjGEOM_ELLIPSOID"):
        visible_geoms(model)


def test_poses_of_bodies_are_refused() -> None:
    model, data = _every_type(0)
    with pytest.raises(UserError, match=f"{model.nbody} poses; expected those of {model.ngeom} geoms"):
        raycast.Geoms.of_model(model, data.xpos, data.xmat)
