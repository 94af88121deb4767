"""The development rig's own camera before the scenes of training, which no generator can be nearer to.

For the upper bound of Table II alone. It looks at the rig's geometry and materials, which no other depth
source may know.
"""

import threading
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from jaxtyping import Int, UInt8, UInt16

from ddg_jax.generate import FrameByFrame
from ddgrasp import machine
from ddgrasp.config import Config
from mjx_envs import scene
from mjx_envs.object_spec import ObjectSpec, SlotLayout
from mjx_envs.randomize import ObjectTable
from mjx_envs.views import Views
from rig.camera import RigCamera
from rig.world import SIM_DT_S

_STREAM = 0x626F756E
"""Keeps its random numbers apart from every other stage's ("boun")."""
_TABLES = 0x7461626C
"""The same for the tables of episodes ("tabl")."""


class RigSource(FrameByFrame):
    """A `DepthSource`: pictures the scene anew instead of changing clean depth."""

    needs_rgb, needs_views = False, True

    def __init__(self, config: Config, ideal: bool = False):
        """`ideal` depth is as rendered."""
        self._config, self._ideal = config, ideal
        self._table = ObjectTable(config.world.objects)
        self._own = threading.local()
        self._threads = ThreadPoolExecutor(machine.cores())

    def frames(
        self,
        depth_mm: UInt16[np.ndarray, "B H W"],
        rgb: UInt8[np.ndarray, "B H W 3"] | None,
        episode: Int[np.ndarray, " B"],
        frame: Int[np.ndarray, " B"],
        views: Views | None = None,
    ) -> UInt16[np.ndarray, "B H W"]:
        """See `DepthSource`."""
        assert views is not None  # `check_demos` sees to it

        def picture(i: int) -> UInt16[np.ndarray, "H W"]:
            return self._picture(views, i, int(episode[i]), int(frame[i]))

        return np.stack(list(self._threads.map(picture, range(len(views)))))

    def _picture(self, views: Views, i: int, episode: int, frame: int) -> UInt16[np.ndarray, "H W"]:
        """(H, W) uint16 millimetres of one view."""
        stage, spec = self._stage(), self._table.variants[int(views.variant[i])]
        stage.set_up(spec, float(views.size[i]), views.qpos[i])
        if self._config.record.other_tables and not self._ideal:
            table = np.random.default_rng([self._config.seed, _TABLES, episode]).integers(2**31)
            stage.camera.stereo.paint(int(table))
        rng = np.random.default_rng([self._config.seed, _STREAM, episode, frame])
        return stage.camera.depth_mm(stage.data, views.T_world_cam[i], rng, spec.name)

    def _stage(self) -> "_Stage":
        """This thread's own."""
        if not hasattr(self._own, "stage"):
            self._own.stage = _Stage(self._config, self._table.layout, self._ideal)
        return self._own.stage


class _Stage:
    """One scene and a camera before it."""

    def __init__(self, config: Config, layout: SlotLayout, ideal: bool):
        self._layout = layout
        self._model = scene.build_model(SIM_DT_S, layout)
        self.data = mujoco.MjData(self._model)
        # Its own `other_tables` stays off: every frame has a generator of its own here, and would be a scene.
        self.camera = RigCamera(self._model, config.record.stereo, config.world.profile, ideal)

    def set_up(self, spec: ObjectSpec, size: float, qpos: np.ndarray) -> None:
        """Puts everything where it was."""
        scene.fill_slots(self._model, spec, self._layout, size)
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self.data)
