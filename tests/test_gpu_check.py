"""The command that measures a GPU, at its smallest sizes, where there is none."""

import json
import sys

import jax
import pytest

from benchmarks import gpu_check


def test_sections_run_in_processes_of_their_own_and_fill_one_file(tmp_path):
    out = tmp_path / "check.json"
    assert gpu_check.run_all(["machine", "env_steps"], "cpu", out) == 0
    report = json.loads(out.read_text())
    assert report["complete"] and report["machine"]["cores"] >= 1
    assert report["env_steps"]["errors"] == []
    rates = [report["env_steps"][f"cpu_{count}"] for count in gpu_check.CPU.env_counts["cpu"]]
    assert all(rate["physics_steps_per_s"] == pytest.approx(20 * rate["env_steps_per_s"]) for rate in rates)
    assert min(rate["env_steps_per_s"] for rate in rates) > 1


def test_backends_are_those_named_in_that_order_and_all_without():
    assert gpu_check.only(gpu_check.GPU, []) is gpu_check.GPU
    chosen = gpu_check.only(gpu_check.GPU, ["jax"])
    assert chosen.physics == ("jax",) and chosen.renderers == ("jax",)
    assert gpu_check.only(gpu_check.GPU, ["jax", "warp"]).physics == ("jax", "warp")


def test_backends_that_leave_nothing_are_refused_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["gpu_check", "--device", "cpu", "--backends", "warp"])
    with pytest.raises(SystemExit) as stop:
        gpu_check.main()
    assert stop.value.code == 2
    assert "--device cpu has nothing to measure on warp" in capsys.readouterr().err.splitlines()[-1]


def test_a_section_cut_off_is_an_error_and_the_next_one_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(gpu_check.SECTIONS, "frames", (gpu_check.frames, 0.1))
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
    assert gpu_check.run_section("frames", gpu_check.CPU, out) == 1
    assert json.loads(out.read_text()) == {"errors": ["too slow"], "speed": 3.0, "more": 4.0}


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


def test_generator_and_student_are_timed(tmp_path):
    out = tmp_path / "check.json"
    assert gpu_check.run_section("training", gpu_check.CPU, out) == 0
    report = json.loads(out.read_text())
    assert report["preset"] == "debug"
    assert min(report["student"].values()) > 0 and min(report["generator"].values()) > 0


def test_the_teacher_from_nothing_starts_from_nothing_and_the_guided_one_from_the_guide(tmp_path):
    for sizes in gpu_check.SIZES.values():
        assert gpu_check.guided(sizes).start == "guide"
        assert gpu_check.unguided(sizes).start == "nothing"
    out = tmp_path / "check.json"
    assert gpu_check.run_section("ppo_from_nothing", gpu_check.CPU, out) == 0
    report = json.loads(out.read_text())
    assert report["start"] == "nothing"
    assert [row["iteration"] for row in report["evaluations"]] == [0, 1, 2]
