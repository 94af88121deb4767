"""Treatments of recorded depth by name, those with a network included, which `deploy/` may not have."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, assert_never, get_args

import numpy as np
from jaxtyping import UInt8

from ddgrasp.config import Config, DDGConfig
from ddgrasp.depth import to_metres, to_millimetres
from ddgrasp.errors import unknown_name
from deploy.interfaces import Depth
from deploy.treatment import Inpaint, Treatment

if TYPE_CHECKING:
    from ddg_jax.monocular import MonocularDepth

TreatmentName = Literal["recorded", "inpaint", "monocular"]
RECORDED: TreatmentName = "recorded"


@dataclass(frozen=True)
class Monocular:
    """Depth that a network estimates from colour, made metric by recorded depth (ddg_jax/monocular.py)."""

    config: DDGConfig
    weights: str = ""
    """Folder of the network's weights; empty takes the usual one."""
    needs_rgb: bool = True

    def __call__(self, depth: Depth, rgb: UInt8[np.ndarray, "h w 3"] | None) -> Depth:
        """See `deploy.treatment.Treatment`."""
        assert rgb is not None
        measured_mm = depth if depth.dtype == np.uint16 else to_millimetres(depth)
        estimated_mm = self.network(measured_mm[None], rgb[None])[0]
        return estimated_mm if depth.dtype == np.uint16 else to_metres(estimated_mm)

    @cached_property
    def network(self) -> "MonocularDepth":
        """The network, looked up when it is first asked for. UserError if its weights are missing."""
        from ddg_jax.monocular import MonocularDepth

        return MonocularDepth(self.config, self.weights)


def make_treatment(name: TreatmentName, config: Config) -> Treatment | None:
    """The treatment of that name, None for depth as recorded. UserError if its weights are missing, or for
    another name."""
    if name not in get_args(TreatmentName):
        raise unknown_name("treatment of depth", name, get_args(TreatmentName))
    match name:
        case "recorded":
            return None
        case "inpaint":
            return Inpaint()
        case "monocular":
            _ = Monocular(config.ddg).network
            return Monocular(config.ddg)  # a fresh one: it goes to processes where networks cannot follow
        case _:
            assert_never(name)
