"""Configuration of every stage. Frozen dataclasses; field docstrings are the command line's help."""

from dataclasses import dataclass, field

from ddgrasp import contract


@dataclass(frozen=True)
class WorldConfig:
    """Scene, objects, randomisation."""

    objects: tuple[str, ...] = ("cube", "apple", "banana")
    """Objects to train on, mixed in one batch."""
    backend: str = "cpu"
    """Physics: cpu (MuJoCo's C engine on all cores) or jax (MJX)."""
    episode_steps: int = 60
    """Control steps in an episode (10 Hz)."""
    sim_dt_s: float = 0.005
    """Physics time step."""
    camera_scale: float = 0.25
    """Size of the depth camera's picture relative to 1280 x 720."""

    @property
    def profile(self) -> contract.CameraProfile:
        """The depth camera at this configuration's scale."""
        return contract.D455.scaled(self.camera_scale)


@dataclass(frozen=True)
class TeacherConfig:
    """PPO on the privileged state."""


@dataclass(frozen=True)
class DemosConfig:
    """Teacher episodes for the student."""


@dataclass(frozen=True)
class RecordConfig:
    """RGB-D recordings from the pseudo-real rig, and the rig's stereo camera."""


@dataclass(frozen=True)
class DDGConfig:
    """Diffusion Depth Generator."""


@dataclass(frozen=True)
class StudentConfig:
    """Depth-only diffusion policy."""


@dataclass(frozen=True)
class ExportConfig:
    """ONNX file."""


@dataclass(frozen=True)
class DeployConfig:
    """Control loop on the robot side."""


@dataclass(frozen=True)
class EvalConfig:
    """Trials behind every success rate."""

    teacher_trials: int = 300
    """Episodes of the teacher in its own simulation."""
    student_trials: int = 100
    """Episodes of the student on clean depth and on generated depth."""
    rig_trials: int = 60
    """Episodes of the exported student in the pseudo-real rig."""


@dataclass(frozen=True)
class Config:
    """Everything a run needs; a preset is one value of this."""

    preset: str
    seed: int = 0
    world: WorldConfig = field(default_factory=WorldConfig)
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    record: RecordConfig = field(default_factory=RecordConfig)
    ddg: DDGConfig = field(default_factory=DDGConfig)
    student: StudentConfig = field(default_factory=StudentConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    deploy: DeployConfig = field(default_factory=DeployConfig)
    evaluation: EvalConfig = field(default_factory=EvalConfig)
