"""The FR3 rig's canvas draws what mujoco.Renderer draws, depth and geoms at once."""

import mujoco
import numpy as np

from mjx_envs.camera import Camera
from rig.fr3 import picture

GEOMS = 300
"""More than one colour channel can number."""
CAMERA = Camera(200.0, 200.0, 160.0, 90.0, 180, 320, np.diag([1.0, -1.0, -1.0, 1.0]))
"""At the world's origin, looking down."""
SCENE = (
    "<mujoco><worldbody><light pos='0 0 1'/>"
    + "<geom type='plane' size='3 3 .1' pos='0 0 -2'/>"
    + "".join(
        f"<geom type='sphere' size='.03' pos='{(i % 20 - 9.5) / 8} {(i // 20 - 7) / 9} -1.9'/>"
        for i in range(GEOMS)
    )
    + "</worldbody></mujoco>"
)


def test_a_picture_is_what_the_library_s_renderer_draws():
    scene = picture.of_scene(SCENE)
    scene.pose(np.zeros(0))
    drawn, depth_m, rgb = scene.buffers(CAMERA), scene.depth_m(CAMERA), scene.rgb(CAMERA)
    renderer = mujoco.Renderer(scene.model, CAMERA.height_px, CAMERA.width_px)
    renderer.update_scene(scene.data, picture.CAMERA)

    np.testing.assert_array_equal(rgb, renderer.render())
    renderer.enable_depth_rendering()
    expected_m = renderer.render().copy()
    expected_m[expected_m >= picture.FAR_M] = 0
    np.testing.assert_array_equal(drawn.depth_m, expected_m)
    np.testing.assert_array_equal(depth_m, expected_m)
    renderer.enable_segmentation_rendering()
    np.testing.assert_array_equal(drawn.segmentation, renderer.render()[..., 0])
    assert len(np.unique(drawn.segmentation)) > 256
    renderer.close()
    scene.close()
