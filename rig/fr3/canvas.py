"""One size of picture drawn by MuJoCo's OpenGL renderer: depth and geoms of one drawing, or colour.

`mujoco.Renderer` draws the same picture once for depth and once more for geoms.
"""

import mujoco
import numpy as np
from jaxtyping import Float32, Int32, UInt8

MAX_GEOMS = 10_000
_GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)
"""As a number: an array compared with the enumeration itself is compared object by object."""
_FLAGS = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)
"""Every geom in the colour that is its number; depth far away is more exact with them too."""


class Canvas:
    """An OpenGL context, a scene and the pixels that are read back, upside down as OpenGL has them."""

    def __init__(self, model: mujoco.MjModel, height_px: int, width_px: int):
        """`model` has the offscreen buffer that the size needs."""
        from mujoco.rendering.classic import gl_context

        self._model, self._shape = model, (height_px, width_px)
        self._gl = gl_context.GLContext(width_px, height_px)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        self._scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        self._rect = mujoco.MjrRect(0, 0, width_px, height_px)

    def look(self, data: mujoco.MjData, camera_id: int) -> None:
        """The scene of `data` from the model's camera of that number."""
        self._camera.fixedcamid = camera_id
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, every, self._scene)

    def rgb(self) -> UInt8[np.ndarray, "H W 3"]:
        """(H, W, 3) uint8 colour."""
        colour = np.empty((*self._shape, 3), np.uint8)
        self._draw(colour, None)
        return colour[::-1].copy()

    def depth_m(self) -> Float32[np.ndarray, "H W"]:
        """(H, W) planar depth, metres, to the far clipping plane."""
        depth = np.empty(self._shape, np.float32)
        self._draw_numbers(None, depth)
        return self._metres(depth)

    def depth_and_geoms(self) -> tuple[Float32[np.ndarray, "H W"], Int32[np.ndarray, "H W"]]:
        """(H, W) planar depth, metres, to the far clipping plane; (H, W) geom ids, -1 where none is."""
        colour, depth = np.empty((*self._shape, 3), np.uint8), np.empty(self._shape, np.float32)
        self._draw_numbers(colour, depth)
        red, green, blue = np.moveaxis(colour[::-1], -1, 0)
        drawn = red.astype(np.int32)
        if self._scene.ngeom > 254:  # a drawing's numbers begin with 1
            drawn |= green.astype(np.int32) << 8
            drawn |= blue.astype(np.int32) << 16
        ids = np.full(self._scene.ngeom + 1, -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid != -1 and geom.objtype == _GEOM:
                ids[geom.segid + 1] = geom.objid
        return self._metres(depth), ids[drawn]

    def close(self) -> None:
        """Lets go of the OpenGL context."""
        self._context.free()
        self._gl.free()

    def _draw_numbers(self, colour: np.ndarray | None, depth: np.ndarray | None) -> None:
        before = [self._scene.flags[flag] for flag in _FLAGS]
        for flag in _FLAGS:
            self._scene.flags[flag] = True
        self._draw(colour, depth)
        for flag, value in zip(_FLAGS, before, strict=True):
            self._scene.flags[flag] = value

    def _draw(self, colour: np.ndarray | None, depth: np.ndarray | None) -> None:
        self._gl.make_current()
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(colour, depth, self._rect, self._context)

    def _metres(self, buffer: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """From OpenGL's depth buffer, 1 at the near and 0 at the far clipping plane, as mujoco.Renderer does:
        with b the buffer, near n and far f, (n f / (f - n)) / (b + n / (f - n)), coefficients in float32."""
        near, far = (
            np.float32(plane * self._model.stat.extent)
            for plane in (self._model.vis.map.znear, self._model.vis.map.zfar)
        )
        scale, shift = (
            near * far / (far - near),
            np.float32(0.5) * (far + near) / (far - near) - np.float32(0.5),
        )
        metres = buffer[::-1].astype(np.float64)
        metres += shift
        np.divide(scale, metres, out=metres)
        return metres.astype(np.float32)
