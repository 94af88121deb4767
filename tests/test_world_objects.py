"""The twelve objects: sizes and masses against their sources, rest, grasp, picture; and a thirteenth."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from app.commands import parse
from ddgrasp import contract
from ddgrasp.config import RandomConfig, WorldConfig
from ddgrasp.errors import UserError
from evaluation import object_sheet
from mjx_envs import grasp_math, objects, scene
from mjx_envs.camera import nominal_camera
from mjx_envs.grasp_env import GraspEnv
from mjx_envs.object_checks import named
from mjx_envs.object_spec import (
    DEFAULT_SLOTS,
    Box,
    Capsule,
    Cylinder,
    ObjectSpec,
    RestPose,
    SlotLayout,
    slot_layout,
)
from mjx_envs.objects import OBJECTS, SHAPES, get_object
from mjx_envs.randomize import ObjectTable, sample_params
from mjx_envs.render import raycast_numpy
from mjx_envs.render.visual import Viewer
from ppo.guide import guide
from rig.world import RigWorld

SEEN, UNSEEN = contract.SEEN_OBJECTS, contract.UNSEEN_OBJECTS
TWELVE = (*SEEN, *UNSEEN)
EVERYTHING = OBJECTS | SHAPES
X, Y, Z = 0, 1, 2
SIZES_MM = [
    ("apple", Y, 64), ("banana", X, 175), ("cube", Y, 50), ("pear", Y, 66), ("peach", Y, 60.3),
    ("block", X, 75), ("block", Y, 50), ("block", Z, 50), ("persimmon", Y, 63.5), ("starfruit", X, 92),
    ("lemon", Y, 54), ("can", Y, 66), ("can", Z, 101), ("wheel", Y, 64), ("bread", X, 138),
]  # fmt: skip
"""Object, axis, millimetres: the sources that its description names."""

DENSITY_KG_M3 = {
    "apple": (800, 1100), "pear": (850, 1100), "peach": (1150, 1300), "banana": (650, 1000),
    "persimmon": (1000, 1300), "starfruit": (800, 1100), "lemon": (900, 1100), "cube": (600, 1000),
    "block": (20, 200), "can": (950, 1100), "wheel": (300, 1200), "bread": (150, 300),
}  # fmt: skip
"""Fruit about water, a peach 1240 (Emadi et al. 2011), a persimmon 1230 (Khormandy); dense wood; foam; soup
in tin; rubber and plastic with hollows; soft white bread."""
SOLID_KG_M3 = (300, 1300)
"""Of shapes that nothing real was measured for: plastic with hollows to solid."""

PALM_ABOVE_GRIP_M = scene.GRIP_POS_M[2] - 0.063
"""From the grip site up to the lower face of the hand's box (scene.py: centre 43 mm, half height 20 mm)."""


def place(spec: ObjectSpec, layout: SlotLayout | None = None) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """`spec` at rest in the middle of the workspace, the arm at home and holding still."""
    layout = layout or slot_layout([spec])
    model = scene.build_model(layout=layout)
    data = mujoco.MjData(model)
    scene.fill_slots(model, spec, layout)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)
    data.qpos[:9] = data.ctrl[:] = (*contract.HOME_RAD, 0.04, 0.04)
    data.qpos[9:16] = (*contract.WORKSPACE_CENTER_M, spec.rest_height_m, 1, 0, 0, 0)
    mujoco.mj_forward(model, data)
    return model, data


def inside(spec: ObjectSpec, points: np.ndarray) -> np.ndarray:
    """(N,) which of the points (N, 3) in the object frame lie in the object."""
    within = np.zeros(len(points), bool)
    if spec.box is not None:
        within |= np.all(np.abs(points - spec.box.center_m) <= spec.box.half_m, axis=1)
    for capsule in spec.capsules:
        start, along = np.array(capsule.start_m), np.subtract(capsule.end_m, capsule.start_m)
        share = np.clip((points - start) @ along / max(along @ along, 1e-12), 0, 1)
        within |= np.linalg.norm(points - start - share[:, None] * along, axis=1) <= capsule.radius_m
    for cylinder in spec.cylinders:
        radial = np.hypot(points[:, 0], points[:, 1])
        within |= (radial <= cylinder.radius_m) & (np.abs(points[:, 2]) <= cylinder.half_height_m)
    for plate in spec.plates:
        cos, sin = np.cos(plate.roll_rad), np.sin(plate.roll_rad)
        out, across = points @ [0.0, -sin, cos], points @ [0.0, cos, sin]
        within |= (
            (np.abs(points[:, 0]) <= plate.half_length_m) & (np.abs(across) <= plate.half_thickness_m)
            & (out >= 0) & (out <= plate.height_m)
        )  # fmt: skip
    return within


def test_the_paper_s_twelve_are_there_and_told_apart():
    assert (len(set(SEEN)), len(set(UNSEEN)), len(set(TWELVE))) == (6, 6, 12)
    assert set(TWELVE) <= set(OBJECTS)
    assert not set(OBJECTS) & set(SHAPES)
    assert tuple(SHAPES) == contract.PLAIN_SHAPES
    assert len({spec.category_id for spec in EVERYTHING.values()}) == len(EVERYTHING)
    assert all(spec.category_id >= 1 for spec in EVERYTHING.values())
    assert all(spec.source for spec in EVERYTHING.values())


@pytest.mark.parametrize(("name", "axis", "mm"), SIZES_MM)
def test_size_is_the_source_s(name, axis, mm):
    assert 1000 * get_object(name).extents_m()[axis] == pytest.approx(mm, rel=0.02)


@pytest.mark.parametrize("name", EVERYTHING)
def test_mass_fits_the_volume_and_the_frame_sits_at_the_centre_of_mass(name):
    spec = get_object(name)
    half = spec.half_extents_m()
    points = np.random.default_rng(0).uniform(-half, half, (200_000, 3))
    points = points[inside(spec, points)]
    volume_m3 = 8 * np.prod(half) * len(points) / 200_000
    low, high = DENSITY_KG_M3[name] if name in OBJECTS else SOLID_KG_M3
    assert low <= spec.mass_kg / volume_m3 <= high
    assert np.linalg.norm(points.mean(axis=0)) < 0.003


@pytest.mark.parametrize("name", EVERYTHING)
def test_at_rest_it_stays_for_a_second(name):
    model, data = place(get_object(name))
    start = data.qpos[9:16].copy()
    mujoco.mj_step(model, data, nstep=round(1.0 / model.opt.timestep))
    assert np.linalg.norm(data.qpos[9:12] - start[:3]) < 0.002
    assert np.degrees(2 * np.arccos(min(1.0, abs(data.qpos[12:16] @ start[3:])))) < 2.0


@pytest.mark.parametrize("name", EVERYTHING)
def test_the_largest_one_fits_between_fingers_and_palm(name):
    spec, largest = get_object(name), 1 + RandomConfig().size
    assert largest * 2 * spec.half_width_m() < contract.GRIPPER_MAX_WIDTH_M
    branch = grasp_math.yaw_branch(np.array([1.0, 0, 0, 0]), spec.grasp_symmetry)
    grasp_pos, _ = grasp_math.grasp_pose(
        np.array([0.5, 0.0, largest * spec.rest_height_m]), np.array([1.0, 0, 0, 0]),
        np.asarray(spec.grasp_symmetry), branch, offset_m=spec.grasp_offset_m,
    )  # fmt: skip
    assert largest * spec.extents_m()[Z] - grasp_pos[2] < PALM_ABOVE_GRIP_M


def heights_m(depth_m, shown, camera):
    """(N,) height above the table of the pixels `shown` (H, W) of a depth picture."""
    rows, columns = np.nonzero(shown)
    ray = np.stack([
        (columns + 0.5 - camera.cx_px) / camera.fx_px, (rows + 0.5 - camera.cy_px) / camera.fy_px,
        np.ones(len(rows)),
    ])  # fmt: skip
    return (camera.T_world_cam[:3, :3] @ ray * depth_m[shown])[2] + camera.T_world_cam[2, 3]


BOTH_POSES = tuple(name for name, spec in EVERYTHING.items() if spec.other_pose is not None)


@pytest.mark.parametrize("name", BOTH_POSES)
def test_in_its_other_pose_it_stays_and_has_turned(name):
    usual, other = get_object(name), get_object(name).in_other_pose()
    assert usual.other_pose is not None
    turned = {"x": [X, Z, Y], "y": [Z, Y, X]}[usual.other_pose.about]
    np.testing.assert_allclose(other.extents_m(), usual.extents_m()[turned], atol=1e-9)
    np.testing.assert_allclose(other.inertia_kg_m2(), usual.inertia_kg_m2()[turned])
    model, data = place(other)
    camera = object_sheet.close_camera(other.rest_height_m)
    picture = raycast_numpy.render(model, data, camera)
    shown = np.isin(picture.segmentation, scene.slot_ids(model))
    assert heights_m(picture.depth_m, shown, camera).max() == pytest.approx(other.extents_m()[Z], abs=0.003)
    start = data.qpos[9:16].copy()
    mujoco.mj_step(model, data, nstep=round(1.0 / model.opt.timestep))
    assert np.linalg.norm(data.qpos[9:12] - start[:3]) < 0.003
    assert np.degrees(2 * np.arccos(min(1.0, abs(data.qpos[12:16] @ start[3:])))) < 3.0


@pytest.mark.parametrize("pose", [*EVERYTHING, *(f"{name}, turned" for name in BOTH_POSES)])
def test_at_rest_mjx_holds_every_contact(pose):
    name, *turned = pose.split(", ")
    spec = get_object(name).in_other_pose() if turned else get_object(name)
    model, data = place(spec)
    mujoco.mj_step(model, data, nstep=40)
    assert 1 <= (data.contact.dist < 0).sum() <= scene.max_contacts(slot_layout([spec]))


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_other_pose_comes_up_in_its_share_of_the_episodes_and_stays(share):
    env = GraspEnv(WorldConfig(objects=("block", "cube"), random=RandomConfig(other_pose_share=share)))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 128))
    episode = state.info["episode"]
    other = np.asarray(episode.variant) == 2
    assert not other[np.asarray(episode.object_index) == 1].any()  # a cube has one
    assert other[np.asarray(episode.object_index) == 0].mean() == pytest.approx(share, abs=0.15)
    step = jax.jit(jax.vmap(env.step))
    for _ in range(5):
        state = step(state, jnp.zeros((128, 8)).at[:, 7].set(-1.0))
    height = np.asarray(state.data.qpos[:, 11])
    np.testing.assert_allclose(height, np.asarray(episode.rest_height), atol=0.002)
    rest = np.where(other, 0.0375, 0.025)
    np.testing.assert_allclose(height, rest, rtol=RandomConfig().size + 0.02)


def test_the_guide_lifts_all_of_them_in_one_batch():
    env = GraspEnv(WorldConfig(objects=tuple(EVERYTHING)))
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    act = jax.jit(jax.vmap(guide))
    state = reset(jax.random.split(jax.random.PRNGKey(0), 12 * len(EVERYTHING)))
    for _ in range(env.config.episode_steps):
        state = step(state, act(state.obs))
    success = np.asarray(state.metrics["success"])
    index = np.asarray(state.info["episode"].object_index)
    rates = {name: success[index == i].mean() for i, name in enumerate(env.table.names)}
    assert success.mean() > 0.9, rates
    assert min(rates.values()) >= 0.6, rates


def test_the_grasp_offset_turns_with_the_object():
    on_its_side = np.array([np.sqrt(0.5), np.sqrt(0.5), 0, 0])  # +90 degrees about x: z becomes -y
    pos, _ = grasp_math.grasp_pose(
        np.array([0.5, 0.1, 0.3]), on_its_side, np.asarray(0), 0.0, offset_m=(0.0, 0.0, 0.02)
    )
    np.testing.assert_allclose(pos, [0.5, 0.08, 0.3], atol=1e-12)


def grasped(*parts: Box | Capsule, offset_m=(0.0, 0.0, 0.0)) -> ObjectSpec:
    """An object of those parts."""
    boxes = [part for part in parts if isinstance(part, Box)]
    return ObjectSpec(
        "thing", 99, 0.1, 0.5, (0.5, 0.5, 0.5), 0.02, 2, box=boxes[0] if boxes else None,
        capsules=tuple(part for part in parts if isinstance(part, Capsule)), grasp_offset_m=offset_m,
    )  # fmt: skip


def test_what_lies_beside_the_pads_does_not_count_as_between_them():
    head, handle = Box((0.010, 0.035, 0.010), (0.060, 0.0, 0.0)), Capsule((-0.06, 0, 0), (0.05, 0, 0), 0.010)
    assert grasped(head, handle).half_width_m() == pytest.approx(0.010)
    assert grasped(head, handle, offset_m=(0.045, 0.0, 0.0)).half_width_m() == pytest.approx(0.035)
    assert grasped(head, handle, offset_m=(0.0, 0.004, 0.0)).half_width_m() == pytest.approx(0.014)


def test_the_round_end_of_what_begins_beside_the_pads_counts():
    balls = [Capsule((x, 0.0, 0.0), (x, 0.0, 0.0), 0.020) for x in (-0.0225, 0.0225)]
    # a pad reaches to 10.5 mm, 12 mm from the middle of a ball: sqrt(20^2 - 12^2) = 16 mm
    assert grasped(*balls).half_width_m() == pytest.approx(0.016)
    assert grasped(*balls, offset_m=(0.06, 0.0, 0.0)).half_width_m() == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"grasp_symmetry": 1}, "grasp_symmetry is 1; expected 0 or an even number"),
        ({"other_pose": RestPose("y", 0.02, grasp_symmetry=3)}, "grasp_symmetry is 3; expected 0 or an even"),
        ({"capsules": (Capsule((-0.19, 0, 0), (0.19, 0, 0), 0.01),)}, "a part reaches 0.2 m from its middle"),
        ({"box": Box((0.145, 0.02, 0.02))}, "a part reaches 0.145 m from its middle"),
        ({"box": None, "cylinders": (Cylinder(0.02, 0.02),)}, "nothing of it collides: give it a box"),
        ({"box": Box((0.02, 0.041, 0.02))}, "0.082 m wide where the fingers close; a hand opens by 0.08 m"),
        ({"mass_kg": -1.0}, "mass_kg is -1; expected more than 0"),
        ({"mass_kg": 120.0}, "mass_kg is 120; expected more than 0, at most 3"),
        ({"friction": 0.0}, "friction is 0; expected a number above 0"),
        ({"friction": float("inf")}, "friction is inf; expected a number above 0"),
        ({"category_id": 0}, "category_id is 0; expected 1 or more"),
        ({"rgb": (255, 128, 0)}, r"rgb is \(255, 128, 0\); expected three numbers of 0 to 1"),
        ({"rgb": "#ff8000"}, "rgb is '#ff8000'; expected three"),
        ({"box": Box((0.02, 0.02, 0.02), rgb=(0.1, 0.2))}, r"rgb is \(0.1, 0.2\); expected three"),
    ],
)
def test_what_no_hand_grasps_or_no_engine_sees_is_refused(change, message):
    with pytest.raises(UserError, match=f"^cube: {message}"):
        replace(get_object("cube"), **change)


@pytest.mark.parametrize("name", ["ycb/mug", "two words", "", ".hidden", "a&b"])
def test_a_name_that_no_file_can_have_is_refused(name):
    with pytest.raises(UserError, match="An object is called .*expected letters of ASCII, digits"):
        replace(get_object("cube"), name=name)


def test_two_objects_of_one_name_or_category_are_refused(monkeypatch):
    cube = get_object("cube")
    with pytest.raises(UserError, match="Two objects are called 'cube': give one"):
        named([cube, replace(cube, category_id=99)])
    monkeypatch.setitem(
        OBJECTS, "mine", replace(cube, name="mine", category_id=get_object("tin").category_id)
    )
    with pytest.raises(UserError, match="mine and tin have one category_id, 18"):
        objects._check_apart()
    monkeypatch.setitem(OBJECTS, "mine", replace(cube, name="tower", category_id=99))
    with pytest.raises(UserError, match="Two objects are called 'tower'"):
        objects._check_apart()


# --- slots ---------------------------------------------------------------------------------------


def test_the_scene_has_as_many_slots_as_the_chosen_objects_need():
    assert ObjectTable(("cube", "apple", "banana")).layout == DEFAULT_SLOTS
    assert ObjectTable(SEEN).layout == DEFAULT_SLOTS == SlotLayout(capsules=4, cylinders=0, plates=0)
    assert ObjectTable(("cube", "wheel")).layout == SlotLayout(capsules=8, cylinders=2)
    twelve = ObjectTable(TWELVE)
    assert twelve.layout == SlotLayout(capsules=8, cylinders=2, plates=5)
    assert twelve.model.slot_size.shape == (
        12 + len(set(BOTH_POSES) & set(TWELVE)),
        16,
        3,
    ) and twelve.rgb.shape == (12, 16, 3)
    model = scene.build_model(layout=twelve.layout)
    assert [model.geom(i).name for i in scene.slot_ids(model)] == list(twelve.layout.names)


@pytest.mark.parametrize("name", OBJECTS)
def test_unused_slots_hide_inside_and_change_no_picture(name):
    camera = nominal_camera(contract.D455.scaled(0.25))
    alone = raycast_numpy.render(*place(get_object(name)), camera)
    crowded = raycast_numpy.render(*place(get_object(name), slot_layout(OBJECTS.values())), camera)
    np.testing.assert_array_equal(alone.depth_m, crowded.depth_m)
    np.testing.assert_array_equal(alone.rgb, crowded.rgb)


@pytest.mark.parametrize("name", ["can", "starfruit"])
def test_what_is_drawn_only_touches_nothing(name):
    spec = get_object(name)
    model, data = place(spec)
    data.qpos[11] -= 0.01  # into the table
    mujoco.mj_forward(model, data)
    colliding = slot_layout([spec]).colliding_names
    drawn = {int(i) for i in scene.slot_ids(model) if model.geom(i).name not in colliding}
    touching = {int(g) for contact in data.contact for g in contact.geom}
    assert len(drawn) == len(spec.cylinders) + len(spec.plates) > 1 and len(touching) > 1
    assert not drawn & touching


def test_mjx_takes_the_scene_of_all_twelve():
    model = scene.build_model(layout=slot_layout(OBJECTS.values()))
    assert mjx.put_model(model).ngeom == model.ngeom  # raises for geoms that it cannot collide


def test_jax_and_numpy_draw_the_can_alike():
    spec, profile = get_object("can"), contract.D455.scaled(0.25)
    layout = slot_layout([spec])
    model, data = place(spec)
    params, _ = sample_params(jax.random.PRNGKey(0), RandomConfig(size=0.0), ObjectTable(("can",)), 0)
    viewer = Viewer(profile, layout)
    geoms = jax.jit(viewer.geoms)(jnp.asarray(data.qpos, jnp.float32), params, spec.slot_rgb(layout))
    batch = jax.tree.map(lambda leaf: leaf[None], geoms)
    pose = jnp.asarray(viewer.nominal_pose, jnp.float32)[None]
    expected = raycast_numpy.render(model, data, nominal_camera(profile))
    off = np.abs(np.asarray(viewer.depth_mm(batch, pose))[0] - 1000 * expected.depth_m) > 1.0
    assert off.mean() < 1e-3
    wrong = np.abs(np.asarray(viewer.rgb(batch, pose))[0] - 255.0 * expected.rgb).max(axis=-1) > 2
    assert wrong.mean() < 1e-3
    assert np.isin(expected.segmentation, scene.slot_ids(model)).sum() > 300


# --- the command, and a thirteenth ---------------------------------------------------------------


def test_the_sheet_is_a_picture_of_the_objects_asked_for(tmp_path, capsys):
    path = tmp_path / "new" / "sheet.png"
    parse("objects sheet", ["--objects", "pear", "can", "--out", str(path)]).run()
    assert capsys.readouterr().out.strip() == str(path)
    assert path.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UserError, match="Did you mean 'pear'"):
        parse("objects sheet", ["--objects", "pera", "--out", str(path)]).run()


@pytest.mark.parametrize("name", OBJECTS)
def test_a_panel_shows_the_whole_object_as_high_as_it_is(name):
    spec = get_object(name)
    seen = object_sheet.look(spec)
    shown = seen.segmentation > seen.segmentation[0, 0]  # the table has the lowest id of what is in view
    assert 0.03 < shown.mean() < 0.6
    assert not np.concatenate([shown[0], shown[-1], shown[:, 0], shown[:, -1]]).any()
    camera = object_sheet.close_camera(spec.rest_height_m)
    height_m = heights_m(seen.depth_m, shown, camera)
    assert height_m.max() == pytest.approx(spec.extents_m()[Z], abs=0.002)
    assert height_m.min() > -0.001


def test_the_list_names_each_object_with_its_source(capsys):
    parse("objects list", []).run()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(EVERYTHING)
    assert "can" in lines[9] and "66 x 66 x 101 mm" in lines[9] and "YCB" in lines[9]


BONE = ObjectSpec(
    "bone", 13, mass_kg=0.08, friction=0.6, rgb=(0.9, 0.9, 0.85), rest_height_m=0.02, grasp_symmetry=2,
    box=Box((0.04, 0.01, 0.01)),
    capsules=tuple(
        Capsule((x, y, 0.0), (x, y, 0.0), 0.02) for x in (-0.045, 0.045) for y in (-0.012, 0.0, 0.012)
    ),
)  # fmt: skip
POST = ObjectSpec(
    "post", 13, mass_kg=0.1, friction=0.8, rgb=(0.5, 0.5, 0.5), rest_height_m=0.065, grasp_symmetry=4,
    box=Box((0.02, 0.02, 0.065)), grasp_offset_m=(0.0, 0.0, 0.045),
)  # fmt: skip
"""Held 4.5 cm above its middle."""


@pytest.mark.parametrize(
    ("spec", "layout"),
    [(BONE, SlotLayout(capsules=6, cylinders=0)), (POST, DEFAULT_SLOTS)],
    ids=["bone", "post"],
)
def test_a_thirteenth_object_is_one_dataclass(monkeypatch, spec, layout):
    monkeypatch.setitem(OBJECTS, spec.name, spec)
    assert ObjectTable(("cube", spec.name)).layout == layout
    world, act = RigWorld((spec.name,)), jax.jit(guide)
    for seed in range(3):
        world.reset(seed, spec.name)
        assert world.observation()[39] == pytest.approx(np.log(13))
        for _ in range(60):
            action = np.asarray(act(jnp.asarray(world.observation(), jnp.float32)))
            targets = grasp_math.controls(world.data.qpos[:7], action)
            world.command(targets[:7], close=bool(action[7] > 0))
            world.step(contract.CONTROL_DT_S)
        assert world.success(), seed


@pytest.mark.parametrize("name", EVERYTHING)
def test_a_larger_one_is_so_in_all_of_its_parts(name):
    layout = slot_layout([get_object(name)])
    nominal = get_object(name).model(layout)
    large = nominal.scaled(1.05, 1.0, 1.0)
    for part in ("slot_size", "slot_pos"):
        np.testing.assert_allclose(getattr(large, part), 1.05 * getattr(nominal, part))
    np.testing.assert_array_equal(large.slot_quat, nominal.slot_quat)
