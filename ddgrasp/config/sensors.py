"""Models of depth cameras: the rig's own stereo camera and the simpler ones it is compared with."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, get_args

from ddgrasp import contract
from ddgrasp.config.checks import Range, Section, Seed, Share, Text

Sensor = Literal["ideal", "dextrah", "kinect", "stereo", "learned"]
SENSORS: tuple[Sensor, ...] = get_args(Sensor)
BY_COLOUR: tuple[Sensor, ...] = ("stereo",)
"""Those that tell materials by colour."""
MarkerDictionary = Literal[
    "DICT_4X4_50", "DICT_4X4_250", "DICT_5X5_100", "DICT_6X6_250", "DICT_APRILTAG_36h11"
]
"""OpenCV's names of the ArUco markers that a calibration board may have."""
MARKER_DICTIONARIES: tuple[MarkerDictionary, ...] = get_args(MarkerDictionary)
_Window = Annotated[int, Range(1, 255)]
"""Side of a window in pixels."""

WINDOWS = ("block_px", "residual_window_px", "refine_window_px", "flat_window_px")
"""Fields of `StereoConfig` that are sides of a window."""


def odd(side_px: float) -> int:
    """The odd number nearest to `side_px`: a window that has a middle pixel."""
    return 2 * round((side_px - 1) / 2) + 1


@dataclass(frozen=True)
class StereoConfig(Section, name="record.stereo"):
    """The rig's active-stereo camera: projector, imagers, matcher (sensors/models/active_stereo.py)."""

    # --- projector ---
    projector_position: Share = 0.6
    """Where the projector sits between the left (0) and the right (1) imager."""
    dots: Annotated[int, Range(0, 1_000_000)] = 4000
    """Dots of the pattern in the imager's field of view."""
    dot_radius_mrad: Annotated[float, Range(0, 100, above=True)] = 3.3
    """Gaussian radius of a dot as the imagers see it."""
    projector_power: Annotated[float, Range(0, 1000)] = 1.8
    """Irradiance of a dot's centre at one metre, relative to the ambient light's."""
    speckle_contrast: Annotated[float, Range(0, 10)] = 0.27
    """Standard deviation of laser speckle relative to the dot's light, fresh in every frame and imager.
    Unlike shot noise it does not fade with range."""
    pattern_seed: Seed = 455
    """The pattern belongs to the device: the same in every frame."""
    # --- imagers ---
    exposure_target: Annotated[float, Range(0, 1, above=True)] = 0.5
    """Mean grey level the automatic exposure aims at, as a fraction of full scale."""
    full_well_electrons: Annotated[float, Range(1, 1_000_000_000)] = 10000.0
    """Electrons at full scale: shot noise."""
    read_noise: Share = 0.002
    """Standard deviation of read noise as a fraction of full scale."""
    lens_blur_px: Annotated[float, Range(0, 20)] = 0.45
    """Gaussian blur of the lens, pixels."""
    # --- matcher ---
    min_range_m: Annotated[float, Range(0.05, 100)] = round(contract.D455_STREAM.nearest_m, 3)
    """Nearer surfaces exceed the disparity search and are invalid; of a D455 as it is run."""
    max_range_m: Annotated[float, Range(0.05, 100)] = 6.0
    """Farther depth is reported as invalid."""
    block_px: _Window = 3
    """Matching window of the semi-global matcher."""
    smoothness: Annotated[float, Range(0, 100)] = 1.0
    """Scales the semi-global matcher's two penalties (8 and 32 per pixel of the window)."""
    uniqueness_percent: Annotated[int, Range(0, 100)] = 15
    """The best match must beat the second by this margin."""
    left_right_px: Annotated[int, Range(-1, 100)] = 1
    """Largest disagreement of the left-right check, pixels; 1 is the least, whatever is below it."""
    speckle_px: Annotated[int, Range(0, 100_000)] = 48
    """Smaller islands of disparity are removed."""
    residual_limit: Annotated[float, Range(0, 100, above=True)] = 1.15
    """Largest matching residual relative to the local contrast of both images; 1.4 is pure noise."""
    contrast_limit: Annotated[float, Range(0, 255)] = 8.0
    """Smallest local contrast of the left picture, grey levels of 255 (a D4xx's texture threshold): darker
    surfaces have no depth."""
    dark_limit: Annotated[float, Range(0, 255)] = 12.0
    """Grey levels of 255: darker surfaces have no signal. Measured over 3 px, so that the bright surroundings
    of a small dark object do not count, as they do for the contrast."""
    residual_window_px: _Window = 3
    """Window of that residual."""
    refine_window_px: _Window = 9
    """Window of the sub-pixel step."""
    flat_window_px: Annotated[int, Range(3, 255)] = 9
    """Window of the filter that smooths flat surfaces after it."""
    flat_noise_px: Annotated[float, Range(0, 10)] = 0.08
    """Disparity noise that filter takes away, standard deviation: larger relief stays. 0 switches it off."""
    subpixel_steps: Annotated[int, Range(1, 4096)] = 32
    """A pixel of disparity is reported in so many steps; a D4xx has 32."""

    def finer(self, factor: float) -> "StereoConfig":
        """For pictures of the same camera with `factor` times the pixels per side: larger windows."""
        windows = {name: odd(getattr(self, name) * factor) for name in WINDOWS}
        return replace(self, **windows, speckle_px=round(self.speckle_px * factor**2))

    def check(self) -> None:
        """See `Section.check`."""
        if self.min_range_m >= self.max_range_m:
            raise self.error("min_range_m", f"less than max_range_m, {self.max_range_m}")
        for name in WINDOWS:
            if getattr(self, name) % 2 == 0:
                raise self.error(name, "an odd number: the window has a middle pixel")


@dataclass(frozen=True)
class DextrahConfig(Section, name="sensor.dextrah"):
    """Depth noise with the numbers that DextrAH-G trains with, there in pixels of 160 x 120 pictures, here in
    those of whatever picture is given; what else differs from its published code: docs/sensors.md."""

    shift_px: Annotated[float, Range(0, 100)] = 0.5
    """Standard deviation of the field by which pixels look up their depth beside themselves (sigma_s)."""
    disparity_px: Annotated[float, Range(0, 100)] = 1 / 48
    """Standard deviation of disparity noise (sigma_d, a sixth of a step of 1/8 px)."""
    correlation_px: Annotated[float, Range(0, 1000, above=True)] = 2.0
    """Distance over which both fields vary."""
    normal_m: Annotated[float, Range(0, 1)] = 0.0
    """Standard deviation by which every pixel by itself is moved along its surface's normal; 0.01 in
    DextrAH-G's published code (sigma_theta)."""
    dropout: Share = 0.0125 / 4
    """Probability that a pixel becomes invalid."""
    random_value: Share = 0.0125 / 4
    """Probability that a pixel takes a random depth."""
    random_near_m: Annotated[float, Range(0, 100, above=True)] = 0.3
    """Nearest random depth."""
    random_far_m: Annotated[float, Range(0, 100, above=True)] = 2.0
    """Farthest random depth."""
    stick: Share = 0.001 / 4
    """Probability that a stick starts at a pixel."""
    stick_length_px: Annotated[float, Range(1, 4096)] = 18.0
    """Longest stick."""
    stick_width_px: Annotated[float, Range(1, 4096)] = 3.0
    """Widest stick."""

    def check(self) -> None:
        """See `Section.check`."""
        if self.random_near_m > self.random_far_m:
            raise self.error("random_near_m", f"at most random_far_m, {self.random_far_m}")

    def scaled(self, scale: float) -> "DextrahConfig":
        """The same noise for a picture `scale` times as wide of the same scene: lengths and disparities grow
        with it, as many sticks fall on a picture, of a pixel at least, and the same share of single pixels is
        lost."""
        lengths = ("shift_px", "disparity_px", "correlation_px")
        grown = {name: scale * getattr(self, name) for name in lengths}
        sticks = ("stick_length_px", "stick_width_px")
        grown |= {name: max(1.0, scale * getattr(self, name)) for name in sticks}
        return replace(self, stick=self.stick / scale**2, **grown)


@dataclass(frozen=True)
class KinectConfig(Section, name="sensor.kinect"):
    """Depth noise of a structured-light camera of the first Kinect's kind (sensors/models/procedural.py)."""

    shift_px: Annotated[float, Range(0, 100)] = 0.5
    """Standard deviation of each pixel's shift, independent per pixel (Handa et al. 2014)."""
    axial_per_m: Annotated[float, Range(0, 1)] = 1.425e-3
    """Standard deviation of depth at one metre; it grows with the square (Khoshelham and Elberink 2012)."""
    steps_per_px: Annotated[float, Range(0, 1_000_000, above=True)] = 8.0
    """Disparity is reported in 1/8 of a pixel."""


@dataclass(frozen=True)
class SensorConfig(Section, name="sensor"):
    """A model of a depth camera: clean depth to what the camera would report."""

    name: Sensor = "stereo"
    """ideal, dextrah, kinect, stereo (the rig's camera) or learned (a fitted generator)."""
    dextrah: DextrahConfig = field(default_factory=DextrahConfig)
    kinect: KinectConfig = field(default_factory=KinectConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    learned_from: Text = ""
    """Stage directory of a fitted generator (`ddgrasp ddg fit`), for learned."""
