"""The export stage: from a student's artifact to a checked file."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from config_support import unchecked
from ddgrasp import artifacts
from ddgrasp import policy_metadata as metadata
from ddgrasp.config import (
    Config,
    EncoderConfig,
    ExportConfig,
    HeadConfig,
    PictureConfig,
    StudentConfig,
    WorldConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes
from ddgrasp.onnx_runtime import ort
from ddgrasp.progress import Progress
from demos.stage import STORE
from demos.store import EpisodeStore
from export import stage
from job_support import make_job
from learning.params import load_params, save_params
from student_jax import policy

CONFIG = Config(
    preset="test",
    world=WorldConfig(camera_scale=0.125),
    student=StudentConfig(
        picture=PictureConfig(height_px=56, width_px=72),
        encoder=EncoderConfig(width=8, stage_blocks=(1,), keypoints=4, features=16, output_stride=4),
        head=HeadConfig(state_features=16, width=16, blocks=1, time_features=8, ddim_steps=3),
    ),
    export=ExportConfig(parity_batches=2, latency_runs=5),
)


def finish_student(run_dir, config):
    params = policy.init_params(jax.random.key(0), config.student, config.world.profile)
    save_params(run_dir / "student" / policy.PARAMS_FILE, params)
    return artifacts.finish(run_dir / "student", "student", config, seconds=0.0, metrics={})


def test_a_student_becomes_a_file_that_describes_itself(tmp_path):
    student = finish_student(tmp_path, CONFIG)
    artifact = stage.run(make_job("export", CONFIG, tmp_path / "export"))
    metrics = artifact.manifest.metrics
    assert metrics["max_abs_diff"] <= 1e-4
    assert 0 < metrics["latency_ms"]["p50"] <= metrics["latency_ms"]["p99"]
    session = ort.InferenceSession(tmp_path / "export" / stage.POLICY_FILE)
    described = metadata.validate(session.get_modelmeta().custom_metadata_map)
    shapes = {node.name: node.shape for node in (*session.get_inputs(), *session.get_outputs())}
    metadata.validate_shapes(described, shapes)
    assert described.student_manifest_hash == student.hash
    assert described.ddim_steps == 3


def test_a_missed_bound_writes_nothing_and_keeps_the_old_file(tmp_path):
    config = replace(CONFIG, export=unchecked(CONFIG.export, max_abs_diff=-1.0))
    finish_student(tmp_path, config)
    old = tmp_path / "export" / stage.POLICY_FILE
    atomic_write_bytes(old, b"old")
    with pytest.raises(UserError, match="differs from JAX by"):
        stage.run(make_job("export", config, tmp_path / "export"))
    assert old.read_bytes() == b"old"
    assert not artifacts.is_finished(tmp_path / "export")


def test_actions_that_are_no_numbers_are_written_nowhere(tmp_path):
    finish_student(tmp_path, CONFIG)
    path = tmp_path / "student" / policy.PARAMS_FILE
    save_params(path, jax.tree.map(lambda a: a * np.nan, load_params(path)))
    with pytest.raises(UserError, match="no finite numbers on some inputs; nothing was written"):
        stage.run(make_job("export", CONFIG, tmp_path / "export"))
    assert not (tmp_path / "export" / stage.POLICY_FILE).exists()


def test_a_larger_bound_is_advised_where_the_setting_takes_it():
    for difference in (3.2e-4, 0.2, 0.49):
        said = stage._too_different(difference, 1e-4)
        advised = float(said.partition("--export.max-abs-diff ")[2].partition(";")[0])
        assert difference < advised and ExportConfig(max_abs_diff=advised) is not None
    assert "--export.max-abs-diff 6e-04; otherwise train longer" in stage._too_different(3.2e-4, 1e-4)
    for difference in (0.5, 1.7):
        said = stage._too_different(difference, 1e-4)
        assert said.endswith("the student is kept. Train longer.")


def test_no_student_is_said(tmp_path):
    with pytest.raises(UserError, match="no finished stage 'student'"):
        stage.run(make_job("export", CONFIG, tmp_path / "export"))


def test_frame_triples_come_from_the_run_s_demonstrations(tmp_path):
    assert stage.demo_frames(tmp_path / "demos", CONFIG) is None
    depth_mm = np.arange(5, dtype=np.uint16)[:, None, None] * np.ones((1, 90, 160), np.uint16)
    EpisodeStore(tmp_path / "demos" / STORE, create=True).append({"depth_mm": depth_mm}, {"n": np.array(5)})
    frames = stage.demo_frames(tmp_path / "demos", CONFIG)
    np.testing.assert_allclose(
        frames[:, :, 0, 0], np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4]]) / 1000, atol=1e-6
    )


def test_real_frames_are_used_when_given():
    params = policy.init_params(jax.random.key(0), CONFIG.student, CONFIG.world.profile)
    model = stage.export_policy(CONFIG, jax.tree.map(np.asarray, params))
    frames = np.full((2, 3, 90, 160), 0.7, np.float32)
    metrics = stage.measure(CONFIG, params, model, frames, Progress(quiet=True))
    assert metrics["parity_frames"] == "demonstrations and random"
    assert metrics["parity_samples"] == 2 * 4 + 4
