"""A contact sheet of the test rig's mesh objects: two sides, contact parts, training's primitives. JAX-free.

Drawn by MuJoCo's OpenGL renderer; all objects lie in one scene, a step apart.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import UInt8
from matplotlib import colormaps
from matplotlib.figure import Figure

from ddgrasp.files import to_png
from mjx_envs.object_spec import slot_layout
from mjx_envs.objects import OBJECTS
from rig.fr3.picture import draw_without_display
from rig.meshes.bodies import CONTACT_GROUP, VISUAL_GROUP, MeshBody, make_body, place
from rig.meshes.objects import MESH_OBJECTS

HEIGHT_PX, WIDTH_PX = 210, 280
STEP_M = 1.0
"""Between two objects of the scene."""
DISTANCE_M, FIELD_DEG = 0.62, 18.5
AZIMUTHS_DEG = (55.0, 235.0)
ELEVATION_DEG = -30.0
PER_ROW, PANELS = 2, 4
_PRIMITIVE_ROW_M = 1.0
_KINDS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX, "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}  # fmt: skip


def draw(names: Sequence[str] = tuple(MESH_OBJECTS)) -> bytes:
    """PNG of the named objects, two a row; needs an OpenGL context, without a display EGL.

    Raises UserError where there is neither.
    """
    draw_without_display()
    bodies = [make_body(name) for name in names]
    model = _scene(bodies)
    rows = -(-len(bodies) // PER_ROW)
    panel_in = 1.5
    size = (panel_in * PER_ROW * PANELS, panel_in * 0.88 * rows)
    figure = Figure(figsize=size, layout="constrained")
    with mujoco.Renderer(model, HEIGHT_PX, WIDTH_PX) as renderer:
        for i, body in enumerate(bodies):
            row, column = divmod(i, PER_ROW)
            first = (row * PER_ROW + column) * PANELS + 1
            for panel, (image, title) in enumerate(_panels(model, renderer, i, body)):
                axes = figure.add_subplot(rows, PER_ROW * PANELS, first + panel)
                axes.imshow(image)
                axes.set_axis_off()
                axes.set_title(title, fontsize=8, loc="left")
    return to_png(figure)


def _panels(
    model: mujoco.MjModel, renderer: mujoco.Renderer, index: int, body: MeshBody
) -> list[tuple[UInt8[np.ndarray, "H W 3"], str]]:
    """(picture, title): from two sides, the contact parts, training's primitives if there are any."""
    size = " x ".join(f"{1000 * extent:.0f}" for extent in body.extents_m())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def look(y_m: float, azimuth_deg: float, group: int) -> UInt8[np.ndarray, "H W 3"]:
        camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
        camera.lookat[:] = (STEP_M * index, y_m, body.rest_height_m)
        camera.distance, camera.azimuth, camera.elevation = DISTANCE_M, azimuth_deg, ELEVATION_DEG
        option.geomgroup[:] = 0
        option.geomgroup[[0, group]] = 1
        renderer.update_scene(data, camera, option)
        return renderer.render()

    front, back = AZIMUTHS_DEG
    panels = [
        (look(0.0, front, VISUAL_GROUP), body.name),
        (look(0.0, back, VISUAL_GROUP), f"{size} mm, {1000 * body.mass_kg:.0f} g"),
        (look(0.0, front, CONTACT_GROUP), f"{len(body.convex_m)} contact parts"),
    ]
    if body.name in OBJECTS:
        panels.append((look(_PRIMITIVE_ROW_M, front, VISUAL_GROUP), "in training"))
    return panels


def _scene(bodies: Sequence[MeshBody]) -> mujoco.MjModel:
    """All objects on one table, the primitives of the same name `_PRIMITIVE_ROW_M` behind."""
    spec = mujoco.MjSpec()
    spec.visual.map.znear, spec.visual.map.zfar = 0.005, 30.0
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35] * 3, [0.35] * 3
    spec.worldbody.add_light(
        pos=[0, 0, 3],
        dir=[0.4, 0.3, -1],
        diffuse=[0.5] * 3,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=False,
    )
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], rgba=[0.86, 0.85, 0.83, 1]
    )
    for i, body in enumerate(bodies):
        place(body, spec.worldbody, STEP_M * i, 0.0, name=f"o{i}")
        if body.name in OBJECTS:
            _add_primitives(spec.worldbody, body.name, STEP_M * i)
    model = spec.compile()
    model.vis.global_.fovy = FIELD_DEG
    colors = colormaps["tab20"]
    for geom in np.flatnonzero(model.geom_group == CONTACT_GROUP):
        model.geom_rgba[geom] = colors(int(geom) % colors.N)
    return model


def _add_primitives(world: mujoco.MjsBody, name: str, x_m: float) -> None:
    """What the training's world has under that name, at rest."""
    spec = OBJECTS[name]
    layout = slot_layout([spec])
    body = world.add_body(pos=[x_m, _PRIMITIVE_ROW_M, spec.rest_height_m])
    for kind, size, pos, quat, rgb in zip(
        layout.kinds, *spec.slot_arrays(layout), spec.slot_rgb(layout), strict=True
    ):
        body.add_geom(type=_KINDS[kind], size=size, pos=pos, quat=quat, rgba=[*rgb, 1.0], group=VISUAL_GROUP)
