"""Stage `score_real`: is generated depth what a real camera records? Table I on its own recordings.

Behind `ddgrasp ddg score --real`.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

from ddgrasp import artifacts
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.job import Job
from evaluation.depth_score import data as score_data
from evaluation.depth_score import features as score_features
from evaluation.depth_score.domains import Methods, monocular_network
from evaluation.depth_score.episodes import Load
from evaluation.depth_score.scoring import score_setting

SETTING = (
    "{root}: fitted on the first {fit} frames, scored on the last {score}. Nobody modelled that room: its "
    "geometry is the recorded depth of the odd frames, holes filled, made piecewise smooth "
    "(ddg_jax/piecewise.py); recorded depth is the even frames, a frame earlier. So the layout is the same "
    "on both sides, and errors of valid pixels are relative to that stand-in."
)
APART = (
    "{first}{more}: meta.json does not say that frames follow each other (consecutive_frames), or some "
    "between them were left out. Where they show different scenes, the layouts of the two sides differ, and "
    "flicker and persistence say nothing."
)

FEWEST_BLOCKS = 2
"""On either side: resampling needs two."""
_FEW_BLOCKS = 10
"""With fewer, drawing them again says little of other frames."""


def real_config(config: Config, root: Path) -> Config:
    """`config` with the generator's rows those of the recordings below `root`: nothing is cropped."""
    rows, _ = score_data.real_size(root, config.ddg.depth.width_px)
    return replace(config, ddg=replace(config.ddg, depth=replace(config.ddg.depth, height_px=rows)))


def run(job: Job) -> Artifact:
    """Fits a generator on the first `fit_frames` of the recordings below `data` and scores it on the last
    `score_frames` (inputs by these names). The configuration is one of `real_config`.
    """
    from ddg_jax.prior import make_prior
    from ddg_jax.sample import Generator

    config, root = job.config, job.inputs["data"]
    fit_frames, score_frames = job.inputs["fit_frames"], job.inputs["score_frames"]
    least = FEWEST_BLOCKS * 2 * score_data.BLOCK_FRAMES
    if score_frames < least:
        raise UserError(f"--score-frames is {score_frames}; expected {least} or more: two blocks per side.")
    frames = score_data.load_real(root, config.ddg.depth.width_px, score_frames)
    if fit_frames < 2 or fit_frames + score_frames > frames.total:
        raise UserError(
            f"--fit-frames {fit_frames} and --score-frames {score_frames} of {frames.total} frame(s): "
            "they must not overlap, and fitting needs 2 or more."
        )
    if len(frames.blocks) < FEWEST_BLOCKS:
        raise UserError(
            f"--score-frames {score_frames} hold {len(frames.blocks)} run(s) of "
            f"{2 * score_data.BLOCK_FRAMES} frames of one recording; expected {FEWEST_BLOCKS} or more: give "
            "more frames."
        )
    # Before hours of fitting:
    with_rgb = make_prior(config.ddg).needs_sim_rgb or monocular_network(config.score, config.ddg) is not None
    score_data.check_colour(frames, with_rgb)
    extractors = [score_features.load(name) for name in config.score.features]
    if frames.blind:
        job.progress.note(f"left out {frames.blind} frame(s) to score, which have hardly a valid pixel")
    if frames.apart:
        job.progress.note(_apart(frames))
    fitted = _fit(job, root, fit_frames)
    methods = Methods(config.score, config.seed, Generator.load(fitted.directory))
    episodes = score_data.real_episodes(frames, methods.needs_rgb)
    loads: list[Load] = [partial(lambda e: e, episode) for episode in episodes]
    text = SETTING.format(root=root.name, fit=fit_frames, score=score_frames)
    if frames.apart:
        text += f" {_apart(frames)}"
    blocks = f"{len(frames.blocks)} runs of {2 * score_data.BLOCK_FRAMES} consecutive frames"
    if len(frames.blocks) < _FEW_BLOCKS:
        blocks += ", of which there are few: the true intervals are wider"
    return score_setting(replace(job, parents={"ddg": fitted}), text, blocks, methods, extractors, loads)


def _apart(frames: score_data.RealFrames) -> str:
    first, *others = frames.apart.values()
    return APART.format(first=first.name, more=f" and {len(others)} more" if others else "")


def _fit(job: Job, root: Path, fit_frames: int) -> Artifact:
    """The generator fitted on the first frames, in a directory of its own; the finished one if there is."""
    from ddg_jax.data import load_frames
    from ddg_jax.prior import make_prior
    from ddg_jax.stage import fitted_generator

    config, directory = job.config, job.directory / "ddg"
    if artifacts.is_finished(directory):
        return artifacts.read_artifact(directory)
    prior = make_prior(config.ddg)
    frames = load_frames(root, config.ddg, prior, config.seed, job.progress, max_frames=fit_frames)
    fitted_generator(config.ddg, prior, frames, directory, config.seed, job.progress)
    metrics = {"frames": {"training": len(frames)}}
    return artifacts.finish(directory, "ddg", config, seconds=job.progress.seconds, metrics=metrics)
