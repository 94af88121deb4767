"""The development rig's camera with a generator's errors in the place of its own, all or one kind of them."""

import hashlib
from pathlib import Path
from typing import Literal, get_args

import mujoco
import numpy as np
from jaxtyping import Float, UInt16

from ddgrasp import contract
from ddgrasp.config import StereoConfig
from ddgrasp.depth import to_metres, to_millimetres
from ddgrasp.shipped import PRETRAINED
from deploy.depth_noise import DepthGenerator, EpisodeNoise
from rig.camera import RigCamera

GeneratedName = Literal["generator", "generator's holes", "generator's values"]
GENERATED: tuple[GeneratedName, ...] = get_args(GeneratedName)
SHIPPED = PRETRAINED / "ddg" / "generator.onnx"


class GeneratedCamera(RigCamera):
    """Has the holes, the values or both of a generator, and of the camera what is left."""

    def __init__(
        self,
        model: mujoco.MjModel,
        config: StereoConfig,
        profile: contract.CameraProfile,
        generated: GeneratedName,
        file: Path = SHIPPED,
    ):
        """`file` is what `ddgrasp ddg export` wrote. UserError if it is none, or of another shape."""
        super().__init__(model, config, profile)
        self.generated: GeneratedName = generated
        self._generator = _opened(file, profile)
        self._noise: EpisodeNoise

    def _begin(self, rng: np.random.Generator) -> None:
        super()._begin(rng)
        self._noise = self._generator.noise(1, seed=int(rng.spawn(1)[0].integers(2**31)))

    def _sense(
        self,
        data: mujoco.MjData,
        T_world_cam: Float[np.ndarray, "4 4"],
        rng: np.random.Generator,
        object_name: str,
    ) -> UInt16[np.ndarray, "H W"]:
        """The camera's share by the same draws of `rng` as the whole camera's, the generator's by others that
        follow from it."""
        clean_mm = self.clean_mm(data, T_world_cam)
        generated = self._generator(to_metres(clean_mm)[None], self._noise.next())[0]
        generated_mm = to_millimetres(generated)
        if self.generated == "generator":
            return generated_mm
        sensed_mm = super()._sense(data, T_world_cam, rng, object_name)
        if self.generated == "generator's holes":
            return joined(generated_mm, sensed_mm, clean_mm)
        return joined(sensed_mm, generated_mm, clean_mm)


def digest(file: Path, profile: contract.CameraProfile) -> str:
    """SHA-256 of the generator in `file`; UserError if it is none, or of another shape than `profile`."""
    return hashlib.sha256(_opened(file, profile).path.read_bytes()).hexdigest()


def _opened(file: Path, profile: contract.CameraProfile) -> DepthGenerator:
    generator = DepthGenerator(file, threads=1)
    generator.check_shape(profile.height_px, profile.width_px)
    return generator


def joined(
    holes_mm: UInt16[np.ndarray, "H W"],
    values_mm: UInt16[np.ndarray, "H W"],
    clean_mm: UInt16[np.ndarray, "H W"],
) -> UInt16[np.ndarray, "H W"]:
    """(H, W) uint16 millimetres: holes where `holes_mm` has them, elsewhere `values_mm`, whose own holes are
    filled with `clean_mm`."""
    values = np.where(values_mm == 0, clean_mm, values_mm)
    return np.where(holes_mm == 0, np.uint16(0), values)
