"""Memory told beforehand: against XLA's own analysis, and refused in one line."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from app.commands import parse
from app.commands.checks import tell_fit
from benchmarks.programs import PROGRAMS
from ddg_jax import memory as ddg_memory
from ddgrasp import artifacts
from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS
from demos import memory as demos_memory
from learning import memory
from learning.memory import Need, check, compiled_bytes, traced_bytes
from recording_support import flat, write_depth
from student_jax import memory as student_memory
from student_jax.data import kept_of_a_demo

MB = 2**20


def floats(megabytes: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((megabytes, MB // 4), jnp.float32)


def test_what_is_alive_at_once_by_hand():
    def chain(x):
        return jnp.cos(jnp.sin(x)).sum()  # x and sin(x), then x, sin(x) and cos(sin(x))

    def kept(x):
        a, b = jnp.sin(x), jnp.cos(x)
        return (a @ b.T).sum()

    def looped(x):
        return jax.lax.scan(lambda carry, _: (jnp.sin(carry), None), x, None, 100)[0]

    assert traced_bytes((jax.jit(chain), (floats(8),))) == 3 * 8 * MB
    assert traced_bytes((jax.jit(kept), (floats(8),))) == pytest.approx(4 * 8 * MB, rel=0.01)
    assert traced_bytes((jax.jit(looped), (floats(8),))) == 2 * 8 * MB  # not 100


@pytest.mark.parametrize("name", ["generator: train step", "student: train step"])
def test_estimates_are_near_what_xla_needs(name):
    jitted, arguments = program = PROGRAMS[name](PRESETS["debug"])
    compiled = compiled_bytes(jitted.lower(*arguments).compile())
    assert compiled is not None
    assert 0.9 < traced_bytes(program) / compiled < 2


@pytest.mark.parametrize("name", ["student: train step", "student: features"])
def test_the_page_says_what_the_student_of_paper_takes(name):
    """Those of its rows that changes of the network alter."""
    page = (Path(__file__).parents[1] / "docs" / "accelerators.md").read_text()
    (said,) = re.findall(rf"^\| {name}(?:, batch)? ?,? ?256 \| ([0-9.]+) \|", page, re.MULTILINE)
    assert said == f"{traced_bytes(PROGRAMS[name](PRESETS['paper'])) / 1e9:.1f}"


def test_frames_of_the_paper_need_a_disk_not_memory():
    paper = PRESETS["paper"]
    frames, window = (1200 + 6 * 512) * 60, (225 + 2 * 12) * (290 + 2 * 12)
    need = student_memory.need(paper)
    assert need.disk == 2 * (frames * window + 512 * 60 * 360 * 640)  # 54 GB
    assert need.host < need.disk / 15


def test_a_students_trials_are_in_its_need():
    config = PRESETS["debug"]
    many = replace(config, evaluation=replace(config.evaluation, student_trials=4000))
    needed = student_memory.need(many).device
    assert needed >= student_memory.acting_bytes(many, 4000) > student_memory.need(config).device


def test_trials_by_themselves_are_told_or_refused_before_they_begin(tmp_path, monkeypatch, capsys):
    config, run = PRESETS["debug"], tmp_path / "run"
    need = student_memory.trials_need(config)
    trials = config.evaluation.student_trials
    assert need.disk == trials * config.world.episode_steps * 2 * 90 * 160
    assert need.device >= student_memory.acting_bytes(config, trials)
    for stage in ("teacher", "ddg"):
        artifacts.finish(run / stage, stage, config, seconds=1.0, metrics={})
    another = artifacts.finish(tmp_path / "teacher", "teacher", config, seconds=2.0, metrics={})
    parents = [artifacts.read_artifact(run / "ddg"), another]
    artifacts.finish(run / "student", "student", config, seconds=1.0, metrics={}, parents=parents)

    def evaluate() -> None:
        parse("student eval", [str(run), "--trials", "300"]).run()

    with pytest.raises(UserError, match="params.msgpack"):  # it got as far as that
        evaluate()
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith(f"{run}/student names another teacher, by its manifest, than {run}/teacher,")
    assert said[1].startswith("student eval: about ")
    free = SimpleNamespace(free=10**8)
    monkeypatch.setattr("learning.memory.shutil.disk_usage", lambda path: free)
    with pytest.raises(UserError, match=r"^Stage student eval needs about 0\.4 GB of disk in .*TMPDIR"):
        evaluate()
    monkeypatch.setattr(memory, "host_bytes", lambda: 10**6)
    with pytest.raises(UserError, match=r"of memory on the host, .*lower the number of trials \(--trials\)"):
        evaluate()


def test_a_batch_of_demos_needs_its_pictures_once():
    """On disk all steps of all environments; drawing them is what the table of programs says."""
    config = PRESETS["debug"]
    need, pixels = demos_memory.need(config), 90 * 160
    assert need.disk == 6 * 45 * pixels * (2 + 3)
    assert need.device == max(
        traced_bytes(PROGRAMS[f"rendering: {name}"](config)) for name in ("depth", "colour")
    )
    blind = replace(config, demos=replace(config.demos, rgb=False))
    assert demos_memory.need(blind).disk == 6 * 45 * pixels * 2
    assert demos_memory.need(blind).device < need.device


def test_more_than_there_is_is_refused_with_the_remedy(tmp_path):
    fits = Need("student", 10**6, 10**6, 10**6, "student.training.batch_size")
    check(fits, tmp_path / "not" / "there")
    with pytest.raises(
        UserError, match=r"^Stage student needs about 1000000\.0 GB of disk in .* free some, or work on"
    ):
        check(replace(fits, disk=10**15), tmp_path)
    with pytest.raises(UserError, match=r"needs about 1000000\.0 GB of memory on the .* lower student"):
        check(replace(fits, host=10**15), tmp_path)


def test_what_is_on_the_disk_already_is_not_asked_for_again(tmp_path, monkeypatch):
    free = SimpleNamespace(free=300)
    monkeypatch.setattr("learning.memory.shutil.disk_usage", lambda path: free)
    need = Need("student", 0, 0, 1000, scratch="frames.zarr")
    with pytest.raises(UserError, match="GB of disk"):
        check(need, tmp_path)
    (tmp_path / "student" / "frames.zarr").mkdir(parents=True)
    (tmp_path / "student" / "frames.zarr" / "chunk").write_bytes(bytes(700))
    check(need, tmp_path)
    with pytest.raises(UserError, match="GB of disk"):
        check(replace(need, scratch=""), tmp_path)  # what a stage keeps is not in its need


def test_of_a_demo_no_more_is_asked_for_than_is_kept():
    whole, laptop = PRESETS["demo"], PRESETS["laptop"]
    assert (laptop.student.training.demo_stretch_steps, laptop.student.head.chunk) == (12, 2)
    assert kept_of_a_demo(laptop.student, 60) == 12 + 2 + 1
    assert kept_of_a_demo(laptop.student, 10) == 10
    training = replace(whole.student.training, demo_stretch_steps=0)
    assert kept_of_a_demo(replace(whole.student, training=training), 60) == 60


def test_a_batch_that_cannot_fit_is_refused_before_any_work(tmp_path):
    from app.commands.checks import check_networks

    config = PRESETS["debug"]
    lines = check_networks(config, tmp_path)
    assert [line.split(":")[0] for line in lines] == ["demos", "ddg", "student"]
    training = replace(config.student.training, batch_size=65_536)
    large = replace(config, student=replace(config.student, training=training))
    with pytest.raises(UserError, match="Stage student needs about .* lower student.training.batch_size"):
        check_networks(large, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def recordings(tmp_path):
    """A folder with one recording of eight frames."""
    write_depth(tmp_path / "data" / "a", 8 * [flat((48, 64), 700)], fx_px=40.0, sensor="RealSense D435")
    return tmp_path / "data"


HALVED = (
    "--ddg.sampling.sampler progressive --ddg.sampling.spacing quadratic --ddg.sampling.steps 4 "
    "--ddg.training.distil-from 128 --ddg.diffusion.steps 1000"
)
BATCH = "Stage ddg needs about .* lower ddg.training.batch_size, ddg.sampling.batch_size or the number of fr"


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("ddg fit --data {} --ddg.training.batch-size 65536", BATCH),
        ("ddg fit --data {} --ddg.sampling.batch-size 65536", BATCH),
        ("ddg score --real {} --ddg.training.batch-size 65536", BATCH),
        ("ddg distil --model pretrained/ddg --data {} --evaluations 1", BATCH),
        (f"ddg fit --data {{}} {HALVED}", "distil_from is 128: of 1000 diffusion steps, .* cannot be halved"),
    ],
)
def test_a_generator_on_recordings_is_refused_before_they_are_read(
    command, expected, recordings, tmp_path, monkeypatch
):
    # The batches of `ddg distil` are its model's; no machine has more than the others take.
    monkeypatch.setattr(memory, "host_bytes", lambda: 0 if "distil" in command else 10**11)
    group, name, *options = command.format(recordings).split()
    with pytest.raises(UserError, match=expected):
        parse(f"{group} {name}", [*options, "--out", str(tmp_path / "out")]).run()
    assert not (tmp_path / "out").exists()


def test_a_generator_s_frames_are_counted(recordings, tmp_path, capsys, monkeypatch):
    config, seen = PRESETS["debug"], []
    monkeypatch.setattr(ddg_memory, "frames_bytes", lambda ddg, frames: seen.append(frames) or 10**9)
    tell_fit(config, recordings, tmp_path / "ddg")
    tell_fit(config, recordings, tmp_path / "ddg", 5)
    assert seen == [8, 5]
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and lines[0].startswith("ddg: about ") and lines[0].endswith(", 1.0 GB of arrays")
    artifacts.finish(tmp_path / "ddg", "ddg", config, seconds=1.0, metrics={})
    tell_fit(config, recordings, tmp_path / "ddg")
    assert capsys.readouterr().err == "" and len(seen) == 2
