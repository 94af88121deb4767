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

    # --- what the network sees (student_jax/preprocess.py) ---
    input_height_px: int = 112
    """Rows of the picture given to the encoder."""
    input_width_px: int = 144
    """Columns of the picture given to the encoder."""
    channels: tuple[str, ...] = ("relief", "valid")
    """Per frame: relief (height over the empty table along the ray), valid (0 or 1), depth (metres)."""
    min_depth_m: float = 0.1
    """Nearer readings are treated as invalid."""
    max_depth_m: float = 2.5
    """Farther readings are treated as invalid."""
    # --- encoder (student_jax/encoder.py) ---
    stem: str = "space_to_depth"
    """conv7 (the paper's ResNet: 7x7 stride 2 and max pooling) or space_to_depth (4x4 patches; cheap on CPU)."""
    width: int = 16
    """Channels of the first stage; the paper's ResNet-18 has 64."""
    stage_blocks: tuple[int, ...] = (2, 2, 2, 2)
    """Basic blocks per stage; each stage doubles the channels. (2, 2, 2, 2) is ResNet-18."""
    max_channels: int = 512
    """Channels never exceed this, whatever the stage."""
    output_stride: int = 8
    """Pixels per cell of the encoder's last map: 4, 8, 16 or 32 (ResNet's own). Later stages keep the resolution."""
    norm: str = "group"
    """group (GroupNorm) or none."""
    pooling: str = "spatial_softmax"
    """spatial_softmax (keypoints in the robot's frame), tokens (every cell, projected) or mean."""
    keypoints: int = 32
    """Keypoints of spatial_softmax, or channels per cell of tokens."""
    feature_size: int = 128
    """Length of the encoder's output vector."""
    aux_to_head: bool = True
    """Give the predicted object position, grasp yaw and held probability to the action head."""
    aux_stop_gradient: bool = False
    """Keep the action loss from changing the auxiliary predictions."""
    # --- action head (student_jax/denoiser.py) ---
    chunk: int = 4
    """Actions predicted at once."""
    state_features: int = 64
    """Width of the joint-state stream."""
    denoiser_width: int = 256
    """Width of the denoiser's residual blocks."""
    denoiser_blocks: int = 3
    """Residual blocks of the denoiser."""
    conditioning: str = "film"
    """How the denoiser sees its condition: film (scale and shift in every block) or concat (at its input)."""
    time_features: int = 64
    """Length of the sinusoidal embedding of the diffusion step."""
    diffusion_steps: int = 50
    """Steps K of the forward process."""
    ddim_steps: int = 10
    """Denoising iterations when acting."""


@dataclass(frozen=True)
class ExportConfig:
    """ONNX file."""

    depth_dtype: str = "uint16_mm"
    """What the file's depth input takes: uint16_mm (as cameras deliver it) or float32_m."""
    ddim_steps: int = 0
    """Denoising iterations inside the file; 0 means the student's own."""
    parity_batches: int = 25
    """Batches of four on which JAX and onnxruntime are compared."""
    latency_runs: int = 200
    """Single inferences timed on one thread."""
    max_abs_diff: float = 1e-4
    """Largest accepted difference between the JAX and the ONNX action."""


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
