"""Materials: one for every object, and they reach the rig's model."""

import mujoco
import numpy as np
import pytest

from mjx_envs.objects import OBJECTS
from rig.world import RigWorld
from sensors.models.materials import OBJECT_MATERIALS, Material, object_material, rig_materials


def test_every_object_has_a_material_with_a_source():
    meshes = pytest.importorskip("rig.meshes.objects", reason="needs pip install -e '.[fr3]'").MESH_OBJECTS
    assert set(OBJECT_MATERIALS) == set(OBJECTS) | set(meshes)
    assert all(listed.source for listed in OBJECT_MATERIALS.values())
    for listed in OBJECT_MATERIALS.values():
        for material in (listed.surface, *listed.parts.values()):
            assert 0 < material.albedo < 1 and 0 <= material.specular <= 5


def test_parts_are_named_after_slots_or_surfaces_that_exist():
    meshes = pytest.importorskip("rig.meshes.objects", reason="needs pip install -e '.[fr3]'").MESH_OBJECTS
    model = RigWorld(objects=tuple(OBJECTS)).model
    names = {model.geom(i).name for i in range(model.ngeom)}
    names |= {part.name for described in meshes.values() for part in described.shape()}
    assert {part for listed in OBJECT_MATERIALS.values() for part in listed.parts} <= names


def test_dark_and_shiny_reach_the_model():
    model = RigWorld(objects=("wheel", "can")).model
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "object")
    albedo = {name: rig_materials(model, name) for name in ("wheel", "can")}
    object_geoms = np.flatnonzero(model.geom_bodyid == body)
    assert min(albedo["wheel"][g].albedo for g in object_geoms) < 0.05
    assert max(albedo["can"][g].specular for g in object_geoms) > 2
    assert all(albedo["can"][g] == albedo["wheel"][g] for g in range(model.ngeom) if g not in object_geoms)


def test_unlisted_objects_follow_their_colour():
    assert object_material("mine", "slot_box", (1.0, 1.0, 1.0)).albedo == pytest.approx(0.95)
    assert Material.from_rgb((0, 0, 0)).albedo == pytest.approx(0.05)
