"""Stage `score`: is generated depth what the rig's camera records? Table I, hole measures, t-SNE.

Behind `ddgrasp ddg score`.
"""

from functools import partial

from ddgrasp.artifacts import Artifact
from ddgrasp.job import Job
from evaluation.depth_score import data as score_data
from evaluation.depth_score import features as score_features
from evaluation.depth_score.domains import Methods
from evaluation.depth_score.scoring import score_setting

SETTING = (
    "Pseudo-real rig. Recorded depth: {n} trajectories that nothing was trained on. Simulated: clean "
    "geometry of {n} other trajectories of the same teacher, with the same spread of cameras: the distance "
    "of Sim GT is the sensor's share alone. Real vs real: what the rig's camera recorded of those others."
)


def run(job: Job) -> Artifact:
    """Scores the generator on new trajectories of the rig."""
    from ddg_jax.sample import Generator

    config = job.config
    extractors = [score_features.load(name) for name in config.score.features]  # before hours of recording
    methods = Methods(config.score, config.seed, Generator.load(job.parents["ddg"].directory))
    teacher, data = job.parents["teacher"].directory, job.directory / "data"
    files = score_data.record_rig(config, teacher, data, methods.needs_rgb, job.progress)
    loads = [partial(score_data.load_episode, file) for file in files]
    text = SETTING.format(n=config.score.trajectories)
    return score_setting(job, text, "trajectories", methods, extractors, loads)
