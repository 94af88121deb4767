"""An active-stereo depth camera (D4xx kind): two infrared pictures, a dot projector, a matcher.

Infrared pictures are shaded from rendered depth, normals and materials under the projector's
pattern (with its own shadow test) and ambient light; OpenCV's semi-global matcher turns them into
disparity. Holes, edge fattening and range-dependent noise come out of the matching; no noise is
ever added to depth. NumPy and OpenCV alone.

Frames: camera = left imager (a D4xx's depth frame); the right imager and the projector stand
beside it along +x with parallel axes. Depth is planar.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

from ddgrasp.config import StereoConfig
from ddgrasp.config.sensors import odd
from ddgrasp.contract import D455, CameraProfile
from ddgrasp.depth import to_millimetres
from mjx_envs.camera import Buffers, Camera
from sensors.models import matching
from sensors.models.materials import NEAR_INFRARED_RGB, Material

Render = Callable[[Camera], Buffers]
Map = Float[np.ndarray, "H W"]
RenderDepth = Callable[[Camera], Map]
Infrared = UInt8[np.ndarray, "H W"]
Pose = Float[np.ndarray, "4 4"]

LAMP_POSITION_W_M = (0.3, -0.8, 2.2)
"""Centre of the room's lamp, world frame."""
LAMP_SHARE = 0.35
"""Share of the ambient light that comes from the lamp; the rest comes evenly from everywhere."""
SHININESS_DOUBLINGS = 6
"""Blinn-Phong exponent 2**6 = 64, so that the highlight is a few squarings."""
SHADOW_BIAS_M = 0.012
"""A point this much behind the projector's own depth map lies in shadow."""
PROJECTOR_MARGIN = 1.1
"""The projector lights a field this much wider than the imagers'."""
PROJECTOR_FALLOFF = 0.5
"""Exponent of the cosine by which the projector dims towards its edges."""
VIGNETTING = 2.5
"""Exponent of the cosine by which a lens dims towards its edges (4 for a simple one)."""
TEXELS_PER_PX = 3
"""Resolution of the stored pattern."""
TEXTURE_PX, TEXTURE_PX_PER_M = 512, 400.0
"""Size and scale of the albedo texture that `Material.texture` weighs (a 1.3 m tile)."""
TEXTURE_SEED = 455
"""Surfaces are the scene's: the same whatever camera looks at them."""
SPREAD_PX = 9
"""A translucent body spreads the projector's dots over this width: about two of their distances."""
DARK_WINDOW_PX = 3
"""A pixel is too dark if the median over this window is: single dots do not count."""
TEXTURE_DARKEST = 0.2
"""The texture's darkest spots keep this share of the albedo."""
CONTRAST_WINDOW_PX = 9
"""The pictures are compared less their mean over this window."""
TEXTURE_WINDOW_PX = 7
"""Contrast is measured over this window: small enough for a dark object on a bright table."""
CONFIG_SCALE = 0.25
"""`world.camera_scale` at which `StereoConfig`'s windows, and those above, were chosen."""


def of_scale(config: StereoConfig, profile: CameraProfile) -> "ActiveStereo":
    """The camera for pictures of `profile`: windows cover as much of a surface as at `CONFIG_SCALE`, for
    which `config` counts pixels. In smaller pictures they are as many pixels as there."""
    larger = profile.fx_px / D455.scaled(CONFIG_SCALE).fx_px
    return ActiveStereo(config, profile, max(1.0, larger))


class ActiveStereo:
    """Depth as an active-stereo camera reports it.

    The pattern and the matcher are made once; frames differ by the generator given to `sense`.
    """

    def __init__(
        self,
        config: StereoConfig,
        profile: CameraProfile,
        windows: float = 1.0,
        texture_seed: int = TEXTURE_SEED,
    ):
        """`windows` is how many times wider all windows are than `config` says: they cover the same part of a
        larger picture then. `texture_seed` draws the albedo of what it looks at."""
        self.config = config = config.finer(windows) if windows != 1.0 else config
        self._dark_px, self._contrast_px, self._texture_px, self._spread_px = (
            odd(side * windows) for side in (DARK_WINDOW_PX, CONTRAST_WINDOW_PX, TEXTURE_WINDOW_PX, SPREAD_PX)
        )
        self.profile = profile
        p = profile
        self._x = ((np.arange(p.width_px) + 0.5 - p.cx_px) / p.fx_px).astype(np.float32)[None, :]
        self._y = ((np.arange(p.height_px) + 0.5 - p.cy_px) / p.fy_px).astype(np.float32)[:, None]
        # The ray's z is 1, so cos = 1 / |ray|.
        self._vignetting = (1.0 + self._x**2 + self._y**2) ** np.float32(-VIGNETTING / 2)
        self._projector = _projector_profile(profile)
        self._pattern = _dot_pattern(config, profile, self._projector)
        self.paint(texture_seed)
        self._fb_px_m = p.fx_px * p.baseline_m
        self._disparities = 16 * math.ceil(self._fb_px_m / config.min_range_m / 16)
        self._matcher = matching.matcher(config, self._disparities)

    def paint(self, texture_seed: int) -> None:
        """Draws the albedo of what the camera looks at anew."""
        self._texture = albedo_texture(TEXTURE_PX, TEXTURE_PX, texture_seed)

    def paint_for(self, rng: np.random.Generator) -> None:
        """`paint` with a seed that belongs to `rng`, without a number of `rng`'s own."""
        self.paint(int(rng.spawn(1)[0].integers(2**31)))

    def sense(
        self,
        render: Render,
        T_world_cam: Pose,
        rng: np.random.Generator,
        materials: Mapping[int, Material] | None = None,
        render_depth: RenderDepth | None = None,
    ) -> UInt16[np.ndarray, "H W"]:
        """(H, W) uint16 planar depth in millimetres, 0 = invalid, in the left imager's frame.

        Args:
            render: draws the scene as it stands for a pinhole camera; called for both imagers.
            T_world_cam: (4, 4) pose of the left imager.
            rng: sensor noise.
            materials: by geom id; others are guessed from the rendered colour.
            render_depth: depth alone, for the projector's shadow map (default: from `render`).
        """
        left, right = self.infrared(render, T_world_cam, rng, materials, render_depth)
        return self.depth_mm(self.disparity(left, right))

    def camera(self, T_world_cam: Pose) -> Camera:
        """The left imager, in whose frame depth is reported."""
        return _camera(self.profile, T_world_cam, 0.0)

    def infrared(
        self,
        render: Render,
        T_world_cam: Pose,
        rng: np.random.Generator,
        materials: Mapping[int, Material] | None = None,
        render_depth: RenderDepth | None = None,
    ) -> tuple[Infrared, Infrared]:
        """Left and right infrared pictures, (H, W) uint8."""
        baseline = self.profile.baseline_m
        projector_m = self.config.projector_position * baseline
        projector = _camera(self._projector, T_world_cam, projector_m)
        lit_m = render_depth(projector) if render_depth else render(projector).depth_m
        lit_m = np.where(lit_m > 0, lit_m, np.float32(1e3)).astype(np.float32)
        images = []
        for imager_m in (0.0, baseline):
            buffers = render(_camera(self.profile, T_world_cam, imager_m))
            speckle = self._speckle(rng)
            images.append(
                self._radiance(
                    buffers, T_world_cam, imager_m, projector_m - imager_m, lit_m, materials, speckle
                )
            )
        exposure = self.config.exposure_target / max(float(images[0].mean()), 1e-6)
        left, right = (self._expose(image, exposure, rng) for image in images)
        return left, right

    def disparity(self, left: Infrared, right: Infrared) -> Float32[np.ndarray, "H W"]:
        """(H, W) float32 disparity of the left picture in pixels, 0 = no match."""
        pad = self._disparities
        padded = [cv2.copyMakeBorder(i, 0, 0, pad, 0, cv2.BORDER_REFLECT) for i in (left, right)]
        coarse = self._matcher.compute(*padded)[:, pad:].astype(np.float32) / 16.0
        columns = np.arange(self.profile.width_px, dtype=np.float32)[None, :]
        # The left band has no counterpart in the right picture.
        valid = (coarse > 0) & (columns - coarse >= 0)
        contrast = matching.contrast(left, self._texture_px)
        valid &= cv2.medianBlur(left, self._dark_px) >= self.config.dark_limit
        left, right = (matching.without_mean(picture, self._contrast_px) for picture in (left, right))
        fine, residual = matching.refine(left, right, coarse, self.config)
        valid &= (residual < self.config.residual_limit) & (contrast > self.config.contrast_limit)
        fine = matching.flatten(fine, valid, self.config)
        steps = self.config.subpixel_steps
        return np.where(valid, np.rint(fine * steps) / steps, 0).astype(np.float32)

    def depth_mm(self, disparity_px: Map) -> UInt16[np.ndarray, "H W"]:
        """(H, W) uint16 millimetres from disparity; out-of-range becomes 0."""
        depth_m = self._fb_px_m / np.maximum(disparity_px, 1e-3)
        valid = (
            (disparity_px > 0) & (depth_m >= self.config.min_range_m) & (depth_m <= self.config.max_range_m)
        )
        return to_millimetres(np.where(valid, depth_m, 0))

    def _radiance(
        self,
        buffers: Buffers,
        T_world_cam: np.ndarray,
        imager_m: float,
        projector_m: float,
        lit_m: np.ndarray,
        materials: Mapping[int, Material] | None,
        speckle: np.ndarray,
    ) -> np.ndarray:
        """(H, W) radiance of one imager, arbitrary units. Points and normals in that imager's frame.

        `projector_m` is the projector's x in the imager's frame; `speckle` (H, W) multiplies its light.
        """
        z = buffers.depth_m
        x_z, y_z = self._x * z, self._y * z
        R_world_cam = T_world_cam[:3, :3].astype(np.float32)
        normal = np.moveaxis(buffers.normal_w @ R_world_cam, -1, 0)
        T_world_imager = _beside(T_world_cam, imager_m)
        lamp = R_world_cam.T @ (
            np.array(LAMP_POSITION_W_M, np.float32) - T_world_imager[:3, 3].astype(np.float32)
        )
        albedo, specular, translucency = self._surface(buffers, x_z, y_z, z, T_world_imager, materials)
        view = _unit(-x_z, -y_z, -z)[0]

        to_projector, range_m = _unit(projector_m - x_z, -y_z, -z)
        dots = self._dots(x_z - projector_m, y_z, z, lit_m)
        dots *= self.config.projector_power / np.maximum(range_m, 0.1) ** 2
        diffuse, highlight = _reflect(normal, to_projector, view)
        radiance = dots * speckle * ((1.0 - translucency) * albedo * diffuse + specular * highlight)
        if translucency.any():
            radiance += cv2.blur(dots, (self._spread_px, self._spread_px)) * translucency * albedo * diffuse

        to_lamp, _ = _unit(lamp[0] - x_z, lamp[1] - y_z, lamp[2] - z)
        diffuse, highlight = _reflect(normal, to_lamp, view)
        radiance += LAMP_SHARE * (albedo * diffuse + specular * highlight)
        radiance += (1.0 - LAMP_SHARE) * albedo
        return np.where(z > 0, radiance, np.float32(0.05)) * self._vignetting

    def _surface(
        self, buffers, x_z, y_z, z, T_world_imager, materials
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(H, W) albedo, specular strength and translucency per pixel."""
        rgb = buffers.rgb
        default = Material.from_rgb((0.5, 0.5, 0.5))
        ids = buffers.segmentation
        count = max(int(ids.max()), max(materials or (0,))) + 2
        table = np.tile(np.array([-1.0, default.specular, 0.0, 0.0], np.float32), (count, 1))
        for geom, material in (materials or {}).items():
            table[geom + 1] = material.albedo, material.specular, material.texture, material.translucency
        rows = ids + 1
        albedo, specular, texture, translucency = (column.take(rows) for column in table.T.copy())
        unknown = albedo < 0
        if unknown.any():
            albedo[unknown] = 0.05 + 0.9 * (rgb[unknown] @ np.array(NEAR_INFRARED_RGB, np.float32))
        if table[:, 2].any():
            T = (T_world_imager * TEXTURE_PX_PER_M).astype(np.float32)
            u, v = (T[i, 0] * x_z + T[i, 1] * y_z + T[i, 2] * z + T[i, 3] for i in (0, 1))
            noise = cv2.remap(self._texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            noise *= texture
            noise += 1.0
            albedo *= np.maximum(noise, np.float32(TEXTURE_DARKEST), out=noise)
        return np.clip(albedo, 0.0, 1.0, out=albedo), specular, translucency

    def _dots(self, x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray, lit_m: np.ndarray) -> np.ndarray:
        """(H, W) brightness of the pattern on points given in the projector's frame; 0 in shadow."""
        p = self._projector
        inverse = 1.0 / np.maximum(z_m, np.float32(1e-3))
        u = x_m * inverse * np.float32(p.fx_px) + np.float32(p.cx_px - 0.5)
        v = y_m * inverse * np.float32(p.fy_px) + np.float32(p.cy_px - 0.5)
        nearest_m = cv2.remap(lit_m, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        t = np.float32(TEXELS_PER_PX)
        shift = np.float32((TEXELS_PER_PX - 1) / 2)
        dots = cv2.remap(self._pattern, u * t + shift, v * t + shift, cv2.INTER_LINEAR)
        return np.where(z_m > nearest_m + SHADOW_BIAS_M, np.float32(0), dots)

    def _speckle(self, rng: np.random.Generator) -> np.ndarray:
        """(H, W) factor of mean about 1 on laser light; each imager, at another place, sees its own."""
        shape = (self.profile.height_px, self.profile.width_px)
        factor = rng.standard_normal(shape, dtype=np.float32)
        factor *= np.float32(self.config.speckle_contrast)
        factor += 1.0
        return np.maximum(factor, 0.0, out=factor)

    def _expose(self, radiance: np.ndarray, exposure: float, rng: np.random.Generator) -> np.ndarray:
        """(H, W) uint8: blur of the lens, shot and read noise, saturation, quantisation."""
        c = self.config
        if c.lens_blur_px > 0:
            side = blur_side_px(c.lens_blur_px)
            radiance = cv2.GaussianBlur(radiance, (side, side), c.lens_blur_px)
        signal = np.minimum(radiance * np.float32(exposure), 1.0)
        sigma = np.sqrt(signal / np.float32(c.full_well_electrons) + np.float32(c.read_noise**2))
        picture = rng.standard_normal(signal.shape, dtype=np.float32)
        picture *= sigma
        picture += signal
        picture *= 255.0
        picture += 0.5
        return np.clip(picture, 0, 255, out=picture).astype(np.uint8)


def blur_side_px(sigma_px: float) -> int:
    """Side of the kernel for a Gaussian of `sigma_px`: 5, or beyond 0.8 px three sigma to either side."""
    return 5 if sigma_px <= 0.8 else 2 * math.ceil(3 * sigma_px) + 1


def _beside(T_world_cam: np.ndarray, x_m: float) -> np.ndarray:
    T = np.array(T_world_cam, float)
    T[:3, 3] += x_m * T[:3, 0]
    return T


def _camera(profile: CameraProfile, T_world_cam: np.ndarray, x_m: float) -> Camera:
    """The pinhole `x_m` to the right of T_world_cam, axes parallel."""
    return Camera.of(profile, _beside(T_world_cam, x_m))


def _projector_profile(profile: CameraProfile) -> CameraProfile:
    """A pinhole with the imager's focal length and a picture that is wider by as much on either side."""
    width = 2 * round(profile.width_px * PROJECTOR_MARGIN / 2)
    height = 2 * round(profile.height_px * PROJECTOR_MARGIN / 2)
    cx_px = profile.cx_px + (width - profile.width_px) / 2
    cy_px = profile.cy_px + (height - profile.height_px) / 2
    return replace(profile, width_px=width, height_px=height, cx_px=cx_px, cy_px=cy_px)


def _dot_pattern(config: StereoConfig, profile: CameraProfile, projector: CameraProfile) -> np.ndarray:
    """(h, w) float32 pattern, 1 at the centre of a lone dot, dimming towards the edges.

    Dots are Gaussians as wide as the imager resolves, so sampling the texture does not alias.
    """
    rng = np.random.default_rng(config.pattern_seed)
    area = projector.width_px * projector.height_px / (profile.width_px * profile.height_px)
    count = round(config.dots * area)
    height, width = projector.height_px * TEXELS_PER_PX, projector.width_px * TEXELS_PER_PX
    texture = np.zeros((height, width), np.float32)
    rows, columns = rng.integers(0, height, count), rng.integers(0, width, count)
    np.add.at(texture, (rows, columns), rng.uniform(0.6, 1.0, count).astype(np.float32))
    sigma = config.dot_radius_mrad / 1000 * projector.fx_px * TEXELS_PER_PX
    texture = cv2.GaussianBlur(texture, (0, 0), sigma) * (2 * math.pi * sigma**2)
    x = ((np.arange(width) + 0.5) / TEXELS_PER_PX - projector.cx_px) / projector.fx_px
    y = ((np.arange(height) + 0.5) / TEXELS_PER_PX - projector.cy_px) / projector.fy_px
    cosine = 1.0 / np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)
    return (np.minimum(texture, 2.0) * cosine**PROJECTOR_FALLOFF).astype(np.float32)


@lru_cache(maxsize=64)
def albedo_texture(
    height_px: int, width_px: int, seed: int = TEXTURE_SEED
) -> Float32[np.ndarray, "height width"]:
    """(height, width) float32 noise of unit variance over several octaves, seamless; `seed` is the scene.

    Read-only, and kept: 15 ms and 1 MB for one of 512 x 512, and scenes may take turns.
    """
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(height_px)[:, None], np.fft.fftfreq(width_px)[None, :])
    frequency[0, 0] = np.inf
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((height_px, width_px))) / frequency).real
    texture = (noise / noise.std()).astype(np.float32)
    texture.flags.writeable = False
    return texture


def _unit(x, y, z) -> tuple[np.ndarray, np.ndarray]:
    """((3, H, W) unit vectors, (H, W) lengths)."""
    vector = np.stack([x, y, z])
    length = np.sqrt(_dot(vector, vector))
    vector /= np.maximum(length, np.float32(1e-6))
    return vector, length


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    total = a[0] * b[0]
    total += a[1] * b[1]
    total += a[2] * b[2]
    return total


def _reflect(normal, to_light, to_view) -> tuple[np.ndarray, np.ndarray]:
    """Lambert's cosine and the Blinn-Phong highlight, (H, W) each."""
    diffuse = np.maximum(_dot(normal, to_light), 0)
    half = to_light + to_view
    highlight = np.maximum(_dot(normal, half), 0)
    highlight *= highlight
    highlight /= np.maximum(_dot(half, half), np.float32(1e-6))
    for _ in range(SHININESS_DOUBLINGS - 1):
        highlight *= highlight
    highlight *= diffuse > 0
    return diffuse, highlight
