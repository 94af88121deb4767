"""The command that measures a GPU, at its smallest sizes, where there is none."""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import jax
import pytest

from benchmarks import gpu_check, gpu_sections, gpu_sizes
from mjx_envs.render import render_check


def test_sections_run_in_processes_of_their_own_and_fill_one_file(tmp_path):
    out = tmp_path / "check.json"
    assert gpu_check.run_all(["machine", "env_steps"], "cpu", out) == 0
    report = json.loads(out.read_text())
    assert report["complete"] and report["machine"]["cores"] >= 1
    assert report["env_steps"]["errors"] == []
    rates = [report["env_steps"][f"cpu_{count}"] for count in gpu_sizes.CPU.env_counts["cpu"]]
    assert all(rate["physics_steps_per_s"] == pytest.approx(20 * rate["env_steps_per_s"]) for rate in rates)
    assert min(rate["env_steps_per_s"] for rate in rates) > 1


def test_backends_are_those_named_in_that_order_and_all_without():
    assert gpu_sizes.only(gpu_sizes.GPU, []) is gpu_sizes.GPU
    chosen = gpu_sizes.only(gpu_sizes.GPU, ["jax"])
    assert chosen.physics == ("jax",) and chosen.renderers == ("jax",)
    assert gpu_sizes.only(gpu_sizes.GPU, ["jax", "warp"]).physics == ("jax", "warp")


def test_backends_that_leave_nothing_are_refused_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["gpu_check", "--device", "cpu", "--backends", "warp"])
    with pytest.raises(SystemExit) as stop:
        gpu_check.main()
    assert stop.value.code == 2
    assert "--device cpu has nothing to measure on warp" in capsys.readouterr().err.splitlines()[-1]


def test_a_section_cut_off_is_an_error_and_the_next_one_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(gpu_check.SECTIONS, "frames", (gpu_sections.frames, 0.1))
    out = tmp_path / "check.json"
    assert gpu_check.run_all(["frames", "machine"], "cpu", out) == 1
    report = json.loads(out.read_text())
    assert report["frames"]["errors"] == ["cut off after 0 s"]
    assert report["complete"] and report["machine"]["errors"] == []
    assert "frames: cut off after 0 s" in capsys.readouterr().out


def test_a_section_that_finds_something_keeps_its_figures_and_fails(tmp_path, monkeypatch):
    def finds(sizes, save):
        save(speed=3.0)
        yield "too slow"
        save(more=4.0)

    monkeypatch.setitem(gpu_check.SECTIONS, "frames", (finds, 1.0))
    out = tmp_path / "section.json"
    assert gpu_check.run_section("frames", gpu_sizes.CPU, out) == gpu_check.FOUND
    assert json.loads(out.read_text()) == {"errors": ["too slow"], "speed": 3.0, "more": 4.0}


CRASHES_AFTER_A_FINDING = """#!{python}
import sys
sys.path.insert(0, {root!r})
from benchmarks import gpu_check

def crashes(sizes, save):
    save(speed=3.0)
    yield "too slow"
    raise RuntimeError("out of memory")

gpu_check.SECTIONS["frames"] = (crashes, 60.0)
sys.argv = sys.argv[2:]  # as with -m
gpu_check.main()
"""


def test_a_section_that_crashes_after_a_finding_keeps_both(tmp_path, monkeypatch):
    program = tmp_path / "python"
    root = str(Path(gpu_check.__file__).parents[1])
    program.write_text(CRASHES_AFTER_A_FINDING.format(python=sys.executable, root=root))
    os.chmod(program, 0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    assert gpu_check.run_all(["frames"], "cpu", tmp_path / "check.json") == 1
    section = json.loads((tmp_path / "check.json").read_text())["frames"]
    assert section["speed"] == 3.0
    found, crash = section["errors"]
    assert found == "too slow"
    assert crash.startswith("exit status 1: ") and crash.endswith("RuntimeError: out of memory")


def test_without_a_gpu_it_says_so_in_one_line(tmp_path, monkeypatch, capsys):
    if any(device.platform == "gpu" for device in jax.devices()):
        pytest.skip("this machine has a GPU")
    out = tmp_path / "check.json"
    monkeypatch.setattr(sys, "argv", ["gpu_check", "--out", str(out)])
    with pytest.raises(SystemExit) as stop:
        gpu_check.main()
    assert stop.value.code == 2 and not out.exists()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "needs an NVIDIA GPU" in lines[0] and "--device cpu" in lines[0]
    assert gpu_check.run_all(["frames"], "gpu", out) == 2 and not out.exists()
    assert "needs an NVIDIA GPU" in capsys.readouterr().err


def test_generator_and_student_are_timed(tmp_path):
    out = tmp_path / "check.json"
    assert gpu_check.run_section("training", gpu_sizes.CPU, out) == 0
    report = json.loads(out.read_text())
    assert report["preset"] == "debug"
    assert min(report["student"].values()) > 0 and min(report["generator"].values()) > 0


def test_physics_is_within_its_limits(tmp_path):
    out = tmp_path / "check.json"
    assert gpu_check.run_section("conformance", gpu_sizes.CPU, out) == 0
    measured = json.loads(out.read_text())["cpu"]
    assert 1e-4 < measured["fall_relative"] < 1e-3 and measured["fall_from_cpu_m"] == 0


def test_pictures_are_compared_with_each_reference(tmp_path, open_gl):
    out = tmp_path / "check.json"
    assert gpu_check.run_section("pictures", gpu_sizes.CPU, out) == 0
    report = json.loads(out.read_text())
    assert 0 < report["jax_numpy"]["median_depth_error_m"] < 1e-4
    assert 0 < report["jax_opengl"]["median_depth_error_m"] < 1e-4


def test_frames_are_timed_for_every_size(tmp_path):
    out = tmp_path / "check.json"
    assert gpu_check.run_section("frames", gpu_sizes.CPU, out) == 0
    report = json.loads(out.read_text())
    assert report["jax_16px"]["scenes"] == 8 and report["jax_16px"]["frames_per_s"] > 1


def test_the_teacher_from_nothing_starts_from_nothing_and_the_guided_one_from_the_guide():
    for sizes in gpu_sizes.SIZES.values():
        assert gpu_sections.guided(sizes).start == "guide"
        assert gpu_sections.unguided(sizes).start == "nothing"


def test_a_teacher_trains_until_an_evaluation_reaches_the_aim(monkeypatch):
    """One that PPO did not begin to train counts for nothing; a backend that cannot train stops no other."""
    report = {}
    monkeypatch.setattr(gpu_sections, "SUCCESS_AIM", 0.0)
    sizes = replace(gpu_sizes.CPU, physics=("abacus", "cpu"))
    (error,) = gpu_sections.ppo_from_nothing(sizes, lambda **values: report.update(values))
    assert error.startswith("abacus: UserError: ")
    assert report["start"] == "nothing" and report["backend"] == "cpu"
    assert [row["iteration"] for row in report["evaluations"]] == [0, 1]
    assert report["seconds_to_95_percent"] == report["evaluations"][1]["seconds"] > 0


@pytest.mark.parametrize("section, figure", [("pictures", "jax_numpy"), ("frames", "jax_16px")])
def test_a_renderer_that_cannot_draw_stops_no_other(section, figure, monkeypatch):
    def no_display(scenes):
        raise OSError("no display")

    monkeypatch.setattr(render_check, "draw_with_open_gl", no_display)  # GLFW ends a process that asks twice
    report = {}
    sizes = replace(gpu_sizes.CPU, renderers=("abacus", "jax"))
    found = list(gpu_check.SECTIONS[section][0](sizes, lambda **values: report.update(values)))
    assert [error[:6] for error in found if not error.startswith("opengl: OSError")] == ["abacus"]
    assert figure in report
