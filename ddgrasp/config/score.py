"""How generated depth is scored against recorded depth."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from ddgrasp.config.checks import Count, Range, Section, StepsOrNone, Text

ScoreColumn = Literal["sim_gt", "rand_noise", "inpaint", "monocular", "ddg_no_graft", "ddg"]
"""Columns of the paper's Table I; ddg_no_graft is its ablation."""
ScoreFeature = Literal["depthfeat-v1", "fid_inception", "resnet18", "resnet18_random_v1"]
"""Feature extractors of scores; fid_inception and resnet18 need converted weights."""
Monocular = Literal["depth_anything_v2", "video_depth_anything"]
SCORE_COLUMNS: tuple[ScoreColumn, ...] = get_args(ScoreColumn)
SCORE_FEATURES: tuple[ScoreFeature, ...] = get_args(ScoreFeature)
_TwoOrMore = Annotated[int, Range(2, 1_000_000)]


@dataclass(frozen=True)
class ScoreConfig(Section, name="score"):
    """How generated depth is compared with recorded depth (paper Table I and its t-SNE)."""

    trajectories: _TwoOrMore = 84
    """Rig trajectories recorded for scoring per side: as many give real depth, as many others simulated. With
    16 frames each the t-SNE's sets, six without monocular depth and eight with it, share 8,000 maps, as many
    as the paper's."""
    frames: _TwoOrMore = 16
    """Consecutive frames of each, from a random step on."""
    columns: tuple[ScoreColumn, ...] = SCORE_COLUMNS
    """Columns of the table: sim_gt, rand_noise, inpaint, monocular (needs weights), ddg_no_graft, ddg."""
    features: tuple[ScoreFeature, ...] = ("depthfeat-v1",)
    """Feature extractors, the first of which the targets are judged by: depthfeat-v1, fid_inception, resnet18
    (both need converted weights in weights/) or resnet18_random_v1."""
    kid_subsets: Count = 100
    """Random subsets behind KID."""
    kid_subset_size: _TwoOrMore = 500
    """Maps per subset, at most half of what there is."""
    bootstrap: Count = 100
    """Resamplings of whole trajectories behind every interval."""
    tsne_maps: Count = 8000
    """Maps in the t-SNE, all domains together, at most."""
    neighbours: Count = 10
    """Nearest neighbours behind the mixing number."""
    repeat_scenes: Count = 8
    """Scenes that are sensed again and again while nothing moves."""
    repeats: _TwoOrMore = 6
    """How often each of them is sensed."""
    monocular: Monocular = "depth_anything_v2"
    """Network behind the monocular column: depth_anything_v2 or video_depth_anything."""
    monocular_weights: Text = ""
    """Folder of its converted weights; empty takes weights/<network>_small."""
    inpaint_radius_px: Annotated[float, Range(0, 100, above=True)] = 3.0
    """Neighbourhood of OpenCV's inpainting."""
    curve_trajectories: tuple[Count, ...] = (5, 10, 20, 40, 80)
    """Sizes of the data-efficiency curve."""
    curve_steps: StepsOrNone = 0
    """Training steps of every point of the curve; 0 takes as many as the run's generator had."""
