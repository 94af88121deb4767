"""Stage `student`: demos, depth source (the generator) and teacher -> depth-only diffusion policy.

The action head learns from true poses with noise; perception from the demos with a camera's artefacts
and from DAgger, where the student acts, the teacher labels, and all frames so far are fitted again; last
the head on what perception reports. Each part leaves a checkpoint, so that an interrupted stage goes on
from the last finished part.
"""

import shutil

from ddgrasp.artifacts import Artifact
from ddgrasp.files import to_json
from ddgrasp.job import Job
from ddgrasp.trained import trains
from demos.store import STORE, EpisodeStore
from mjx_envs.render.batch_render import check_renderer
from ppo import policy as teacher_policy
from student_jax import evaluate, pretrained_encoder
from student_jax.dagger import ACTED, Trainer
from student_jax.data import CACHE
from student_jax.depth_source import make_source
from student_jax.head import POSES


def run(job: Job) -> Artifact:
    """Trains the student and evaluates it closed-loop on clean depth and on the source's."""
    config, directory, progress, parents = job.config, job.directory, job.progress, job.parents
    check_renderer(config.world.renderer)  # its first picture may be hours away
    encoder_weights = pretrained_encoder.source(config.student)
    source = make_source(config, parents["ddg"].directory)
    teacher = teacher_policy.load(parents["teacher"].directory)
    trainer = Trainer(config, teacher, source, directory, progress)
    trainer.run(EpisodeStore(parents["demos"].directory / STORE))
    metrics = evaluate.closed_loop(config, teacher, source, trainer.params, progress)
    metrics |= {"tried": trainer.history, "frames": trainer.frame_count, "encoder_weights": encoder_weights}
    shutil.rmtree(directory / CACHE, ignore_errors=True)
    for name in (POSES, ACTED):
        (directory / name).unlink(missing_ok=True)
    loaded = config.student.init_from and not trains(to_json(config), "student")
    return job.finish(metrics, origin="loaded" if loaded else "trained")
