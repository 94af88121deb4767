"""What benchmarks measure and print: the programs that stages run, what is left out, too few frames."""

import importlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import generator, objects_seen, simulator_noise, teacher_curves
from benchmarks.programs import PROGRAMS
from ddg_jax.train import init_params
from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS
from ddgrasp.progress import CURVES
from evaluation.depth_score.data import SIDES, Episode
from learning import convolutions

DEBUG = PRESETS["debug"]
WRONG = {
    "convolutions --preset lap": "Unknown preset 'lap'. Did you mean 'laptop'?",
    "costs --preset lap": "Unknown preset 'lap'. Did you mean 'laptop'?",
    "generator --preset lap": "Unknown preset 'lap'. Did you mean 'laptop'?",
    "objects_seen --model no": "--model is no, which does not exist: give a run that has made ddg, or its",
    "simulator_noise no": "no: no such folder; expected a recording or a folder of recordings.",
    "surfaces no": "no has no trajectories: run `ddgrasp ddg score` and give its score/data.",
    "teacher_curves ours=no": "no holds no teacher's evaluations: give the directory of a run.",
}


@pytest.mark.parametrize("line", WRONG)
def test_wrong_input_is_one_line(line, tmp_path, monkeypatch, capsys):
    name, *arguments = line.split()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"benchmarks.{name}").main()
    out, told = capsys.readouterr()
    assert (ended.value.code, out) == (2, "")
    assert told.startswith(WRONG[line]) and told.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_picture_goes_to_runs_and_leaves_the_documentation_s_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (shown := tmp_path / "docs" / "images" / "teacher_curves.png").parent.mkdir(parents=True)
    shown.write_bytes(b"as published")
    curves = tmp_path / "a" / "teacher" / CURVES
    curves.parent.mkdir(parents=True)
    curves.write_text('{"step": 1, "eval_success": 0.5, "control_steps": 1e6, "minutes": 2.0}\n')
    monkeypatch.setattr(sys, "argv", ["teacher_curves", "ours=a"])
    teacher_curves.main()
    assert capsys.readouterr().out == "runs/teacher_curves.png\n"
    assert (tmp_path / "runs" / "teacher_curves.png").read_bytes()[:4] == b"\x89PNG"
    assert shown.read_bytes() == b"as published"


def _options(jitted, arguments) -> str:
    """What XLA is told where `jitted` is compiled, as JAX says it: a program inside another may have none."""
    with pytest.raises(ValueError, match="compiler_options") as refusal:
        jax.make_jaxpr(jitted)(*arguments)
    return str(refusal.value)


def test_evaluations_are_compiled_as_the_generator_s_are():
    config, (height, width) = DEBUG.ddg, (DEBUG.ddg.depth.height_px, DEBUG.ddg.depth.width_px)
    if convolutions.compiler_options() is None:
        pytest.skip("this jaxlib is not 0.10, or compiles for an accelerator")
    params = jax.eval_shape(lambda: init_params(config, jax.random.key(0)))
    maps = jax.ShapeDtypeStruct((2, height, width, generator.channels(config)), jnp.float32)
    priors = jax.ShapeDtypeStruct((2, height, width), jnp.float32)
    assert convolutions.OPTION in _options(generator.one_evaluation(config, 2), (params, maps, priors))
    drawn, arguments = PROGRAMS[f"sampler: {config.sampling.sampler}"](DEBUG)
    assert convolutions.OPTION in _options(drawn, arguments)


def test_scenes_without_object_pixels_are_counted():
    seen, unseen = [0.5, 0.1, 0.01, 0.02, 3.0, 0.0, -3.0], [0.0, 1.0, 0.01, 0.02, *3 * [np.nan]]
    line = objects_seen._line("generator", np.array([seen, unseen, unseen]))
    assert line.split() == [
        "generator", "0.17", "2", "70.0%", "0.01000", "0.02000", "3.0", "0.0", "-3.0", "3.0", "0.0", "3.0",
    ]  # fmt: skip


@pytest.mark.parametrize("blocks", [0, 1])
def test_fewer_blocks_than_can_be_resampled_are_refused(blocks):
    maps = np.full((4, 12, 16), 700, np.uint16)
    episodes = [
        Episode(side, number, number, maps, maps, maps[:0], None, 300.0, 0.05)
        for side in SIDES
        for number in range(blocks)
    ]
    with pytest.raises(UserError, match=rf"hold {blocks} run\(s\) of 8 .*give a larger --score-frames"):
        simulator_noise.measure(episodes, [], 1)
