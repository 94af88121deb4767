"""The student: a diffusion policy that sees depth alone."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from ddgrasp.config.checks import (
    Batch,
    Count,
    CountOrNone,
    Decay,
    LearningRate,
    Range,
    Section,
    Share,
    StepsOrNone,
    Text,
    Weight,
    WeightDecay,
    Width,
)
from ddgrasp.config.sensors import Sensor
from ddgrasp.errors import UserError

Channel = Literal["relief", "valid", "depth"]
Stem = Literal["conv7", "space_to_depth"]
Norm = Literal["group", "none"]
Pooling = Literal["spatial_softmax", "tokens", "mean"]
Conditioning = Literal["film", "concat"]
Source = Literal[Sensor, "learned_ungrafted", "monocular", "rig"]
"""Every camera model is a depth source; so are others (student_jax/depth_source.py)."""
STEM_STRIDE = 4
"""Picture pixels per side and position after the encoder's stem; sizes must be multiples of it."""
GROUP_CHANNELS = 8
"""Channels normalised together by GroupNorm."""

_Blocks = Annotated[int, Range(1, 100)]
_Metres = Annotated[float, Range(0, 100)]


@dataclass(frozen=True)
class PictureConfig(Section, name="student.picture"):
    """What the network sees (student_jax/preprocess.py)."""

    height_px: Annotated[int, Range(STEM_STRIDE, 4096, multiple=STEM_STRIDE)] = 112
    """Rows of the picture given to the encoder, a multiple of 4."""
    width_px: Annotated[int, Range(STEM_STRIDE, 4096, multiple=STEM_STRIDE)] = 144
    """Columns of the picture given to the encoder, a multiple of 4."""
    channels: tuple[Channel, ...] = ("relief", "valid")
    """Per frame: relief (height over the empty table along the ray), valid (0 or 1), depth (metres)."""
    min_depth_m: Annotated[float, Range(0, 100, above=True)] = 0.1
    """Nearer readings are treated as invalid."""
    max_depth_m: _Metres = 2.5
    """Farther readings are treated as invalid."""
    fill_holes: bool = False
    """Fill invalid pixels from around them, inside the network: it sees surfaces then, and not the shape of a
    camera's holes."""

    def check(self) -> None:
        """See `Section.check`."""
        if len(set(self.channels)) < len(self.channels):
            raise self.error("channels", "each of them once")
        if self.min_depth_m >= self.max_depth_m:
            raise self.error("min_depth_m", f"less than max_depth_m, {self.max_depth_m}")


@dataclass(frozen=True)
class EncoderConfig(Section, name="student.encoder"):
    """The network that looks at the whole picture (student_jax/encoder.py)."""

    stem: Stem = "space_to_depth"
    """conv7 (the paper's: 7x7 stride 2, max pooling) or space_to_depth (4x4 patches; cheap on CPU)."""
    width: Width = 16
    """Channels of the first stage, with norm group a multiple of 8; the paper's ResNet-18 has 64."""
    stage_blocks: tuple[_Blocks, ...] = (2, 2, 2)
    """Basic blocks per stage; each stage doubles the channels. (2, 2, 2, 2) is ResNet-18."""
    max_channels: Width = 512
    """Channels never exceed this, whatever the stage."""
    output_stride: Literal[4, 8, 16, 32] = 8
    """Pixels per cell of the last feature map: 4, 8, 16 or 32 (ResNet's own); later stages keep it."""
    norm: Norm = "group"
    """group (GroupNorm) or none."""
    pooling: Pooling = "spatial_softmax"
    """spatial_softmax (keypoints in the robot's frame), tokens (every cell, projected) or mean (ResNet's)."""
    keypoints: Width = 32
    """Keypoints of spatial_softmax, or channels per cell of tokens."""
    features: Width = 128
    """Length of the encoder's output vector."""
    weights: Text = ""
    """Folder of converted ImageNet ResNet-18 weights that the encoder starts from; empty starts at random."""

    def check(self) -> None:
        """See `Section.check`."""
        for name in ("width", "max_channels"):
            if self.norm == "group" and getattr(self, name) % GROUP_CHANNELS:
                raise self.error(name, f"a multiple of {GROUP_CHANNELS}, as norm group needs")

    @property
    def largest_stride(self) -> int:
        """What the stages reach; a larger `output_stride` makes no other network."""
        return STEM_STRIDE * 2 ** (len(self.stage_blocks) - 1)


@dataclass(frozen=True)
class HandViewConfig(Section, name="student.hand_view"):
    """A second look at the picture, around the hand (student_jax/hand_view.py)."""

    size_px: Annotated[int, Range(0, 1024, multiple=STEM_STRIDE)] = 48
    """Samples per side of the picture around the hand, a multiple of 4; 0 turns the hand view off."""
    pitch_m: Annotated[float, Range(0, 1, above=True)] = 0.004
    """Distance of its samples, metres at the hand's distance from the camera."""
    width: Width = 32
    """Channels of its convolutions."""
    blocks: Annotated[int, Range(0, 100)] = 2
    """Its basic blocks."""
    channels: Width = 8
    """Channels kept per 4x4 patch before they are flattened."""
    features: Width = 96
    """Length of its output vector."""


@dataclass(frozen=True)
class HeadConfig(Section, name="student.head"):
    """The action head: a diffusion model of the next actions (student_jax/policy.py, denoiser.py)."""

    features_to_head: bool = False
    """Give the encoder's vector to the action head."""
    aux_to_head: bool = True
    """Give the predicted grasp position, grasp yaw and held probability to the action head."""
    chunk: Annotated[int, Range(1, 1000)] = 2
    """Actions predicted at once."""
    execute_steps: Annotated[int, Range(1, 1000)] = 1
    """Actions of a chunk that are executed before the policy looks again. Labels of the later ones are noisy:
    where a demonstration was pushed or a student acted, they are of where that led, not the chunk's first."""
    closing_steps: Annotated[int, Range(0, 100)] = 8
    """Control steps that a closing of the gripper lasts at least, once begun (ddgrasp/gripper.py): the hand's
    from open to shut. 0 for none."""
    state_features: Width = 64
    """Width of the joint-state stream."""
    width: Width = 256
    """Width of the denoiser's residual blocks."""
    blocks: Annotated[int, Range(0, 100)] = 3
    """Residual blocks of the denoiser."""
    conditioning: Conditioning = "film"
    """How the denoiser sees its condition: film (scale and shift in every block) or concat (at its input)."""
    time_features: Annotated[int, Range(2, 4096, multiple=2)] = 64
    """Length of the sinusoidal embedding of the diffusion step, an even number."""
    diffusion_steps: Annotated[int, Range(1, 10_000)] = 50
    """Steps K of the forward process."""
    ddim_steps: Annotated[int, Range(1, 10_000)] = 10
    """Denoising iterations when acting."""
    train_steps: StepsOrNone = 4000
    """Optimiser steps of the action head alone at the end, on cached features."""
    batch_size: Annotated[int, Range(2, 65_536)] = 512
    """Samples per step of the head alone: half of them on pictures, if there are poses besides."""

    def check(self) -> None:
        """See `Section.check`."""
        if not (self.features_to_head or self.aux_to_head):
            raise UserError(
                "student.head.features_to_head and student.head.aux_to_head are both off: turn one on."
            )
        if self.execute_steps > self.chunk:
            raise UserError(
                f"student.head.execute_steps is {self.execute_steps}: expected 1 to student.head.chunk = "
                f"{self.chunk}."
            )
        if self.ddim_steps > self.diffusion_steps:
            raise self.error("ddim_steps", f"1 to {self.diffusion_steps} (student.head.diffusion_steps)")


@dataclass(frozen=True)
class StudentTrainingConfig(Section, name="student.training"):
    """Training on the demos (student_jax/train.py)."""

    steps: StepsOrNone = 1500
    """Optimiser steps on the demos."""
    batch_size: Batch = 64
    """Samples per step."""
    noise_draws: Annotated[int, Range(1, 10_000)] = 8
    """Diffusion steps and noises drawn for each encoded sample, since the encoder is what costs; read where
    action_weight is above 0, the head's own training draws one."""
    learning_rate: LearningRate = 1e-3
    """AdamW's step size after the warm-up; falls to a fiftieth along a cosine."""
    weight_decay: WeightDecay = 1e-4
    """AdamW's weight decay."""
    ema_decay: Decay = 0.995
    """Decay of the averaged parameters, which are the ones used."""
    aux_weight: Weight = 1.0
    """Weight of the privileged losses (position, yaw, held) on pictures."""
    action_weight: Weight = 0.0
    """Weight of the diffusion loss on pictures; 0 trains the head on what perception reports instead."""
    held_weight: Annotated[float, Range(0, 1000, above=True)] = 0.4
    """How often a step with the object in the hand is drawn, relative to one before the grasp."""
    demo_held_steps: Annotated[int, Range(0, 10_000)] = 20
    """Steps of a demo kept from the grasp on: the lift and a little of the hold; 0 keeps the
    approach alone."""
    demo_stretch_steps: Annotated[int, Range(0, 10_000)] = 0
    """Steps in a row kept of each demo, from a random one on; 0 keeps all. A demo is one placement of object
    and camera: with short stretches as many pictures for the generator show more of them."""
    clean_share: Share = 0.2
    """Share of the demos that keep clean depth."""
    crop_shift_px: Annotated[int, Range(0, 1000)] = 6
    """Random shift of the crop window in training, pixels of the scaled picture, each way."""
    disparity_noise_px: Annotated[float, Range(0, 100)] = 0.25
    """Largest standard deviation of the noise on valid pixels in training, pixels of disparity at the
    picture's scale (the rig: about 0.07), and with it a few wrong matches; 0 keeps pixels as they come."""
    edge_noise_px: Annotated[float, Range(0, 100)] = 0.0
    """Largest standard deviation of the noise that is added on objects and around the hand, where a matching
    window mixes near and far, pixels of disparity at the picture's scale (the rig: about 0.3)."""
    unseen_share: Share = 0.0
    """Share of the samples on pictures whose object the camera does not see: a hole where it lies, as dark
    and thin things leave (student_jax/augment.py)."""


@dataclass(frozen=True)
class PosesConfig(Section, name="student.poses"):
    """DAgger rounds without pictures: the head learns to act from noisy true poses (student_jax/head.py)."""

    rounds: CountOrNone = 8
    """Rounds; 0 for none."""
    episodes: Count = 256
    """Episodes per round."""
    steps: StepsOrNone = 1000
    """Optimiser steps per round."""


@dataclass(frozen=True)
class DaggerConfig(Section, name="student.dagger"):
    """DAgger: the student acts, the teacher says what it should have done (student_jax/dagger.py)."""

    rounds: CountOrNone = 4
    """Rounds of acting with the student and labelling by the teacher."""
    episodes: Count = 64
    """Episodes per round."""
    steps: StepsOrNone = 600
    """Optimiser steps after each round, on all frames so far."""
    teacher_share: Share = 0.3
    """Share of the first round's actions that the teacher takes; falls linearly to none in the last one, if
    there are several."""


@dataclass(frozen=True)
class StudentConfig(Section, name="student"):
    """Depth-only diffusion policy."""

    picture: PictureConfig = field(default_factory=PictureConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    hand_view: HandViewConfig = field(default_factory=HandViewConfig)
    head: HeadConfig = field(default_factory=HeadConfig)
    training: StudentTrainingConfig = field(default_factory=StudentTrainingConfig)
    poses: PosesConfig = field(default_factory=PosesConfig)
    dagger: DaggerConfig = field(default_factory=DaggerConfig)
    init_from: Text = ""
    """Run directory or pretrained folder whose student to start from; empty starts from nothing."""
    depth_source: Source = "learned"
    """What gives the demos' clean depth a camera's artefacts: learned (the run's generator),
    learned_ungrafted (its own map instead of grafted depth), ideal (nothing), dextrah, kinect, stereo (the
    rig's camera on the clean picture), monocular (depth from colour, by a network with weights) or rig (the
    development rig's camera before the scene, which a robot's cannot be asked for: a bound); stereo and
    monocular need demos.rgb."""
    dextrah_scale: Annotated[float, Range(0.125, 8)] = 1.0
    """Size of the formulas' pixel in training, in pixels of the picture, where depth_source is dextrah: their
    numbers are of pictures 160 wide; 2 makes one of 320 as noisy as those, 1 half as noisy in depth."""
    dextrah_normal_m: Annotated[float, Range(0, 1)] = 0.0
    """Standard deviation by which the formulas move each pixel along its surface's normal, where depth_source
    is dextrah; DextrAH-G's published code has 0.01."""
    ellipse_dropout: Annotated[float, Range(0, 100)] = 0.0
    """Elliptic holes in training depth besides what depth_source gives it: how many are expected in a
    picture, drawn anew in every frame; their half axes are an eighth of ellipse_half_axis_px to all of it.
    What training.clean_share leaves clean has none."""
    ellipse_half_axis_px: Annotated[float, Range(1, 4096)] = 25.0
    """Longest half axis of such a hole, in pixels of the camera's picture."""

    def check(self) -> None:
        """See `Section.check`."""
        channels = self.picture.channels
        if self.encoder.pooling == "spatial_softmax":
            _need(channels, "relief", "student.encoder.pooling spatial_softmax")
            _need(channels, "valid", "student.encoder.pooling spatial_softmax")
        if self.hand_view.size_px:
            _need(channels, "valid", "the hand view (student.hand_view.size_px)")
        if self.hand_view.size_px and self.encoder.norm == "group" and self.hand_view.width % GROUP_CHANNELS:
            raise self.hand_view.error(
                "width", f"a multiple of {GROUP_CHANNELS}, as student.encoder.norm group needs"
            )
        if self.encoder.weights and self.init_from:
            raise UserError(
                "student.init_from and student.encoder.weights both say where to start: give one."
            )


def _need(channels: tuple[str, ...], name: str, who: str) -> None:
    if name not in channels:
        raise UserError(f"student.picture.channels is {channels}; {who} needs {name!r} among them.")
