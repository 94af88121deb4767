"""The development rig with one thing changed: the rest of a trial stays as its seed has it."""

from dataclasses import replace

import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.layout import CONTROLS, QPOS
from ddgrasp.presets import get_preset
from deploy.changes import Change
from deploy.trials import Trial, drawn
from mjx_envs.camera import nominal_camera
from rig.fr3 import scene
from rig.other_worlds import SpringWorld

PRESET = get_preset("demo")
WORLD = replace(PRESET.world, objects=("can", "cube"))
ONE_POSE = replace(WORLD.random, other_pose_share=0.0)
CONFIG = replace(PRESET, world=replace(WORLD, random=ONE_POSE))
PROFILE = CONFIG.world.profile
T_WORLD_CAM = nominal_camera(PROFILE).T_world_cam


def reset(change: Change, seed: int = 3, name: str = "can"):
    world = change.make_world(CONFIG)
    world.reset(seed, name)
    return world


@pytest.mark.parametrize("off", [(0.002, 0.2), (0.010, 1.0)])
def test_a_camera_is_off_by_as_much_as_is_said(off):
    one, again, other = (Change(off=off).displaced(T_WORLD_CAM, seed) for seed in (1, 1, 2))
    turn = one[:3, :3] @ T_WORLD_CAM[:3, :3].T
    assert np.linalg.norm(one[:3, 3] - T_WORLD_CAM[:3, 3]) == pytest.approx(off[0])
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(off[1], rel=1e-6)
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 1e-4
    assert Change().displaced(T_WORLD_CAM, 1) is T_WORLD_CAM


@pytest.mark.parametrize("world", ["meshes", "furniture", "dark table", "other tables", "spring"])
def test_arm_and_object_begin_where_they_do_in_the_development_rig(world):
    if world == "meshes":
        pytest.importorskip("manifold3d", reason="needs pip install -e '.[fr3]'")
    as_it_is, changed = reset(Change()), reset(Change(world))
    begun, other = as_it_is.data.qpos, changed.data.qpos
    np.testing.assert_array_equal(other[QPOS.arm], begun[QPOS.arm])
    np.testing.assert_array_equal(other[QPOS.object_quat], begun[QPOS.object_quat])
    np.testing.assert_allclose(other[QPOS.object_pos], begun[QPOS.object_pos], atol=3e-3)  # its height
    masses = [world.model.body("object").mass[0] for world in (as_it_is, changed)]
    assert masses[0] == pytest.approx(masses[1])
    changed.step(1.0)
    np.testing.assert_allclose(changed.data.qpos[QPOS.object_pos], other[QPOS.object_pos], atol=2e-3)


@pytest.mark.parametrize(
    "changed",
    [
        CONFIG,
        replace(CONFIG, world=replace(CONFIG.world, objects=("cube", "can", "apple"), episode_steps=7)),
        replace(CONFIG, record=replace(CONFIG.record, other_tables=True)),
        replace(CONFIG, deploy=replace(CONFIG.deploy, retry=False)),
    ],
)
def test_a_draw_is_the_same_whatever_is_changed(changed):
    """What pairs of trials rest on."""
    one, again = drawn(CONFIG, Trial(7, "can")), drawn(changed, Trial(7, "can"))
    assert (one.world_seed, one.policy_seed) == (again.world_seed, again.policy_seed)
    np.testing.assert_array_equal(one.T_world_cam, again.T_world_cam)
    assert one.rng.integers(1 << 30) == again.rng.integers(1 << 30)


def test_furniture_is_the_test_rig_s_and_clutter_follows_from_the_seed():
    one, again, other = (reset(Change("furniture"), seed).model for seed in (1, 1, 2))
    table = one.geom(scene.TABLE)
    np.testing.assert_allclose(table.pos + table.size, np.add(scene.TABLE_CENTER_M, scene.TABLE_HALF_M))
    clutter = [
        [model.geom(f"clutter{i}").pos for i in range(scene.CLUTTER_COUNT)] for model in (one, again, other)
    ]
    np.testing.assert_array_equal(clutter[0], clutter[1])
    assert np.abs(np.subtract(clutter[0], clutter[2])).max() > 0.01


def test_a_dark_table_returns_less_light():
    def table_mm(change):
        world = reset(change)
        camera = change.make_camera(CONFIG, world)
        return camera.depth_mm(world.data, T_WORLD_CAM, np.random.default_rng(0), "can")

    bright, dark = table_mm(Change()), table_mm(Change("dark table"))
    far = slice(0, 30)  # rows whose light has the longest way
    assert np.mean(dark[far] == 0) > 1.5 * np.mean(bright[far] == 0)


def test_every_trial_has_a_table_of_its_own_and_few_a_hole_where_the_rigs_is_too_bright():
    """Pixels 65 to 115 by 160 to 205 of the rig's own table: the infrared picture is clipped there."""
    world = reset(Change(), name="cube", seed=1)
    place = (slice(65, 115), slice(160, 205))

    def lost(change):
        camera = change.make_camera(CONFIG, world)
        trials = [np.random.default_rng(seed) for seed in range(6)]
        return [camera.depth_mm(world.data, T_WORLD_CAM, rng, "cube")[place] == 0 for rng in trials]

    own, other = lost(Change()), lost(Change("other tables"))
    assert min(hole.sum() for hole in own) >= 15 > np.median([hole.sum() for hole in other])
    assert (other[0] != other[1]).any()
    np.testing.assert_array_equal(other, lost(Change("other tables")))
    of_config = replace(CONFIG, record=replace(CONFIG.record, other_tables=True))
    camera = Change().make_camera(of_config, world)
    mm = camera.depth_mm(world.data, T_WORLD_CAM, np.random.default_rng(0), "cube")
    np.testing.assert_array_equal(mm[place] == 0, other[0])
    np.testing.assert_array_equal(lost(Change("other tables", sight="holes")), other)


def test_a_camera_that_makes_some_of_its_errors_makes_no_others():
    world = reset(Change())

    def seen(sight):
        camera = Change(sight=sight).make_camera(CONFIG, world)
        return camera.depth_mm(world.data, T_WORLD_CAM, np.random.default_rng(0), "can").astype(int)

    clean, sensed = seen("ideal"), seen("stereo")
    holes, values, ripple, mismatches = (seen(sight) for sight in ("holes", "values", "ripple", "mismatches"))
    hole = sensed == 0
    assert hole.any() and (ripple != clean).any() and (mismatches != clean).any()
    np.testing.assert_array_equal(holes, np.where(hole, 0, clean))
    np.testing.assert_array_equal(values, np.where(hole, clean, sensed))
    np.testing.assert_array_equal(np.where(ripple != clean, ripple, mismatches), values)
    disparity_px = [PROFILE.fx_px * PROFILE.baseline_m * 1e3 / np.maximum(mm, 1) for mm in (values, clean)]
    off_px = np.abs(disparity_px[0] - disparity_px[1])
    both = (values > 0) & (clean > 0)
    assert off_px[both & (ripple != clean)].max() < 1.0 <= off_px[both & (mismatches != clean)].min()


def test_the_spring_pulls_as_the_driver_s_does():
    stiffness, damping_s = np.linspace(400.0, 160.0, 7), 0.15
    world = SpringWorld(("cube",), CONFIG.world.random, stiffness, damping_s)
    world.reset(0, "cube")
    q, _ = world.state()
    step = np.array([0.08, 0, 0, -0.04, 0, 0, 0.02])
    world.command(q + step, close=False)
    reference = world.data.ctrl[CONTROLS.arm]
    # K (q_ref - q) + D v_ref with q_ref amid the step and v_ref = step / 0.1 s, at rest
    expected = stiffness * step / 2 + damping_s * stiffness * step / contract.CONTROL_DT_S
    np.testing.assert_allclose(stiffness * (reference - q), expected, atol=1e-9)
    model = world.model
    np.testing.assert_allclose(model.actuator_gainprm[:7, 0], stiffness)
    np.testing.assert_allclose(model.actuator_biasprm[:7, 2], -damping_s * stiffness)
    for _ in range(3):
        before, _ = world.state()
        world.command(before + step, close=False)
        world.step(contract.CONTROL_DT_S)
    after, _ = world.state()
    assert 0.5 < (after - before)[0] / step[0] < 1.1


def test_full_size_is_handed_out_at_the_policy_s_and_is_smoother():
    deviations = []
    for change in (Change(), Change(sight="full size")):
        world = reset(change)
        camera = change.make_camera(CONFIG, world)
        seen = camera.depth_mm(world.data, T_WORLD_CAM, np.random.default_rng(0), "can")
        clean = camera.clean_mm(world.data, T_WORLD_CAM)
        assert seen.shape == clean.shape == camera.rgb(world.data, T_WORLD_CAM).shape[:2] == (180, 320)
        table = (slice(120, 170), slice(60, 300))
        error = (seen.astype(int) - clean)[table][seen[table] > 0]
        assert np.abs(np.median(error)) <= 2.0
        deviations.append(np.abs(error).mean())
    assert deviations[1] < deviations[0]


def test_meshes_are_drawn_as_the_ray_caster_draws_primitives(open_gl):
    pytest.importorskip("manifold3d", reason="needs pip install -e '.[fr3]'")
    change = Change("meshes", sight="ideal")
    meshes, plain = reset(change, name="cube"), reset(Change(sight="ideal"), name="cube")
    drawn_mm = change.make_camera(CONFIG, meshes).depth_mm(
        meshes.data, T_WORLD_CAM, np.random.default_rng(0), "cube"
    )
    cast_mm = Change(sight="ideal").make_camera(CONFIG, plain).clean_mm(plain.data, T_WORLD_CAM)
    same = np.abs(drawn_mm.astype(int) - cast_mm) <= 1
    # The cubes' edges differ by their rounding; everything else is the same scene.
    assert same.mean() > 0.99
