"""A contact sheet of objects, drawn by the ray caster: what each looks like to a camera, colour and depth."""

from collections.abc import Sequence

import mujoco
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from ddgrasp import contract
from ddgrasp.files import to_png
from ddgrasp.layout import QPOS
from evaluation.report import figures
from mjx_envs import kinematics, scene
from mjx_envs.camera import Buffers, Camera, look_at
from mjx_envs.object_spec import ObjectSpec, slot_layout
from mjx_envs.objects import get_object
from mjx_envs.render import raycast_numpy

HEIGHT_PX, WIDTH_PX = 120, 160
WIDTH_M = 0.19
"""What a panel spans at the object."""
YAW_RAD = 0.6
"""Three quarters on: neither side hides."""
COLUMNS = 6


def look(spec: ObjectSpec) -> Buffers:
    """`spec` at rest on the table, from the depth camera's place and magnified: (120, 160) pictures."""
    layout = slot_layout([spec])
    model = scene.build_model(layout=layout)
    scene.fill_slots(model, spec, layout)
    data = mujoco.MjData(model)
    data.qpos[QPOS.arm] = contract.HOME_RAD
    data.qpos[QPOS.object_pos] = (*contract.WORKSPACE_CENTER_M, spec.rest_height_m)
    data.qpos[QPOS.object_quat] = kinematics.quat_about_z(np.asarray(YAW_RAD))
    mujoco.mj_kinematics(model, data)
    return raycast_numpy.render(model, data, close_camera(spec.rest_height_m))


def draw(names: Sequence[str]) -> bytes:
    """PNG of the named objects in rows of six: colour, and depth below it, all depth on one scale."""
    seen = {name: look(get_object(name)) for name in names}
    depths = np.stack([picture.depth_m for picture in seen.values()])
    near, far = float(depths[depths > 0].min()), float(depths.max())
    columns = min(COLUMNS, len(names))
    rows = 2 * -(-len(names) // columns)
    panel_in = 1.8
    figure = Figure(figsize=(panel_in * columns + 0.6, panel_in * 0.84 * rows), layout="constrained")
    for i, (name, picture) in enumerate(seen.items()):
        row, column = divmod(i, columns)
        depth = figures.color_depth(picture.depth_m, near, far)
        for image, title, below in ((picture.rgb, name, 0), (depth, "", 1)):
            axes = figure.add_subplot(rows, columns, (2 * row + below) * columns + column + 1)
            axes.imshow(image, interpolation="nearest")
            axes.set_axis_off()
            axes.set_title(title, fontsize=10)
    bar = figure.colorbar(
        ScalarMappable(Normalize(near, far), figures.DEPTH_COLORS), ax=figure.axes, fraction=0.015, pad=0.01
    )
    bar.set_label("depth (m)", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return to_png(figure)


def close_camera(height_m: float) -> Camera:
    """From the nominal camera's place, turned to the workspace's centre at `height_m` and zoomed in."""
    target = np.array([*contract.WORKSPACE_CENTER_M, height_m])
    distance = float(np.linalg.norm(target - contract.CAMERA_POSITION_M))
    focal_px = WIDTH_PX * distance / WIDTH_M
    return Camera(
        focal_px, focal_px, WIDTH_PX / 2, HEIGHT_PX / 2, HEIGHT_PX, WIDTH_PX,
        look_at(contract.CAMERA_POSITION_M, target),
    )  # fmt: skip
