"""Configuration of every stage. Frozen dataclasses; field docstrings are the command line's help."""

from dataclasses import dataclass, field
from typing import Any

from ddgrasp import contract
from ddgrasp.errors import UserError, unknown_name

SQUARED, CROSS_ENTROPY = HOLE_LOSSES = ("squared", "cross_entropy")
UNIFORM, TRUNCATED = LOSS_WEIGHTS = ("uniform", "truncated")
DPM_SOLVER, DDIM, DDPM, PROGRESSIVE = SAMPLERS = ("dpm_solver", "ddim", "ddpm", "progressive")
SPACINGS = ("leading", "trailing", "linspace", "quadratic")
"""Of the diffusion steps that a sampler visits: learning/diffusion.py, timesteps."""


def _check_counts(section: str, config: Any, *names: str) -> None:
    for name in names:
        if (value := getattr(config, name)) < 1:
            raise UserError(f"{section}.{name} is {value}; expected at least 1.")


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward terms (paper Eq. 2 and its terms; `ours` marks what the paper lacks)."""

    reach: float = 10.0
    """w1, per metre."""
    lift: float = 10.0
    """w2, per metre."""
    orient: float = 0.5
    """w3, per radian, once lifted."""
    accel: float = 3e-5
    """w4, per (rad/s^2)^2."""
    bonus_base: float = 1.1
    """c1 > 1."""
    bonus_growth: float = 1.08
    """c2 > 1."""
    bonus_max_count: int = 10
    """N_success is capped here, which keeps the bonus finite."""
    align: float = 0.5
    """Ours: per radian of misalignment with the grasp pose removed before the lift."""
    saturation: float = 0.01
    """Ours: penalty on the squared part of an action beyond 0.8 of its range."""
    grasp: float = 0.1
    """Ours: per step with the object in the hand."""
    toggle: float = 0.005
    """Ours: penalty on each change of the gripper's command; 0.05 kept the gripper open for good."""


@dataclass(frozen=True)
class RandomConfig:
    """Half-ranges of the randomisation, uniform, drawn once per episode (paper III-C1)."""

    joint_rad: float = 0.1
    """Initial arm joints around home."""
    pregrasp_share: float = 0.0
    """Share of episodes that start with the hand above the object (exploring starts, for training only)."""
    other_pose_share: float = 0.5
    """Share of episodes in which an object that can both lie and stand rests in its other pose."""
    size: float = 0.05
    """Relative size of the object."""
    object_mass: float = 0.3
    """Relative."""
    object_friction: float = 0.2
    """Relative."""
    link_mass: float = 0.1
    """Relative, each link."""
    damping: float = 0.3
    """Relative joint damping, each joint."""
    friction_nm: float = 0.3
    """Joint dry friction in [0, friction_nm], each joint."""
    stiffness: float = 0.1
    """Relative gain of the joint position controllers, each joint."""
    camera_position_m: float = 0.01
    """Each axis."""
    camera_angle_rad: float = 0.015
    """Each axis."""
    crop_px: int = 24
    """Not read by any stage: the student's training shifts its window by student.crop_shift_px. Kept so
    that earlier manifests load."""
    latency_share: float = 0.0
    """Share of episodes in which every command takes effect one control step late."""


@dataclass(frozen=True)
class WorldConfig:
    """Scene, objects, randomisation."""

    objects: tuple[str, ...] = contract.SEEN_OBJECTS
    """Objects, mixed in one batch (`ddgrasp objects list` names them all)."""
    backend: str = "cpu"
    """Physics: cpu (MuJoCo's C engine on all cores), jax (MJX) or warp (MJX-Warp, on an NVIDIA GPU)."""
    episode_steps: int = 60
    """Control steps in an episode (10 Hz)."""
    sim_dt_s: float = 0.005
    """Physics time step; at 10 ms grasped objects are ejected (a scripted expert: 5 %, at 5 ms 97 %)."""
    camera_scale: float = 0.25
    """Size of the depth camera's picture relative to 1280 x 720."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    random: RandomConfig = field(default_factory=RandomConfig)

    @property
    def profile(self) -> contract.CameraProfile:
        """The depth camera at this configuration's scale."""
        return contract.D455.scaled(self.camera_scale)

    def __post_init__(self) -> None:
        _check_counts("world", self, "episode_steps")


@dataclass(frozen=True)
class TeacherConfig:
    """PPO on the privileged state."""

    total_steps: int = 2_000_000
    """Control steps of experience."""
    num_envs: int = 512
    """Environments stepped together."""
    unroll_steps: int = 20
    """Control steps between updates."""
    minibatches: int = 8
    """Gradient steps per epoch; must divide num_envs."""
    epochs: int = 4
    """Passes over each batch of experience."""
    learning_rate: float = 2e-5
    """Adam's step size for the policy at the start; decays linearly to a tenth. 3e-4 undid a cloned policy
    within five iterations."""
    critic_learning_rate: float = 5e-4
    """The same for the value network."""
    discount: float = 0.97
    gae_lambda: float = 0.95
    action_std: float = 0.15
    """Standard deviation of the exploration noise at the start, before the tanh."""
    entropy_cost: float = 1e-3
    clip: float = 0.2
    """PPO's clipping range."""
    reward_scaling: float = 0.5
    max_grad_norm: float = 1.0
    hidden: tuple[int, ...] = (256, 128)
    """Layers of policy and value networks."""
    pregrasp_share: float = 0.2
    """Share of training episodes that start with the hand above the object (exploring starts)."""
    clone_rounds: int = 8
    """DAgger rounds in which the policy network learns the guide (ppo/guide.py) before PPO; 0 starts
    PPO from nothing."""
    clone_envs: int = 192
    """Episodes per such round."""
    clone_steps: int = 500
    """Optimiser steps per such round."""
    critic_warmup: int = 10
    """Iterations in which the critic alone learns, so that it does not mislead a cloned policy."""
    eval_every: int = 20
    """Updates between deterministic evaluations."""
    checkpoint_every: int = 20
    """Updates between whole-state checkpoints."""
    stop_at: float = 1.0
    """End early once two evaluations in a row reach this success rate."""
    init_from: str = ""
    """Run directory or pretrained folder whose policy to start from; total_steps 0 uses it as it is."""

    def __post_init__(self) -> None:
        _check_counts(
            "teacher", self, "num_envs", "unroll_steps", "minibatches",
            "epochs", "eval_every", "checkpoint_every",
        )  # fmt: skip
        if self.num_envs % self.minibatches:
            raise UserError(
                f"teacher.num_envs {self.num_envs} is no multiple of teacher.minibatches {self.minibatches}: "
                "change one of them."
            )


@dataclass(frozen=True)
class HostsConfig:
    """Several processes, usually one per host, that train as one. Not part of a run's configuration: the same
    run may go on with another number of them."""

    coordinator: str = ""
    """Address (host:port) of process 0, the same on every host; auto asks Slurm, Open MPI, Kubernetes or a
    TPU pod, which name the processes too; empty for one process."""
    processes: int = 1
    """Number of processes."""
    process: int = 0
    """This process, from 0; 0 alone writes logs, policies and manifests."""

    def __post_init__(self) -> None:
        named = self.coordinator not in ("", "auto")
        _check_counts("hosts", self, "processes")
        if named and not (
            self.coordinator.rpartition(":")[0] and self.coordinator.rpartition(":")[2].isdigit()
        ):
            raise UserError(f"hosts.coordinator is {self.coordinator!r}; expected host:port, or auto.")
        if not named and (self.processes, self.process) != (1, 0):
            raise UserError(
                f"hosts.processes is {self.processes}, hosts.process {self.process}, hosts.coordinator "
                f"{self.coordinator!r}: give the address (host:port) of process 0."
            )
        if not 0 <= self.process < self.processes:
            raise UserError(
                f"hosts.process is {self.process}; expected 0 to {self.processes - 1} (hosts.processes is "
                f"{self.processes})."
            )


@dataclass(frozen=True)
class DemosConfig:
    """Teacher episodes for the student."""

    episodes: int = 240
    """Successful episodes to keep (the paper: about 1200)."""
    parallel: int = 60
    """Environments rolled out together."""
    action_noise: float = 0.4
    """Standard deviation of the perturbations of the executed actions; labels stay the teacher's."""
    noise_share: float = 0.05
    """Probability per step that a perturbation of four steps starts."""
    rgb: bool = True
    """Keep colour as well."""

    def __post_init__(self) -> None:
        _check_counts("demos", self, "episodes", "parallel")


@dataclass(frozen=True)
class StereoConfig:
    """The rig's active-stereo camera: projector, imagers, matcher (sensors/models/active_stereo.py)."""

    # --- projector ---
    projector_position: float = 0.6
    """Where the projector sits between the left (0) and the right (1) imager."""
    dots: int = 4000
    """Dots of the pattern in the imager's field of view."""
    dot_radius_mrad: float = 3.3
    """Gaussian radius of a dot as the imagers see it."""
    projector_power: float = 1.8
    """Irradiance of a dot's centre at one metre, relative to the ambient light's."""
    speckle_contrast: float = 0.27
    """Standard deviation of laser speckle relative to the dot's light, fresh in every frame and imager.
    Unlike shot noise it does not fade with range."""
    pattern_seed: int = 455
    """The pattern belongs to the device: the same in every frame."""
    # --- imagers ---
    exposure_target: float = 0.5
    """Mean grey level the automatic exposure aims at, as a fraction of full scale."""
    full_well_electrons: float = 10000.0
    """Electrons at full scale: shot noise."""
    read_noise: float = 0.002
    """Standard deviation of read noise as a fraction of full scale."""
    lens_blur_px: float = 0.45
    """Gaussian blur of the lens, pixels."""
    # --- matcher ---
    min_range_m: float = 0.35
    """Nearer surfaces exceed the disparity search and are invalid."""
    max_range_m: float = 6.0
    """Farther depth is reported as invalid."""
    block_px: int = 3
    """Matching window of the semi-global matcher."""
    smoothness: float = 1.0
    """Scales the semi-global matcher's two penalties (8 and 32 per pixel of the window)."""
    uniqueness_percent: int = 15
    """The best match must beat the second by this margin."""
    left_right_px: int = 1
    """Largest disagreement of the left-right check, pixels."""
    speckle_px: int = 48
    """Smaller islands of disparity are removed."""
    residual_limit: float = 1.15
    """Largest matching residual relative to the local contrast of both images; 1.4 is pure noise."""
    contrast_limit: float = 8.0
    """Smallest local contrast of the left picture, grey levels of 255 (a D4xx's texture threshold): darker
    surfaces have no depth."""
    dark_limit: float = 12.0
    """Grey levels of 255: darker surfaces have no signal. Measured over 3 px, so that the bright surroundings
    of a small dark object do not count, as they do for the contrast."""
    residual_window_px: int = 3
    """Window of that residual."""
    refine_window_px: int = 9
    """Window of the sub-pixel step."""
    flat_window_px: int = 9
    """Window of the filter that smooths flat surfaces after it."""
    flat_noise_px: float = 0.08
    """Disparity noise that filter takes away, standard deviation: larger relief stays. 0 switches it off."""
    subpixel_steps: int = 32
    """Disparity is reported in 1/32 of a pixel, as D4xx cameras do."""


@dataclass(frozen=True)
class DextrahConfig:
    """Depth noise as DextrAH-G trains with, in pixels of its 160 x 120 pictures."""

    shift_px: float = 0.5
    """Standard deviation of the field by which pixels look up their depth beside themselves (sigma_s)."""
    disparity_px: float = 1 / 48
    """Standard deviation of disparity noise (sigma_d, a sixth of a step of 1/8 px)."""
    correlation_px: float = 2.0
    """Distance over which both fields vary."""
    dropout: float = 0.0125 / 4
    """Probability that a pixel becomes invalid."""
    random_value: float = 0.0125 / 4
    """Probability that a pixel takes a random depth."""
    random_near_m: float = 0.3
    """Nearest random depth."""
    random_far_m: float = 2.0
    """Farthest random depth."""
    stick: float = 0.001 / 4
    """Probability that a stick starts at a pixel."""
    stick_length_px: float = 18.0
    """Longest stick."""
    stick_width_px: float = 3.0
    """Widest stick."""


@dataclass(frozen=True)
class KinectConfig:
    """Depth noise of a structured-light camera of the first Kinect's kind (sensors/models/procedural.py)."""

    shift_px: float = 0.5
    """Standard deviation of each pixel's shift, independent per pixel (Handa et al. 2014)."""
    axial_per_m: float = 1.425e-3
    """Standard deviation of depth at one metre; it grows with the square (Khoshelham and Elberink 2012)."""
    steps_per_px: float = 8.0
    """Disparity is reported in 1/8 of a pixel."""


SENSORS = ("ideal", "dextrah", "kinect", "stereo", "learned")
"""Camera models (ddg_jax/sensor.py)."""


@dataclass(frozen=True)
class SensorConfig:
    """A model of a depth camera: clean depth to what the camera would report."""

    name: str = "stereo"
    """ideal, dextrah, kinect, stereo (the rig's camera) or learned (a fitted generator)."""
    dextrah: DextrahConfig = field(default_factory=DextrahConfig)
    kinect: KinectConfig = field(default_factory=KinectConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    learned_from: str = ""
    """Stage directory of a fitted generator (`ddgrasp ddg fit`), for learned."""


@dataclass(frozen=True)
class RecordConfig:
    """RGB-D recordings from the pseudo-real rig, and the rig's stereo camera."""

    trajectories: int = 24
    """Recorded episodes of the teacher, objects in turn."""
    frames: int = 60
    """Frames per trajectory, at the control rate."""
    camera_position_jitter_m: float = 0.05
    """Half width of the camera's uniform displacement per trajectory."""
    camera_aim_jitter_m: float = 0.04
    """Half width of the uniform displacement of the point it looks at."""
    camera_roll_jitter_rad: float = 0.05
    """Half width of its uniform roll."""
    stereo: StereoConfig = field(default_factory=StereoConfig)
    """The camera itself."""

    def __post_init__(self) -> None:
        _check_counts("record", self, "trajectories", "frames")


@dataclass(frozen=True)
class DDGConfig:
    """Diffusion Depth Generator."""

    # --- depth as the diffusion model sees it (ddg_jax/representation.py) ---
    representation: str = "deviation"
    """What the network draws: deviation (holes, and how far the sensor is off the surface) or depth (the
    paper's: the depth map itself)."""
    height_px: int = 180
    """Rows of the generated map."""
    width_px: int = 320
    """Columns of the generated map."""
    near_m: float = 0.25
    """Nearest depth that is told apart (representation depth)."""
    far_m: float = 10.0
    """Farthest depth that is told apart (representation depth), and that a monocular baseline may have."""
    noise_threshold: float = 0.4
    """The paper's: below it a generated pixel is a hole. Holes are -1, surfaces 1 (depth: 0 to 1, which
    needs a negative one, for example -0.2; docs/generator.md)."""
    deviation_threshold: float = 0.0005
    """Smallest deviation of inverse depth, 1/m, that is an artefact and grafted: 1/32 px of disparity, here a
    D455's; 0.0016 for a D435 at 640x480 (deviation only). 1 grafts holes alone."""
    surface: str = "filtered"
    """The surface that recorded depth deviates from: filtered (fast), or piecewise (planes with sharp edges;
    nearer to the truth, 0.1 to 0.3 s a frame; ddg_jax/piecewise.py)."""
    # --- geometric prior c (ddg_jax/prior.py) ---
    prior: str = "inverse_depth"
    """Where c comes from: inverse_depth (normalised, built in), metric_inverse_depth (not normalised: for
    cameras that move), video_depth_anything (the paper's) or depth_anything_v2."""
    prior_weights: str = ""
    """Folder of the network's converted weights; empty takes weights/<prior>_small."""
    prior_in_sim: str = "depth"
    """What a network's prior is in simulation: depth (simulated depth, normalised alike) or rgb (the
    network).
    """
    prior_input_px: int = 518
    """Shorter side of the pictures that the network sees."""
    prior_dtype: str = "float32"
    """The network's arithmetic: float32 or bfloat16."""
    prior_blur_px: float = 1.0
    """Gaussian blur of c in pixels: hides where a recording's holes were filled."""
    prior_noise: float = 0.03
    """Standard deviation of noise added to c in training and sampling, for the same reason."""
    prior_jitter: float = 0.1
    """Relative scale and shift of c varied in training, so that it need not match to the last percent."""
    decoy_holes: float = 0.5
    """Share of recorded frames whose prior is filled under another frame's holes as well."""
    # --- U-Net (ddg_jax/unet.py) ---
    space_to_depth: int = 4
    """Pixels per side folded into channels before the U-Net."""
    widths: tuple[int, ...] = (64, 64, 96)
    """Channels per level; every level halves height and width."""
    blocks: tuple[int, ...] = (0, 1, 0)
    """Residual blocks per level, in the encoder and again in the decoder; two more sit in the middle."""
    attention_heads: int = 4
    """Attention heads in the middle; 0 turns attention off."""
    # --- diffusion (learning/diffusion.py) ---
    diffusion_steps: int = 1000
    """Steps K of the forward process."""
    schedule: str = "cosine"
    """Noise schedule: cosine or linear."""
    log_snr_shift: float = 0.0
    """Moves the schedule's log signal-to-noise ratio; negative is noisier."""
    # --- training (ddg_jax/train.py) ---
    train_steps: int = 1500
    """Optimiser steps."""
    batch_size: int = 16
    """Frames per step."""
    learning_rate: float = 1e-3
    """AdamW's step size after the warm-up; falls to a twentieth along a cosine."""
    weight_decay: float = 1e-4
    """AdamW's weight decay."""
    hole_loss: str = "squared"
    """What the hole channel is trained by: squared error (the paper's, as all channels) or cross_entropy (of
    log odds: sharper layouts from more and smaller steps, ddg_jax/train.py; deviation only)."""
    loss_weight: str = "truncated"
    """Weight of a diffusion step's error: uniform (the paper's) or truncated (more weight on noisy steps,
    which few-step sampling needs)."""
    snr_limits: tuple[float, float] = (1.0, 25.0)
    """Least and greatest weight of an error in the clean map (truncated only). The upper one counts in slight
    noise, where single pixels and roughness are decided; the layout of holes is decided in strong noise."""
    ema_decay: float = 0.995
    """Decay of the averaged parameters, which are the ones used."""
    checkpoint_every: int = 250
    """Steps between whole-state checkpoints."""
    holdout_fraction: float = 0.1
    """Share of the frames, the last ones, kept out of training for the statistics and pictures."""
    init_from: str = ""
    """Folder with a fitted generator to use instead of fitting one; empty fits."""
    # --- sampling (ddg_jax/sample.py) ---
    sampler: str = "dpm_solver"
    """dpm_solver (second order), ddim, ddpm (ancestral) or progressive (distilled to sample_steps
    evaluations, ddg_jax/distil.py)."""
    sample_steps: int = 4
    """Network evaluations per map."""
    sample_spacing: str = "quadratic"
    """Which diffusion steps they visit: trailing, leading or linspace (equal steps, named as in the
    literature) or quadratic (short ones at the end, where the noise on surfaces is decided)."""
    distil_from: int = 16
    """Evaluations of the fitted network from which distillation starts; sample_steps times a power of two."""
    distil_steps: int = 150
    """Optimiser steps per halving of the evaluations (sampler progressive only)."""
    eta: float = 0.0
    """Fresh noise in DDIM: 0 none, 1 as much as DDPM."""
    frame_correlation: float = 0.8
    """Share of the noise's variance (the initial one's, the prior's, and eta's) that the frames of an episode
    have in common: decides the flicker of holes (docs/generator.md)."""
    deviation_correlation: float = 0.0
    """The same for the noise that deviations come from: decides how surfaces change in time (representation
    deviation only)."""
    sample_batch: int = 16
    """Frames generated together on each device."""

    def __post_init__(self) -> None:
        _check_counts(
            "ddg", self, "diffusion_steps", "batch_size", "checkpoint_every", "sample_steps", "sample_batch",
            "distil_steps",
        )  # fmt: skip
        if not 0 <= self.deviation_threshold < float("inf"):
            raise UserError(
                f"ddg.deviation_threshold is {self.deviation_threshold}; expected 0 or more in 1/m, and 1 to "
                "graft holes alone."
            )
        for name, choices in (
            ("hole_loss", HOLE_LOSSES),
            ("loss_weight", LOSS_WEIGHTS),
            ("sampler", SAMPLERS),
            ("sample_spacing", SPACINGS),
        ):
            if getattr(self, name) not in choices:
                raise unknown_name(f"ddg.{name}", getattr(self, name), choices)
        if not 0 <= self.eta <= 1:
            raise UserError(f"ddg.eta is {self.eta}; expected 0 (no fresh noise) to 1 (DDPM's).")
        if self.hole_loss == CROSS_ENTROPY and self.representation != "deviation":
            raise UserError(
                f"ddg.hole_loss {CROSS_ENTROPY} needs holes in a channel of their own: ddg.representation is "
                f"{self.representation}; take deviation, or hole_loss {SQUARED}."
            )
        if self.hole_loss == CROSS_ENTROPY and self.sampler == PROGRESSIVE:
            raise UserError(
                f"ddg.sampler {PROGRESSIVE} distils squared errors: ddg.hole_loss is {CROSS_ENTROPY}, whose "
                f"holes cannot leave -1 to 1 as a distilled step must; take sampler ddim with 2 to 4 "
                f"sample_steps, or hole_loss {SQUARED}."
            )
        if not 0 < self.snr_limits[0] <= self.snr_limits[1] < float("inf"):
            raise UserError(
                f"ddg.snr_limits is {self.snr_limits}; expected two numbers above 0, the smaller one first."
            )
        if self.representation == "depth" and self.noise_threshold > 0:
            raise UserError(
                f"ddg.noise_threshold is {self.noise_threshold}; with ddg.representation depth surfaces are "
                "0 to 1 and would be holes: expected 0 or less, for example -0.2."
            )
        halvings, rest = divmod(self.distil_from, self.sample_steps)
        if self.sampler == "progressive" and (rest or halvings < 2 or halvings & (halvings - 1)):
            raise UserError(
                f"ddg.distil_from is {self.distil_from} and ddg.sample_steps {self.sample_steps}: sampler "
                "progressive halves the one until it is the other; expected for example 8 and 4, 2 or 1."
            )


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
    """conv7 (the paper's: 7x7 stride 2, max pooling) or space_to_depth (4x4 patches; cheap on CPU)."""
    width: int = 16
    """Channels of the first stage; the paper's ResNet-18 has 64."""
    stage_blocks: tuple[int, ...] = (2, 2, 2)
    """Basic blocks per stage; each stage doubles the channels. (2, 2, 2, 2) is ResNet-18."""
    max_channels: int = 512
    """Channels never exceed this, whatever the stage."""
    output_stride: int = 8
    """Pixels per cell of the last feature map: 4, 8, 16 or 32 (ResNet's own); later stages keep it."""
    norm: str = "group"
    """group (GroupNorm) or none."""
    pooling: str = "spatial_softmax"
    """spatial_softmax (keypoints in the robot's frame), tokens (every cell, projected) or mean."""
    keypoints: int = 32
    """Keypoints of spatial_softmax, or channels per cell of tokens."""
    feature_size: int = 128
    """Length of the encoder's output vector."""
    encoder_weights: str = ""
    """Folder of converted ImageNet ResNet-18 weights that the encoder starts from; empty starts at random."""
    # --- hand view (student_jax/hand_view.py) ---
    hand_view_px: int = 48
    """Samples per side of the picture around the hand; 0 turns the hand view off."""
    hand_view_pitch_m: float = 0.004
    """Distance of its samples, metres at the hand's distance from the camera."""
    hand_view_width: int = 32
    """Channels of its convolutions."""
    hand_view_blocks: int = 2
    """Its basic blocks."""
    hand_view_channels: int = 8
    """Channels kept per 4x4 patch before they are flattened."""
    hand_view_features: int = 96
    """Length of its output vector."""
    # --- action head (student_jax/policy.py, denoiser.py) ---
    features_to_head: bool = False
    """Give the encoder's vector to the action head."""
    aux_to_head: bool = True
    """Give the predicted object position, grasp yaw and held probability to the action head."""
    chunk: int = 2
    """Actions predicted at once."""
    execute_steps: int = 1
    """Actions of a chunk that are executed before the policy looks again."""
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
    # --- training (student_jax/train.py) ---
    train_steps: int = 1500
    """Optimiser steps on the demos."""
    batch_size: int = 64
    """Samples per step."""
    noise_draws: int = 8
    """Diffusion steps and noises drawn for each encoded sample: the encoder is what costs."""
    learning_rate: float = 1e-3
    """AdamW's step size after the warm-up; falls to a fiftieth along a cosine."""
    weight_decay: float = 1e-4
    """AdamW's weight decay."""
    ema_decay: float = 0.995
    """Decay of the averaged parameters, which are the ones used."""
    aux_weight: float = 1.0
    """Weight of the privileged losses (position, yaw, held) on pictures."""
    action_weight: float = 0.0
    """Weight of the diffusion loss on pictures; 0 trains the head on what perception reports instead."""
    held_weight: float = 0.4
    """How often a step with the object in the hand is drawn, relative to one before the grasp."""
    demo_held_steps: int = 20
    """Steps of a demo kept from the grasp on: the lift and a little of the hold."""
    # --- head on true poses (student_jax/privileged.py) ---
    pose_rounds: int = 8
    """DAgger rounds without pictures, in which the head learns to act from noisy true poses; 0 for none."""
    pose_episodes: int = 256
    """Episodes per such round."""
    pose_steps: int = 1000
    """Optimiser steps per such round."""
    clean_share: float = 0.2
    """Share of the episodes that keep clean depth."""
    crop_shift_px: int = 6
    """Random shift of the crop window in training, pixels of the scaled picture, each way."""
    disparity_noise_px: float = 0.25
    """Largest standard deviation of the noise on valid pixels in training, pixels of disparity at the
    picture's scale (the rig: about 0.07); 0 keeps them exact."""
    # --- DAgger (student_jax/dagger.py) ---
    dagger_rounds: int = 4
    """Rounds of acting with the student and labelling by the teacher."""
    dagger_episodes: int = 64
    """Episodes per round."""
    dagger_steps: int = 600
    """Optimiser steps after each round, on all frames so far."""
    dagger_teacher_share: float = 0.3
    """Share of the first round's actions that the teacher takes; falls linearly to none."""
    head_steps: int = 4000
    """Steps of the action head alone at the end, on cached features."""
    head_batch_size: int = 512
    """Samples per head step."""
    init_from: str = ""
    """Run directory or pretrained folder whose student to start from; empty starts from nothing."""
    depth_source: str = "learned"
    """What gives the demos' clean depth a camera's artefacts: learned (the run's generator), ideal (nothing),
    dextrah, kinect or stereo (the rig's camera on the clean picture; needs demos.rgb)."""

    def __post_init__(self) -> None:
        if self.depth_source not in SENSORS:
            raise unknown_name("student.depth_source", self.depth_source, SENSORS)
        _check_counts(
            "student", self, "chunk", "execute_steps", "diffusion_steps",
            "ddim_steps", "batch_size", "noise_draws", "head_batch_size",
        )  # fmt: skip


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

    def __post_init__(self) -> None:
        _check_counts("export", self, "parity_batches", "latency_runs")


@dataclass(frozen=True)
class DeployConfig:
    """Control loop on the robot side."""

    noise: str = "zero"
    """Start of the reverse diffusion: zero (deterministic) or normal (seeded)."""
    execute_steps: int = 0
    """Actions played from a chunk before the network runs again; 0 takes the exported file's own."""
    stale_periods: float = 2.0
    """A frame older than this many control periods makes the robot hold position."""
    acceleration_scale: float = 2.0
    """Largest change between two steps, relative to Franka's acceleration limit. Targets lead the arm, so
    they may change faster than the arm itself; from 2.8 on, a full reversal of any joint passes."""
    workspace_lower_m: tuple[float, float, float] = (0.15, -0.45, 0.012)
    """Where the point between the finger pads may go, robot base frame; 12 mm = fingertips on the table."""
    workspace_upper_m: tuple[float, float, float] = (0.80, 0.45, 0.80)
    """The box's other corner."""
    realtime_trials: int = 3
    """Trials on the machine's own clock, for time keeping (success comes from evaluation.rig_trials)."""
    workers: int = 2
    """Processes that run simulated-clock trials."""
    film_every: int = 6
    """Steps between two columns of a trial's film strip."""
    franka_host: str = "172.16.0.2"
    """Address of the robot's control unit."""
    franka_dynamics: float = 0.2
    """Share of the arm's velocity, acceleration and jerk limits that a real robot uses."""
    franka_grip_force_n: float = 20.0
    """Force of a real gripper."""
    realsense_serial: str = ""
    """Serial number of the camera; empty takes the first one found."""

    def __post_init__(self) -> None:
        if self.noise not in ("zero", "normal"):
            raise UserError(f"deploy.noise is {self.noise!r}; expected zero or normal.")
        if self.realtime_trials < 1 or self.film_every < 1:
            raise UserError(
                f"deploy.realtime_trials is {self.realtime_trials}, deploy.film_every {self.film_every}; "
                "expected at least 1."
            )
        if any(low >= high for low, high in zip(self.workspace_lower_m, self.workspace_upper_m, strict=True)):
            raise UserError(
                f"deploy.workspace is {self.workspace_lower_m} to {self.workspace_upper_m}; expected the "
                "lower corner below the upper one in x, y and z."
            )


@dataclass(frozen=True)
class EvalConfig:
    """Trials behind every success rate."""

    teacher_trials: int = 300
    """Episodes of the teacher in its own simulation."""
    student_trials: int = 100
    """Episodes of the student on clean depth and on generated depth."""
    rig_trials: int = 60
    """Episodes of the exported student in the pseudo-real rig."""

    def __post_init__(self) -> None:
        _check_counts("evaluation", self, "teacher_trials", "student_trials", "rig_trials")


SCORE_COLUMNS = ("sim_gt", "rand_noise", "inpaint", "monocular", "ddg_no_graft", "ddg")
"""Columns of the paper's Table I; ddg_no_graft is its ablation."""
SCORE_FEATURES = ("depthfeat-v1", "fid_inception", "resnet18", "resnet18_random_v1")
"""Feature extractors of scores; fid_inception and resnet18 need converted weights."""


@dataclass(frozen=True)
class ScoreConfig:
    """How generated depth is compared with recorded depth (paper Table I and its t-SNE)."""

    trajectories: int = 84
    """Rig trajectories recorded for scoring per side: as many give real depth, as many others simulated. With
    16 frames each of the t-SNE's six sets has its share of 8,000 maps, as in the paper."""
    frames: int = 16
    """Consecutive frames of each, from a random step on."""
    columns: tuple[str, ...] = SCORE_COLUMNS
    """Columns of the table: sim_gt, rand_noise, inpaint, monocular (needs weights), ddg_no_graft, ddg."""
    features: tuple[str, ...] = ("depthfeat-v1",)
    """Feature extractors, the first of which the targets are judged by: depthfeat-v1, fid_inception, resnet18
    (both need converted weights in weights/) or resnet18_random_v1."""
    kid_subsets: int = 100
    """Random subsets behind KID."""
    kid_subset_size: int = 500
    """Maps per subset, at most half of what there is."""
    bootstrap: int = 100
    """Resamplings of whole trajectories behind every interval."""
    tsne_maps: int = 8000
    """Maps in the t-SNE, all domains together, at most."""
    neighbours: int = 10
    """Nearest neighbours behind the mixing number."""
    repeat_scenes: int = 8
    """Scenes that are sensed again and again while nothing moves."""
    repeats: int = 6
    """How often each of them is sensed."""
    monocular: str = "depth_anything_v2"
    """Network behind the monocular column: depth_anything_v2 or video_depth_anything."""
    monocular_weights: str = ""
    """Folder of its converted weights; empty takes weights/<network>_small."""
    inpaint_radius_px: float = 3.0
    """Neighbourhood of OpenCV's inpainting."""
    curve_trajectories: tuple[int, ...] = (5, 10, 20, 40, 80)
    """Sizes of the data-efficiency curve."""
    curve_steps: int = 0
    """Training steps of every point of the curve; 0 takes as many as the run's generator had."""

    def __post_init__(self) -> None:
        _check_counts("score", self, "kid_subsets", "bootstrap", "tsne_maps", "neighbours")
        for field_name, value, least in (
            ("trajectories", self.trajectories, 2), ("frames", self.frames, 2), ("repeats", self.repeats, 2),
            ("kid_subset_size", self.kid_subset_size, 2),
        ):  # fmt: skip
            if value < least:
                raise UserError(f"score.{field_name} is {value}; expected at least {least}.")
        _check_names("score.columns", self.columns, SCORE_COLUMNS)
        _check_names("score.features", self.features, SCORE_FEATURES)
        if any(count < 1 for count in self.curve_trajectories):
            raise UserError(
                f"score.curve_trajectories is {self.curve_trajectories}; expected 1 or more each."
            )


def _check_names(field_name: str, given: tuple[str, ...], known: tuple[str, ...]) -> None:
    if not given:
        raise UserError(f"{field_name} is empty; expected at least one of {', '.join(known)}.")
    for name in given:
        if name not in known:
            raise unknown_name(field_name, name, known)


@dataclass(frozen=True)
class DepthFeatureConfig:
    """Training of the depth feature extractor (foundation/depth_feature_training.py)."""

    seed: int = 0
    """Of rooms, cameras, corruptions and initial weights."""
    devices: int = 96
    """Random cameras; the last eighth of them is kept for testing."""
    pictures: int = 24
    """Random rooms seen by each camera."""
    width_px: int = 320
    """Width of the pictures; the frozen extractor's is 320."""
    steps: int = 800
    """Optimiser steps."""
    batch_size: int = 24
    """Maps per step."""
    learning_rate: float = 1e-3
    """Adam's step size after the warm-up; falls to nothing along a cosine."""
    checkpoint_every: int = 100
    """Steps between checkpoints."""

    def __post_init__(self) -> None:
        _check_counts(
            "features", self, "devices", "pictures", "width_px", "steps", "batch_size", "checkpoint_every",
        )  # fmt: skip


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
    score: ScoreConfig = field(default_factory=ScoreConfig)
