"""`config.yaml`: a run's settings, written beside it and accepted back, now and by later releases."""

from dataclasses import replace
from pathlib import Path

import pytest

from app.commands import parse
from ddgrasp import config_file, presets
from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS
from ddgrasp.scaling import scaled
from ddgrasp.upgrades import VERSION


def _changed():
    command = parse("run", ["--preset", "debug", "--seed", "7", "--world.objects", "cube", "can",
                            "--student.training.steps", "9", "--ddg.graft.window-px", "1.25"])  # fmt: skip
    return command.config


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_comes_back(name, tmp_path):
    path = tmp_path / "config.yaml"
    config_file.write(PRESETS[name], path)
    assert path.read_text().splitlines()[:3] == [
        "# ddgrasp run --config config.yaml", f"# Preset {name} as it is.", f"preset: {name}",
    ]  # fmt: skip
    assert config_file.read(path) == PRESETS[name]


def test_what_differs_stands_above_and_lists_are_one_line(tmp_path):
    path = tmp_path / "config.yaml"
    config_file.write(_changed(), path)
    lines = path.read_text().splitlines()
    assert lines[1 : lines.index("preset: debug")] == [
        "# Preset debug but for:",
        "#   seed: 7",
        '#   world.objects: ["cube", "can"]',
        "#   ddg.graft.window_px: 1.25",
        "#   student.training.steps: 9",
    ]
    assert "  objects: [cube, can]" in lines
    assert parse("run", ["--config", str(path)]).config == _changed()


def test_a_run_comes_back_after_its_preset_has_changed(tmp_path, monkeypatch):
    path, ran = tmp_path / "config.yaml", _changed()
    config_file.write(ran, path)
    debug = PRESETS["debug"]
    later = replace(debug, seed=99, demos=replace(debug.demos, episodes=77))
    monkeypatch.setitem(PRESETS, "debug", later)
    assert config_file.read(path) == ran
    path.write_text("preset: debug\nseed: 3\n")
    assert config_file.read(path) == replace(later, seed=3)


def test_a_run_comes_back_after_its_preset_is_gone(tmp_path, monkeypatch):
    path, ran = tmp_path / "config.yaml", _changed()
    config_file.write(ran, path)
    left = {name: preset for name, preset in PRESETS.items() if name != "debug"}
    for module in (presets, config_file):  # an entry that is deleted comes back as the last one
        monkeypatch.setattr(module, "PRESETS", left)
    assert config_file.read(path) == ran
    path.write_text("preset: debug\n")
    with pytest.raises(UserError, match="Unknown preset 'debug'"):
        config_file.read(path)


def test_a_file_of_an_earlier_release_keeps_what_it_did_then(tmp_path):
    path = tmp_path / "config.yaml"
    config_file.write(PRESETS["debug"], path)
    old = path.read_text().replace(f"manifest_version: {VERSION}", "manifest_version: 7")
    assert "  picture:" in old and "    fill_holes: true\n" in old
    path.write_text(old.replace("    fill_holes: true\n", ""))
    assert PRESETS["debug"].student.picture.fill_holes
    assert not config_file.read(path).student.picture.fill_holes


def test_single_values_can_be_given_besides_and_name_the_place(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("preset: debug\nseed: 3\n")
    command = parse("teacher train", ["--config", str(path), "--teacher.num-envs", "16", "--resume"])
    assert command.config == replace(
        PRESETS["debug"], seed=3, teacher=replace(PRESETS["debug"].teacher, num_envs=16)
    )
    assert (command.out, command.resume) == (Path("runs/debug"), True)


def test_a_run_at_scale_comes_back(tmp_path):
    small = scaled(replace(PRESETS["paper"], scale=0.001), 0.001)
    config_file.write(small, tmp_path / "config.yaml")
    assert config_file.read(tmp_path / "config.yaml") == small


def test_a_scale_written_by_hand_is_applied(tmp_path):
    (tmp_path / "mine.yaml").write_text("preset: demo\nscale: 0.01\ndemos: {episodes: 120}\n")
    read, small = config_file.read(tmp_path / "mine.yaml"), scaled(PRESETS["demo"], 0.01)
    assert read == replace(small, demos=replace(small.demos, episodes=120)) and small.demos.episodes < 120
    config_file.write(read, tmp_path / "again.yaml")
    assert config_file.read(tmp_path / "again.yaml") == read


def test_a_folder_named_as_a_number_stays_a_text(tmp_path):
    preset, path = PRESETS["debug"], tmp_path / "config.yaml"
    for name in ("3e-4", "1e5", "-.5E+3", "runs/3e-4"):
        config = replace(preset, student=replace(preset.student, init_from=name))
        config_file.write(config, path)
        assert config_file.read(path) == config


def test_a_number_may_be_written_as_on_the_command_line(tmp_path):
    (tmp_path / "mine.yaml").write_text("preset: debug\nteacher: {learning_rate: 3e-4}\n")
    assert config_file.read(tmp_path / "mine.yaml").teacher.learning_rate == 3e-4


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seed: 3", "names no preset: its first line is to be `preset: demo`"),
        ("- 3", "names no preset"),
        ("preset: dmo", "Unknown preset 'dmo'. Did you mean 'demo'?"),
        (
            "preset: demo\nworld: {objcts: [cube]}",
            "Unknown setting 'world.objcts'. Did you mean 'world.objects'",
        ),
        (
            "preset: demo\nstudent.training.steps: 3",
            "student.training.steps stands in one line: write steps: indented below training: below student:",
        ),
        ("preset: demo\nworld: 3", "world is 3; expected its settings, indented below it"),
        ("preset: demo\nworld:", "world is None; expected its settings, indented below it"),
        ("preset: demo\nteacher: {num_envs: 0}", "teacher.num_envs is 0; expected at least 1"),
        ("preset: demo\nteacher: {num_envs: many}", "teacher.num_envs is 'many'; expected"),
        ("preset: [", "is no YAML"),
        ("preset: demo\nseed: 2026-13-45", "is no YAML: month must be in 1..12"),
        ("preset: demo\nseed: 0x_", "is no YAML: invalid literal for int"),
        ("preset: demo\nstudent: {encoder: {output_stride: 8.0}}", "is 8.0; expected one of 4, 8, 16, 32"),
        ("preset: demo\nteacher: {num_envs: 64}\nteacher: {epochs: 1}", "teacher is given twice"),
        ("preset: demo\nscale: 3", "scale is 3; expected above 0, up to 1"),
        ("preset: demo\nmanifest_version: 9999", "manifest_version is 9999; this release reads 1 to"),
        ("preset: demo\nmanifest_version: true", "manifest_version is True; this release reads 1 to"),
        ("preset: demo\nmanifest_version: 3\nddg: [3]", "ddg is \\[3\\]; expected its settings"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(text, said, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match=said) as refused:
        parse("run", ["--config", str(path)])
    assert "\n" not in str(refused.value) and str(refused.value).count(f"--config {path}") == 1


def test_a_file_that_is_not_there_and_two_beginnings_are_refused(tmp_path):
    with pytest.raises(UserError, match="nowhere.yaml cannot be read \\(No such file or directory\\)"):
        parse("run", ["--config", str(tmp_path / "nowhere.yaml")])
    for option, value in (("--preset", "demo"), ("--scale", "0.5")):
        with pytest.raises(UserError, match=f"x.yaml and {option} {value} both say where to begin"):
            parse("run", ["--config", "x.yaml", option, value])


def test_a_file_that_somebody_wrote_into_the_run_s_folder_stays(tmp_path):
    path = tmp_path / "config.yaml"
    assert not config_file.is_of_a_person(path)
    config_file.write(PRESETS["debug"], path)
    assert not config_file.is_of_a_person(path)
    path.write_text("# mine\npreset: debug\n")
    assert config_file.is_of_a_person(path) and config_file.read(path) == PRESETS["debug"]
