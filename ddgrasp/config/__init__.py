"""Configuration of every stage: frozen dataclasses that check themselves, one file per stage.

A field's docstring is the command line's help; its type says what it may hold (checks.py).
"""

from dataclasses import dataclass, field
from typing import Annotated

from ddgrasp.config.checks import Range, Section, Seed, Text
from ddgrasp.config.ddg import (
    BOX,
    CROSS_ENTROPY,
    DDIM,
    DDPM,
    DEPTH,
    DEVIATION,
    DPM_SOLVER,
    FILTERED,
    HOLE_LOSSES,
    PIECEWISE,
    PLANES,
    PROGRESSIVE,
    SAMPLERS,
    SPACINGS,
    SQUARED,
    SURFACES,
    UNIFORM,
    DDGConfig,
    DDGDepthConfig,
    DDGDiffusionConfig,
    DDGTrainingConfig,
    GraftConfig,
    PriorConfig,
    PriorInSim,
    PriorSource,
    Sampler,
    SamplingConfig,
    UNetConfig,
)
from ddgrasp.config.demos import DemosConfig
from ddgrasp.config.deploy import (
    CAMERAS,
    ROBOTS,
    Camera,
    DeployConfig,
    FrankaConfig,
    RealSenseConfig,
    Robot,
)
from ddgrasp.config.evaluation import EvalConfig
from ddgrasp.config.export import DEPTH_DTYPES, ExportConfig
from ddgrasp.config.features import DepthFeatureConfig
from ddgrasp.config.record import RecordConfig
from ddgrasp.config.score import SCORE_COLUMNS, SCORE_FEATURES, ScoreConfig
from ddgrasp.config.sensors import (
    BY_COLOUR,
    SENSORS,
    DextrahConfig,
    KinectConfig,
    Sensor,
    SensorConfig,
    StereoConfig,
)
from ddgrasp.config.student import (
    GROUP_CHANNELS,
    STEM_STRIDE,
    DaggerConfig,
    EncoderConfig,
    HandViewConfig,
    HeadConfig,
    PictureConfig,
    PosesConfig,
    StudentConfig,
    StudentTrainingConfig,
)
from ddgrasp.config.teacher import GUIDE, NOTHING, HostsConfig, TeacherConfig
from ddgrasp.config.world import (
    BACKENDS,
    PAPER_REWARD,
    RENDERERS,
    Backend,
    CameraScale,
    RandomConfig,
    RewardConfig,
    WorldConfig,
)
from ddgrasp.errors import UserError


@dataclass(frozen=True)
class Config(Section):
    """Everything a run needs; a preset is one value of this."""

    preset: Text
    """The preset that values start from; any of them can be given besides."""
    seed: Seed = 0
    """Seed of all random numbers."""
    scale: Annotated[float, Range(0, 1, above=True)] = 1.0
    """Factor on the counts of the preset (steps, episodes, environments, trials, rounds), never on sizes of
    networks or pictures: below 1 a trial run, whose figures mean nothing. Counts given on their own stay."""
    world: WorldConfig = field(default_factory=WorldConfig)
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    record: RecordConfig = field(default_factory=RecordConfig)
    ddg: DDGConfig = field(default_factory=DDGConfig)
    student: StudentConfig = field(default_factory=StudentConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    deploy: DeployConfig = field(default_factory=DeployConfig)
    evaluation: EvalConfig = field(default_factory=EvalConfig)
    score: ScoreConfig = field(default_factory=ScoreConfig)

    def check(self) -> None:
        """See `Section.check`."""
        self._check_picture()
        self._check_exploring_starts()
        head = self.student.head
        if self.export.ddim_steps > head.diffusion_steps:
            raise self.export.error(
                "ddim_steps", f"1 to {head.diffusion_steps} (student.head.diffusion_steps), or 0"
            )
        if self.deploy.execute_steps > head.chunk:
            raise self.deploy.error("execute_steps", f"1 to {head.chunk} (student.head.chunk), or 0")

    def _check_exploring_starts(self) -> None:
        """PPO takes the teacher's; the world's would be in demos and trials alone."""
        for name in ("pregrasp_share", "pregrasp_turn_rad", "held_share"):
            if getattr(self.world.random, name) > 0:
                raise self.world.random.error(
                    name, f"0 in a run: only training has exploring starts, by teacher.{name}"
                )

    def _check_picture(self) -> None:
        """The student's picture is cut out of the camera's crop window, never enlarged."""
        profile, picture = self.world.profile, self.student.picture
        crop = (profile.crop_height_px, profile.crop_width_px)
        if picture.height_px > crop[0] or picture.width_px > crop[1]:
            raise UserError(
                f"student.picture is {picture.height_px} x {picture.width_px} pixels; at world.camera_scale "
                f"{self.world.camera_scale:g} the camera's crop window has {crop[0]} x {crop[1]}: take a "
                "smaller student.picture.height_px and width_px, or a larger camera_scale."
            )
        if (shift := self.student.training.crop_shift_px) > min(profile.crop_origin_px):
            raise UserError(
                f"student.training.crop_shift_px is {shift}; expected 0 to {min(profile.crop_origin_px)}, "
                f"the margin around the crop window at world.camera_scale {self.world.camera_scale:g}."
            )


__all__ = [
    "CAMERAS",
    "Camera",
    "ROBOTS",
    "Robot",
    "BACKENDS",
    "BOX",
    "RENDERERS",
    "Backend",
    "BY_COLOUR",
    "CROSS_ENTROPY",
    "CameraScale",
    "Config",
    "DDGConfig",
    "DDGDepthConfig",
    "DDGDiffusionConfig",
    "DDGTrainingConfig",
    "DDIM",
    "DDPM",
    "DEPTH",
    "DEPTH_DTYPES",
    "DEVIATION",
    "DPM_SOLVER",
    "DaggerConfig",
    "DemosConfig",
    "DeployConfig",
    "DepthFeatureConfig",
    "DextrahConfig",
    "EncoderConfig",
    "EvalConfig",
    "ExportConfig",
    "FILTERED",
    "FrankaConfig",
    "GUIDE",
    "GROUP_CHANNELS",
    "GraftConfig",
    "HOLE_LOSSES",
    "HandViewConfig",
    "HeadConfig",
    "HostsConfig",
    "KinectConfig",
    "NOTHING",
    "PAPER_REWARD",
    "PIECEWISE",
    "PLANES",
    "PROGRESSIVE",
    "PictureConfig",
    "PosesConfig",
    "PriorConfig",
    "PriorInSim",
    "PriorSource",
    "RandomConfig",
    "RealSenseConfig",
    "RecordConfig",
    "RewardConfig",
    "SAMPLERS",
    "SCORE_COLUMNS",
    "SCORE_FEATURES",
    "SENSORS",
    "SPACINGS",
    "SQUARED",
    "STEM_STRIDE",
    "SURFACES",
    "Sampler",
    "SamplingConfig",
    "ScoreConfig",
    "Sensor",
    "SensorConfig",
    "StereoConfig",
    "StudentConfig",
    "StudentTrainingConfig",
    "TeacherConfig",
    "UNIFORM",
    "UNetConfig",
    "WorldConfig",
]
