"""The depth generator: a diffusion model of what a real depth camera does to depth."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from ddgrasp.config.checks import (
    Batch,
    Count,
    Decay,
    LearningRate,
    Pixels,
    Range,
    Section,
    Share,
    Steps,
    Text,
    WeightDecay,
    Width,
)
from ddgrasp.errors import UserError

Representation = Literal["depth", "deviation"]
DEPTH, DEVIATION = get_args(Representation)
Surface = Literal["filtered", "planes", "piecewise"]
FILTERED, PLANES, PIECEWISE = SURFACES = get_args(Surface)
PriorSource = Literal["inverse_depth", "metric_inverse_depth", "video_depth_anything", "depth_anything_v2"]
PriorInSim = Literal["depth", "rgb"]
DType = Literal["float32", "bfloat16"]
NoiseSchedule = Literal["cosine", "linear"]
HoleLoss = Literal["squared", "cross_entropy"]
SQUARED, CROSS_ENTROPY = HOLE_LOSSES = get_args(HoleLoss)
LossWeight = Literal["uniform", "truncated"]
UNIFORM, _ = get_args(LossWeight)
Sampler = Literal["dpm_solver", "ddim", "ddpm", "progressive"]
DPM_SOLVER, DDIM, DDPM, PROGRESSIVE = SAMPLERS = get_args(Sampler)
Spacing = Literal["leading", "trailing", "linspace", "quadratic"]
SPACINGS: tuple[Spacing, ...] = get_args(Spacing)
"""Spacing of the diffusion steps that a sampler visits: learning/diffusion.py, timesteps."""
HALVED_SPACINGS: tuple[Spacing, ...] = ("trailing", "quadratic")
"""Those whose every second step is one of half as many: what progressive distillation needs."""

WindowShape = Literal["gaussian", "box"]
_, BOX = get_args(WindowShape)

_Metres = Annotated[float, Range(0, 1000, above=True)]
_Evaluations = Annotated[int, Range(1, 10_000)]
_Snr = Annotated[float, Range(0, 1_000_000)]


@dataclass(frozen=True)
class DDGDepthConfig(Section, name="ddg.depth"):
    """Depth as the diffusion model sees it (ddg_jax/representation.py)."""

    representation: Representation = "deviation"
    """What the network draws: deviation (holes, and how far the sensor is off the surface) or depth (the
    paper's: the depth map itself)."""
    height_px: Pixels = 180
    """Rows of the generated map."""
    width_px: Pixels = 320
    """Columns of the generated map."""
    near_m: _Metres = 0.25
    """Nearest depth that is told apart (representation depth)."""
    far_m: _Metres = 10.0
    """Farthest depth that is told apart (representation depth), and that a monocular baseline may have."""
    surface: Surface = "filtered"
    """The surface that recorded depth deviates from: filtered (errors wider than 9 px are lost), planes (the
    same, but tables, floors and walls are flat, so that the bumps that a stereo camera sees in them are
    learnt; sensors/statistics/planes.py), or piecewise (small planes with sharp edges, 0.1 to 0.4 s a
    frame; ddg_jax/piecewise.py)."""

    def check(self) -> None:
        """See `Section.check`."""
        if self.near_m >= self.far_m:
            raise self.error("near_m", f"less than far_m, {self.far_m}")


@dataclass(frozen=True)
class GraftConfig(Section, name="ddg.graft"):
    """What of a generated map counts as an artefact and is put into simulated depth (ddg_jax/graft.py)."""

    noise_threshold: Annotated[float, Range(-10, 10)] = 0.4
    """The paper's: below it a generated pixel is a hole. Holes are -1, surfaces 1 (depth: 0 to 1, which
    needs a negative one, for example -0.2; docs/generator.md)."""
    deviation_threshold: Annotated[float, Range(0, 100)] = 0.0005
    """Smallest deviation of inverse depth, 1/m, that is an artefact and grafted: 1/32 px of disparity of a
    D455 at 1280x720; 0.0016 is a D435's at 640x480 (representation deviation alone). 1 grafts holes alone."""
    window_px: Annotated[float, Range(0, 20)] = 0.0
    """Size of the window over which the camera's matching mixes surfaces, pixels of simulated depth, which is
    blurred by it before anything else (ddg_jax/window.py): the standard deviation of a Gaussian, the width of
    a box; 0 leaves edges sharp."""
    window_shape: WindowShape = "gaussian"
    """gaussian, or box, which is what a matcher that weighs all of its window alike does."""

    def check(self) -> None:
        """See `Section.check`."""
        if self.window_shape == BOX and self.window_px and self.window_px % 2 != 1:
            raise self.error("window_px", "an odd number of pixels for a box, or 0")


@dataclass(frozen=True)
class PriorConfig(Section, name="ddg.prior"):
    """The geometric prior c: clean depth that tells the generator what the scene is (ddg_jax/prior.py)."""

    source: PriorSource = "inverse_depth"
    """Where c comes from: inverse_depth (normalised, built in), metric_inverse_depth (not normalised: for
    cameras that move), video_depth_anything (the paper's) or depth_anything_v2."""
    weights: Text = ""
    """Folder of the network's converted weights; empty takes weights/<source>_small."""
    in_sim: PriorInSim = "depth"
    """What a network's prior is in simulation: depth (simulated depth, normalised alike) or rgb (the
    network).
    """
    input_px: Annotated[int, Range(14, 4096)] = 518
    """Shorter side of the pictures that the network sees."""
    dtype: DType = "float32"
    """The network's arithmetic: float32 or bfloat16."""
    blur_px: Annotated[float, Range(0, 100)] = 1.0
    """Gaussian blur of c in pixels: hides where a recording's holes were filled (built-in sources only)."""
    noise: Annotated[float, Range(0, 10)] = 0.03
    """Standard deviation of noise added to c in training and sampling, for the same reason."""
    jitter: Share = 0.1
    """Relative scale and shift of c varied in training, so that it need not match to the last percent."""
    decoy_holes: Share = 0.5
    """Share of recorded frames whose prior is filled under another frame's holes as well (built-in sources
    only)."""


@dataclass(frozen=True)
class UNetConfig(Section, name="ddg.unet"):
    """The generator's network (ddg_jax/unet.py)."""

    space_to_depth: Annotated[int, Range(1, 64)] = 4
    """Pixels per side folded into channels before the U-Net."""
    widths: tuple[Width, ...] = (64, 64, 96)
    """Channels per level; every level halves height and width."""
    blocks: tuple[Annotated[int, Range(0, 100)], ...] = (0, 1, 0)
    """Residual blocks per level, in the encoder and again in the decoder; two more sit in the middle."""
    attention_heads: Annotated[int, Range(0, 1024)] = 4
    """Attention heads in the middle; 0 turns attention off."""
    position: bool = False
    """The network knows where in the picture it is, and so learns what a camera always does at the same
    pixels; frames are not turned upside down in training then."""

    def check(self) -> None:
        """See `Section.check`."""
        if len(self.widths) != len(self.blocks):
            raise UserError(
                f"ddg.unet.widths is {self.widths} and ddg.unet.blocks {self.blocks}; expected one number "
                "per level in each."
            )
        if self.attention_heads and self.widths[-1] % self.attention_heads:
            raise self.error(
                "attention_heads", f"a divisor of the last level's {self.widths[-1]} channels, or 0 for none"
            )

    @property
    def stride(self) -> int:
        """Pixels per side that one position of the innermost level stands for."""
        return self.space_to_depth * 2 ** (len(self.widths) - 1)


_LINEAR_STEPS = (500, 5000)
"""Steps of a linear schedule after which alpha_bar is below 0.01 and far above float32's least number."""
FIRST_LINEAR_BETA, LAST_LINEAR_BETA = 1e-4, 0.02
"""Ho et al. 2020, section 4 (learning/diffusion.py)."""
COSINE_OFFSET, MAX_BETA = 0.008, 0.999
"""s of Nichol & Dhariwal 2021, eq. 17, and the bound on beta below it (learning/diffusion.py)."""
_LEAST_NOISE = 4 * 2.0**-24
"""Least 1 - alpha_bar: four times what float32 can tell from 0 beside 1."""
_MOST_SIGNAL = 0.01
"""Largest alpha_bar of the last step: a sampler takes that one for pure noise."""

_LEAST_SIGNAL = 1e-11
"""Least alpha_bar of the last step: x_0 comes out of eps and x_k by a division by its root, which at 3e-6
leaves an error of 0.005, at 2e-8 one of 0.4 (of x_0 in [-1, 1])."""


def _linear_ends(steps: int) -> tuple[float, float]:
    slope = (LAST_LINEAR_BETA - FIRST_LINEAR_BETA) / (steps - 1)
    return FIRST_LINEAR_BETA, math.prod(1 - FIRST_LINEAR_BETA - slope * k for k in range(steps))


def _cosine_ends(steps: int) -> tuple[float, float]:
    start, first, last = (
        math.cos((u + COSINE_OFFSET) / (1 + COSINE_OFFSET) * math.pi / 2) ** 2
        for u in (0, 1 / steps, 1 - 1 / steps)
    )
    return 1 - first / start, (1 - MAX_BETA) * last / start


def _log_snr(alpha_bar: float) -> float:
    return math.log(alpha_bar) - math.log1p(-alpha_bar)


_ENDS = {"linear": _linear_ends, "cosine": _cosine_ends}
"""The first 1 - alpha_bar and the last alpha_bar of a schedule with so many steps."""


@dataclass(frozen=True)
class DDGDiffusionConfig(Section, name="ddg.diffusion"):
    """The forward process (learning/diffusion.py)."""

    steps: Annotated[int, Range(2, 100_000)] = 1000
    """Steps K of the forward process."""
    schedule: NoiseSchedule = "cosine"
    """Noise schedule: cosine or linear, whose betas are those of 1000 steps (Ho et al. 2020)."""
    log_snr_shift: Annotated[float, Range(-10, 10)] = 0.0
    """Moves the schedule's log signal-to-noise ratio; negative is noisier."""

    def check(self) -> None:
        """See `Section.check`."""
        least, most = _LINEAR_STEPS
        if self.schedule == "linear" and not least <= self.steps <= most:
            raise self.error(
                "steps",
                f"{least} to {most} with schedule linear: fewer do not end in noise",
            )
        noise, _ = _ENDS[self.schedule](self.steps)
        if (most := math.log(noise / _LEAST_NOISE)) < self.log_snr_shift:
            why = "the first one would add less noise than float32 tells"
            raise self.error("log_snr_shift", f"at most {most:.1f} with {self.steps} steps: {why}")

    @property
    def exact_from(self) -> float:
        """Least `log_snr_shift` with which a sampler's first step keeps what the network says in float32."""
        _, signal = _ENDS[self.schedule](self.steps)
        return _log_snr(_LEAST_SIGNAL) - _log_snr(signal)

    @property
    def noisy_up_to(self) -> float:
        """Largest `log_snr_shift` with which the last step is noise, as a sampler takes it."""
        _, signal = _ENDS[self.schedule](self.steps)
        return _log_snr(_MOST_SIGNAL) - _log_snr(signal)


@dataclass(frozen=True)
class DDGTrainingConfig(Section, name="ddg.training"):
    """Fitting and distillation (ddg_jax/train.py, distil.py)."""

    steps: Steps = 1500
    """Optimiser steps."""
    batch_size: Batch = 16
    """Frames per step."""
    learning_rate: LearningRate = 1e-3
    """AdamW's step size after the warm-up; falls to a twentieth along a cosine."""
    weight_decay: WeightDecay = 1e-4
    """AdamW's weight decay."""
    hole_loss: HoleLoss = "squared"
    """What the hole channel is trained by: squared error (the paper's, as all channels) or cross_entropy (of
    log odds: sharper layouts from more and smaller steps, ddg_jax/train.py; deviation only)."""
    loss_weight: LossWeight = "truncated"
    """Weight of a diffusion step's error: uniform (the paper's) or truncated (more weight on noisy steps,
    which few-step sampling needs)."""
    snr_limits: tuple[_Snr, _Snr] = (1.0, 25.0)
    """Least and greatest weight of an error in the clean map (loss_weight truncated, and distillation). The
    upper one counts in slight noise, where single pixels and roughness are decided; the layout of holes is
    decided in strong noise."""
    ema_decay: Decay = 0.995
    """Decay of the averaged parameters, which are the ones used."""
    checkpoint_every: Count = 250
    """Steps between whole-state checkpoints."""
    holdout_fraction: Annotated[float, Range(0, 0.95)] = 0.1
    """Share of the frames, the last ones, kept out of training for the statistics and pictures: whole
    recordings where that is half to one and a half times as many."""
    distil_from: Annotated[int, Range(1, 65_536)] = 16
    """Evaluations of the fitted network from which distillation starts; sampling.steps times a power of
    two (sampler progressive only)."""
    distil_steps: Steps = 150
    """Optimiser steps per halving of the evaluations (sampler progressive only)."""

    def check(self) -> None:
        """See `Section.check`."""
        if not 0 < self.snr_limits[0] <= self.snr_limits[1]:
            raise self.error("snr_limits", "two numbers above 0, the smaller one first")


@dataclass(frozen=True)
class SamplingConfig(Section, name="ddg.sampling"):
    """Drawing maps from a fitted generator (ddg_jax/sample.py)."""

    sampler: Sampler = "dpm_solver"
    """dpm_solver (second order), ddim, ddpm (ancestral) or progressive (distilled to `steps` evaluations,
    ddg_jax/distil.py)."""
    steps: _Evaluations = 4
    """Network evaluations per map."""
    spacing: Spacing = "quadratic"
    """Which diffusion steps they visit: trailing, leading or linspace (equal steps, named as in the
    literature) or quadratic (short ones at the end, where the noise on surfaces is decided)."""
    eta: Share = 0.0
    """Fresh noise in DDIM: 0 none, 1 as much as DDPM."""
    frame_correlation: Share = 0.8
    """Share of the noise's variance (the initial one's, the prior's, and eta's) that the frames of an episode
    have in common: decides the flicker of holes (docs/generator.md)."""
    deviation_correlation: Share = 0.0
    """The same for the noise that deviations come from: decides how surfaces change in time (representation
    deviation only)."""
    batch_size: Batch = 16
    """Frames generated together on each device."""


@dataclass(frozen=True)
class DDGConfig(Section, name="ddg"):
    """Diffusion Depth Generator."""

    depth: DDGDepthConfig = field(default_factory=DDGDepthConfig)
    graft: GraftConfig = field(default_factory=GraftConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    unet: UNetConfig = field(default_factory=UNetConfig)
    diffusion: DDGDiffusionConfig = field(default_factory=DDGDiffusionConfig)
    training: DDGTrainingConfig = field(default_factory=DDGTrainingConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    init_from: Text = ""
    """Folder with a fitted generator to use instead of fitting one; empty fits."""

    def check(self) -> None:
        """See `Section.check`."""
        self._check_holes()
        self._check_sampling()
        if (stride := self.unet.stride) > min(self.depth.height_px, self.depth.width_px):
            raise UserError(
                f"ddg.unet folds {stride} x {stride} pixels into one (space_to_depth and one halving per "
                f"level), more than a map of {self.depth.height_px} x {self.depth.width_px} pixels has: take "
                "fewer widths, or a larger ddg.depth.height_px and width_px."
            )

    def _check_holes(self) -> None:
        training, depth = self.training, self.depth
        if training.hole_loss == CROSS_ENTROPY and depth.representation != DEVIATION:
            raise UserError(
                f"ddg.training.hole_loss {CROSS_ENTROPY} needs holes in a channel of their own: "
                f"ddg.depth.representation is {depth.representation}; take deviation, or hole_loss {SQUARED}."
            )
        if training.hole_loss == CROSS_ENTROPY and self.sampling.sampler == PROGRESSIVE:
            raise UserError(
                f"ddg.sampling.sampler {PROGRESSIVE} distils squared errors: ddg.training.hole_loss is "
                f"{CROSS_ENTROPY}, whose holes cannot leave -1 to 1 as a distilled step must; take sampler "
                f"ddim with 2 to 4 steps, or hole_loss {SQUARED}."
            )
        if depth.representation == DEPTH and self.graft.noise_threshold > 0:
            raise UserError(
                f"ddg.graft.noise_threshold is {self.graft.noise_threshold}; with ddg.depth.representation "
                "depth surfaces are 0 to 1 and would be holes: expected 0 or less, for example -0.2."
            )

    def _check_sampling(self) -> None:
        steps = self.sampling.steps
        if steps > self.diffusion.steps:
            raise UserError(
                f"ddg.sampling.steps is {steps}; expected 1 to {self.diffusion.steps} (ddg.diffusion.steps)."
            )
        if self.sampling.sampler != PROGRESSIVE:
            return
        if self.sampling.spacing not in HALVED_SPACINGS:
            raise UserError(
                f"ddg.sampling.spacing is {self.sampling.spacing}; sampler progressive makes one step of "
                f"two, as {' and '.join(HALVED_SPACINGS)} ones alone allow: give --ddg.sampling.spacing "
                "quadratic, and distil again what was distilled with others."
            )
        halvings, rest = divmod(self.training.distil_from, steps)
        if rest or halvings < 2 or halvings & (halvings - 1):
            raise UserError(
                f"ddg.training.distil_from is {self.training.distil_from} and ddg.sampling.steps {steps}: "
                "sampler progressive halves the one until it is the other; expected for example 8 and 4, 2 "
                "or 1."
            )
        if self.training.distil_from > self.diffusion.steps:
            raise UserError(
                f"ddg.training.distil_from is {self.training.distil_from}; expected at most "
                f"{self.diffusion.steps} (ddg.diffusion.steps)."
            )
