"""Physics backends by name. Each is imported when it is asked for: Warp alone takes seconds."""

from ddgrasp import contract
from ddgrasp.config import BACKENDS
from ddgrasp.errors import unknown_name
from mjx_envs.object_spec import DEFAULT_SLOTS, SlotLayout
from mjx_envs.physics.interface import Physics


def make_physics(backend: str, sim_dt_s: float, layout: SlotLayout = DEFAULT_SLOTS) -> Physics:
    """The named backend at `sim_dt_s` seconds a substep; UserError if it is unknown or cannot run here."""
    substeps = round(contract.CONTROL_DT_S / sim_dt_s)
    if backend == "cpu":
        from mjx_envs.physics.c_engine import CpuPhysics

        return CpuPhysics(sim_dt_s, substeps, layout)
    if backend == "jax":
        from mjx_envs.physics.mjx_jax import JaxPhysics

        return JaxPhysics(sim_dt_s, substeps, layout)
    if backend == "warp":
        from mjx_envs.physics.mjx_warp import WarpPhysics, require_gpu

        require_gpu()
        return WarpPhysics(sim_dt_s, substeps, layout)
    raise unknown_name("physics backend", backend, BACKENDS)
