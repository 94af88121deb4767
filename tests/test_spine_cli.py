"""The command line as a person meets it, in a process of its own where that matters."""

import contextlib
import dataclasses
import io
import json
import subprocess
import sys
from functools import partial
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pytest

from app import commands
from app.cli import main
from app.commands import COMMANDS, parse
from app.commands.checks import check_config_values, check_networks, stage_folder
from app.commands.parsing import HELP_ALL
from app.commands.rig import drive_command
from ddgrasp import artifacts
from ddgrasp.config import CAMERAS
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes
from ddgrasp.install import pip_install
from ddgrasp.presets import PRESETS
from ddgrasp.scaling import with_values
from ddgrasp.stages import CHECKPOINTS

ROOT = Path(__file__).parents[1]


class Ended(NamedTuple):
    """What a command left."""

    returncode: object
    stdout: str
    stderr: str


def ddgrasp(*args: str, encoding: str = "utf-8") -> Ended:
    """The command in the repository, in this process, before a terminal of that encoding."""
    said, printed = io.StringIO(), io.TextIOWrapper(io.BytesIO(), encoding, newline="")
    with contextlib.chdir(ROOT), contextlib.redirect_stderr(said), contextlib.redirect_stdout(printed):
        try:
            status = main(args)
        except SystemExit as stop:
            status = stop.code
    printed.seek(0)
    return Ended(status, printed.read(), said.getvalue())


def _one_error_line(result: Ended | subprocess.CompletedProcess) -> str:
    assert result.stderr.count("\n") == 1, result.stderr
    assert result.stdout == ""
    return result.stderr


def test_help_of_every_command_starts_without_jax():
    code = f"""
import sys
from app.cli import main
main(["--help"])
for name in {list(COMMANDS)}:
    try:
        main([*name.split(), "--help"])
    except SystemExit as stop:
        assert stop.code == 0, (name, stop.code)
heavy = {{"jax", "jaxlib", "flax", "mujoco", "matplotlib", "cv2", "onnxruntime", "sklearn"}}
print("LOADED", sorted(heavy & set(sys.modules)))
"""
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "LOADED []"
    for name in COMMANDS:
        assert f"usage: ddgrasp {name}" in result.stdout


def test_help_lists_every_command():
    result = ddgrasp("--help")
    assert result.returncode == 0
    for name, command in COMMANDS.items():
        assert f"  {name}" in result.stdout
        assert command.__doc__


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_help_shows_a_command_s_own_options_and_help_all_every_value(encoding):
    options = ("--help", HELP_ALL)
    texts = {option: ddgrasp("teacher", "train", option, encoding=encoding).stdout for option in options}
    assert ("╭" in texts["--help"]) == (encoding == "utf-8")
    assert "--resume" in texts["--help"] and "--teacher." not in texts["--help"]
    assert texts["--help"].endswith("score): ddgrasp teacher train --help-all\n")
    assert "--hosts.process " in texts["--help"]
    assert "--teacher.num-envs" in texts[HELP_ALL] and "--hosts.process " in texts[HELP_ALL]


def test_an_arm_is_driven_and_calibrated_by_a_file_as_trials_are(tmp_path):
    file = tmp_path / "camera.yaml"
    file.write_text("preset: demo\ndeploy: {film_every: 3}\n")
    for name, args in (("deploy", ["--policy", "pretrained/student/policy.onnx"]), ("calibrate", [])):
        assert parse(name, [*args, "--config", str(file)]).config.deploy.film_every == 3
        with pytest.raises(UserError, match="--preset"):
            parse(name, [*args, "--config", str(file), "--preset", "demo"])


def test_help_shows_a_command_s_own_options_and_none_that_it_refuses(capsys):
    shown = {}
    for name in ("calibrate board", "ddg score", "ddg curve"):
        with pytest.raises(SystemExit):
            parse(name, ["--help"])
        shown[name] = capsys.readouterr().out
    assert "--board.square-mm" in shown["calibrate board"]
    assert "--columns" in shown["ddg score"] and "--curve-steps" not in shown["ddg score"]
    assert "--columns" not in shown["ddg curve"] and "--curve-steps" in shown["ddg curve"]
    assert "--ddg.unet" not in shown["ddg score"]


def test_help_of_deploy_says_what_each_camera_is_and_whose_configuration_counts():
    words = " ".join(ddgrasp("deploy", "--help").stdout.replace("│", " ").split())
    described = words.split("--camera {", 1)[1].split("}", 1)[1].split("--recording")[0]
    assert [camera for camera in CAMERAS if camera not in described] == []
    assert "Without --preset the configuration is that of the run that the policy lies in" in words


def test_help_of_a_command_may_stand_before_it():
    assert ddgrasp("help", "play").stdout == ddgrasp("play", "--help").stdout != ""


def test_version_names_the_libraries():
    assert "mujoco 3.17." in ddgrasp("--version").stdout


WRONG = [
    (("run", "--preset", "dmo"), "Unknown preset 'dmo'. Did you mean 'demo'?"),
    (("tacher", "train"), "Unknown command 'tacher'. Did you mean 'teacher'?"),
    (("teacher", "trian"), "Unknown command 'teacher trian'. Did you mean 'teacher train'?"),
    (("run", "--world.objects", "cube", "aple"), "Unknown object 'aple'. Did you mean 'apple'?"),
    (("report", "nowhere"), "nowhere is not there: name a run"),
    (
        ("run", "--out", "README.md"),
        "README.md/teacher cannot be created (Not a directory): choose another",
    ),
    (("teacher", "train", "--out", "README.md/a"), "README.md/a/teacher cannot be created (Not a"),
    (("teacher", "train", "--out", "/proc/a"), "/proc/a/teacher cannot be created (No such file or"),
    *(
        (("run", "--out", "a" * 300, *resume), "cannot be created (File name too long): choose another --out")
        for resume in ((), ("--resume",))
    ),
    (("run", "--demos.episodes", "0"), "demos.episodes is 0; expected at least 1."),
    (("teacher", "eval", "nowhere", "--trials", "0"), "--trials is 0; expected at least 1."),
    (("student", "eval", "nowhere", "--trials", "-1"), "--trials is -1; expected at least 1."),
    (
        ("ddg", "sample", "--model", "x", "--data", "x", "--count", "0"),
        "--count is 0; expected at least 1.",
    ),
    (
        ("export", "--export.depth-dtype", "uint8"),
        "Unknown export.depth_dtype 'uint8'. Known: float32_m",
    ),
    (
        ("demos", "collect", "--out", "nowhere"),
        "nowhere has no finished stage 'teacher': make it first, `ddgrasp teacher train --out nowhere`",
    ),
    (
        ("teacher", "eval", "nowhere"),
        "RUN-DIR is nowhere, which does not exist: give a run that has made teac",
    ),
    (("--foo",), "--foo is no option of ddgrasp by itself: give a command, see ddgrasp --help."),
    (("objects", "sheet", "--out", "tests"), "--out is tests, a folder: name a file, in it or elsewhere."),
    (("rig", "pictures", "--out", "README.md/a.png"), "README.md is no folder: name a file elsewhere."),
    (
        ("ddg", "score", "--columns", "monocular"),
        "depth_anything_v2_small",
    ),
    (("student", "eval", "nowhere"), "nowhere/student holds no finished artifact"),
    (
        ("study", "table2", "--out", "README.md"),
        "README.md/shared/teacher cannot be created (Not a directory)",
    ),
]


OF_THE_SYSTEM = ("teacher", "train", "--out", "/proc/a")
"""Told when the folder is made."""


@pytest.mark.parametrize(
    ("args", "expected"), [(args, text) for args, text in WRONG if args == OF_THE_SYSTEM]
)
def test_what_the_system_refuses_gets_one_line_and_status_2(args, expected):
    result = ddgrasp(*args)
    assert (result.returncode, result.stdout) == (2, "")
    need, error = result.stderr.splitlines()
    assert need.startswith("teacher: about ") and expected in error


def test_wrong_input_gets_one_line_and_status_2_before_jax_is_imported():
    """JAX and MJX take as many seconds as a person waits for the line."""
    given = [(args, text) for args, text in WRONG if args != OF_THE_SYSTEM]
    code = f"""
import contextlib, io, json, sys
from app.cli import main
told = []
for args in {[args for args, _ in given]}:
    said, printed = io.StringIO(), io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(printed):
        status = main(args)
    told.append((status, said.getvalue(), printed.getvalue()))
print(json.dumps([told, sorted({{"jax", "mujoco.mjx"}} & set(sys.modules))]))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    told, heavy = json.loads(done.stdout)
    assert len(told) == len(given) and heavy == []
    for (args, expected), (status, said, printed) in zip(given, told, strict=True):
        assert status == 2 and printed == "" and said.count("\n") == 1 and expected in said, (args, said)
    assert not (ROOT / "nowhere").exists()


def test_a_later_stage_of_another_configuration_is_told_before_jax_is_imported(tmp_path):
    artifacts.finish(tmp_path / "deploy", "deploy", PRESETS["debug"], seconds=1.0, metrics={})
    args = ["run", "--preset", "debug", "--out", str(tmp_path), "--resume", "--evaluation.rig-trials", "7"]
    code = f"import sys; from app.cli import main; print(main({args}), 'jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.stdout == "2 False\n", done.stderr
    assert "deploy was made with another configuration" in done.stderr and done.stderr.count("\n") == 1
    assert "evaluation.rig_trials is" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["deploy"]


def test_a_file_that_cannot_be_written_is_named_in_one_line_and_no_temporary_one(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    (tmp_path / "a.png").mkdir()
    for out, trouble in (
        ("file/a.png", "file cannot be written (File exists): have it written elsewhere."),
        ("a.png", "a.png cannot be written (Is a directory): have it written elsewhere."),
        ("a" * 250, "cannot be read or written (File name too long): mend that, or give another path."),
    ):
        writes = SimpleNamespace(run=partial(atomic_write_bytes, tmp_path / out, b""))
        monkeypatch.setattr(commands, "parse", lambda name, args, writes=writes: writes)
        result = ddgrasp("objects", "list")
        assert result.returncode == 1
        told = _one_error_line(result)
        assert told.startswith(f"ddgrasp: {tmp_path}") and trouble in told and ".tmp-" not in told


def test_an_export_looks_at_out_before_it_works(tmp_path):
    (tmp_path / "file").touch()
    below = tmp_path / "file" / "a" / "g.onnx"
    for out, trouble in ((tmp_path, "a folder: name"), (below, f"and {tmp_path}/file is no folder: name")):
        with pytest.raises(UserError, match=f"--out is {out}, {trouble}"):
            parse("ddg export", ["--model", "nowhere", "--out", str(out)]).run()


def test_the_nearest_option_is_named_without_what_stands_behind_it():
    with pytest.raises(UserError, match=r"Unrecognized options: --mesh\. Did you mean --meshes\? Options:"):
        parse("objects list", ["--mesh"])


def test_an_unknown_option_is_named():
    result = ddgrasp("run", "--teacher.bogus", "3")
    assert result.returncode == 2
    assert "--teacher.bogus" in result.stderr


def test_a_full_disk_gets_one_line(tmp_path):
    code = f"""
import resource, sys
from ddgrasp import artifacts
from ddgrasp.files import atomic_write_bytes
from app import cli
from app import commands
resource.setrlimit(resource.RLIMIT_FSIZE, (512, resource.RLIM_INFINITY))
class Fill:
    def run(self):
        atomic_write_bytes({str(tmp_path / "x")!r}, bytes(9999))
commands.parse = lambda name, args: Fill()
sys.exit(cli.main(["export"]))
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 1
    assert _one_error_line(result).startswith("ddgrasp: No space left on the disk")


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_is_selected_by_its_name_and_names_known_objects(name):
    command = parse("run", ["--preset", name])
    assert command.config == PRESETS[name] == check_config_values(PRESETS[name])
    assert PRESETS[name].preset == name
    assert command.out == Path("runs") / name


def test_single_values_override_a_preset():
    command = parse(
        "run", ["--preset=debug", "--seed", "3", "--world.episode-steps", "9", "--resume", "--out", "x"]
    )
    assert (command.config.seed, command.config.world.episode_steps) == (3, 9)
    assert (command.resume, command.out) == (True, Path("x"))
    assert command.config.student == PRESETS["debug"].student


def test_unknown_objects_suggest_the_nearest():
    debug = PRESETS["debug"]
    wrong = dataclasses.replace(debug, world=dataclasses.replace(debug.world, objects=("cubes",)))
    with pytest.raises(UserError, match="Did you mean 'cube'"):
        check_config_values(wrong)
    with pytest.raises(UserError, match="world.objects is empty; expected at least one"):
        dataclasses.replace(debug.world, objects=())


def _with(section: str, **values):
    """The preset debug with other values in a section, for example student.encoder."""
    return with_values(PRESETS["debug"], {f"{section}.{name}": value for name, value in values.items()})


@pytest.mark.parametrize(
    ("section", "values", "expected"),
    [
        ("student", {"init_from": "runs/no"}, "student.init_from is 'runs/no', which does not exist: give a"),
        ("student", {"init_from": "ddgrasp"}, "'ddgrasp', which holds no params.msgpack: give a run or"),
        ("teacher", {"start": "pretrained/x"}, "does not exist: .*/pretrained has what comes with"),
        ("teacher", {"start": "pretrained/student"}, r"holds no policy.msgpack: \S+/pretrained has what"),
        ("ddg", {"init_from": "runs/no"}, "ddg.init_from is 'runs/no', which does not exist"),
        ("ddg", {"init_from": "pretrained/student"}, r"init_from is \S+student, which is of stage 'student'"),
        (
            "ddg.prior",
            {"source": "inverse_dept"},
            "Unknown ddg.prior.source 'inverse_dept'. Did you mean 'inverse_depth'",
        ),
        (
            "ddg.training",
            {"snr_limits": (5.0, 1.0)},
            r"snr_limits is \(5.0, 1.0\); expected two numbers above",
        ),
        ("ddg.prior", {"in_sim": "deph"}, "Unknown ddg.prior.in_sim 'deph'. Did you mean 'depth'"),
        (
            "ddg.prior",
            {"source": "depth_anything_v2", "weights": "no"},
            "no holds no converted weights",
        ),
        (
            "export",
            {"depth_dtype": "uint8"},
            "'uint8'. Known: float32_m, uint16_mm",
        ),
        ("student.encoder", {"weights": "no"}, "needs|holds no converted weights"),
    ],
)
def test_names_and_files_are_checked_before_any_stage(section, values, expected, monkeypatch):
    monkeypatch.chdir(ROOT)
    with pytest.raises(UserError, match=expected):
        check_config_values(_with(section, **values))


@pytest.mark.parametrize(
    ("stage", "name"), [("student", "init_from"), ("ddg", "init_from"), ("teacher", "start")]
)
def test_a_start_that_is_gone_is_missed_by_an_unfinished_stage_alone(tmp_path, monkeypatch, stage, name):
    monkeypatch.chdir(ROOT)
    config = _with(stage, **{name: "runs/no"})
    with pytest.raises(UserError, match="which does not exist"):
        check_config_values(config, tmp_path)
    artifacts.finish(tmp_path / stage, stage, config, seconds=1.0, metrics={})
    assert check_config_values(config, tmp_path) is config


def test_two_starts_for_the_student_are_refused():
    student = PRESETS["demo"].student
    with pytest.raises(UserError, match="both say where to start"):
        dataclasses.replace(student, encoder=dataclasses.replace(student.encoder, weights="no"))


def test_a_start_is_found_in_a_run_and_in_a_stage_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    (tmp_path / "student").mkdir()
    (tmp_path / "student" / "params.msgpack").touch()
    for folder in (tmp_path, tmp_path / "student"):
        config = _with("student", init_from=str(folder))
        assert check_config_values(config) is config


def test_a_start_of_another_network_is_refused_before_any_stage(tmp_path):
    demo = PRESETS["demo"]
    unet = dataclasses.replace(demo.ddg.unet, widths=(8, 16, 24))
    ddg = dataclasses.replace(demo.ddg, unet=unet, init_from="pretrained/ddg")
    with pytest.raises(UserError, match=r"ddg has ddg\.unet\.widths .* configuration \(8, 16, 24\)"):
        check_config_values(dataclasses.replace(demo, ddg=ddg))
    for name, value, expected in (
        ("student.head.chunk", demo.student.head.chunk + 1, "params.msgpack does not fit this"),
        ("student.head.blocks", 2, "block2.* is in the file, not in the network"),
        ("student.picture.channels", ("valid", "relief"), r"student.picture.channels \('relief'"),
        ("student.encoder.output_stride", 16, "output_stride 8, this configuration 16"),
    ):
        with pytest.raises(UserError, match=expected):
            check_networks(with_values(demo, {name: value}), tmp_path)


def test_a_stage_by_itself_is_refused_what_a_run_is(tmp_path):
    demo = PRESETS["demo"]
    for name in ("teacher", "demos", "ddg"):
        artifacts.finish(tmp_path / name, name, demo, seconds=1.0, metrics={})
    options = ["--preset", "demo", "--out", str(tmp_path), "--student.hand-view.pitch-m", "0.008"]
    with pytest.raises(UserError, match=r"hand_view.pitch_m 0.004, this configuration 0.008"):
        parse("student train", options).run()
    assert not (tmp_path / "student").exists()


def test_a_generator_of_another_shape_than_the_camera_is_refused_before_any_stage(tmp_path):
    square = _with("ddg.depth", height_px=80)
    with pytest.raises(
        UserError, match=r"depth is 160x90, the generator's 80x80: .*height-px 45\.$"
    ) as refused:
        check_networks(square, tmp_path)
    assert "\n" not in str(refused.value) and not list(tmp_path.iterdir())
    formula = dataclasses.replace(square.student, depth_source="dextrah")
    assert len(check_networks(dataclasses.replace(square, student=formula), tmp_path)) == 3
    assert check_config_values(square) is square  # a real camera's, to be fitted or scored by itself


def test_a_fitted_generator_is_found_in_a_run_and_in_its_folder(tmp_path):
    ddg = artifacts.finish(tmp_path / "ddg", "ddg", PRESETS["debug"], seconds=1.0, metrics={}).directory
    assert stage_folder("--model", tmp_path, "ddg") == stage_folder("--model", ddg, "ddg") == ddg
    with pytest.raises(UserError, match=r"--model is nowhere, which does not exist: give a run"):
        stage_folder("--model", Path("nowhere"), "ddg")
    with pytest.raises(UserError, match="holds no finished stage: give a run that has made demos"):
        stage_folder("--demos", tmp_path, "demos")
    with pytest.raises(UserError, match=r"--demos is \S+ddg, which is of stage 'ddg': give a run that has"):
        stage_folder("--demos", ddg, "demos")


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("ddg fit --data {}", "--data is {}, which holds no recording (color/, depth/, meta.json): give one"),
        ("ddg fit --data {}/a.bag", "--data is {}/a.bag, a file: give a recording or a folder of them"),
        ("ddg fit --data {}/a.bag", "`ddgrasp record import {}/a.bag` makes one"),
        ("ddg distil --model pretrained/ddg --data {}", "--data is {}, which holds no recording"),
        (
            "ddg distil --model pretrained/ddg --data {} --evaluations 16",
            "--evaluations is 16; expected 8, 4, 2, 1: the generator's ddg.training.distil_from, 16, halved",
        ),
        ("ddg score --real {}", "--real is {}, which holds no recording"),
        ("ddg generate --model pretrained/ddg --demos pretrained/student", "is of stage 'student': give a"),
        ("ddg generate --model pretrained/ddg --demos {}", "{}/demos/episodes.zarr is no episode store"),
    ],
)
def test_material_that_is_none_is_refused_before_a_stage_is_begun(command, expected, tmp_path):
    (material := tmp_path / "material").mkdir()
    (material / "a.bag").touch()
    artifacts.finish(material / "demos", "demos", PRESETS["debug"], seconds=1.0, metrics={})
    group, name, *options = command.format(material).split()
    with pytest.raises(UserError) as error:
        parse(f"{group} {name}", [*options, "--out", str(tmp_path / "out")]).run()
    assert expected.format(material) in str(error.value)
    assert not (tmp_path / "out").exists()


def test_what_is_absent_is_brought_to_the_python_that_runs(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "prefix", str(tmp_path / ".venv"))
    monkeypatch.setattr(sys, "executable", str(tmp_path / ".venv" / "bin" / "python"))
    monkeypatch.setenv("VIRTUAL_ENV", str(tmp_path / ".venv"))
    assert pip_install("view") == "pip install 'ddgrasp[view]'"
    monkeypatch.delenv("VIRTUAL_ENV")
    assert pip_install("view") == ".venv/bin/python -m pip install 'ddgrasp[view]'"


def test_the_checkpoints_are_those_the_stages_write():
    import ddg_jax.sample
    import ppo.policy
    import student_jax.policy

    modules = {"teacher": ppo.policy, "ddg": ddg_jax.sample, "student": student_jax.policy}
    assert {name: module.PARAMS_FILE for name, module in modules.items()} == CHECKPOINTS


@pytest.mark.parametrize(
    ("section", "name"),
    [
        ("demos", "episodes"), ("demos", "parallel"), ("record", "trajectories"), ("record", "frames"),
        ("evaluation", "teacher_trials"), ("evaluation", "student_trials"), ("evaluation", "rig_trials"),
        ("student.training", "batch_size"), ("teacher", "unroll_steps"), ("ddg.sampling", "steps"),
        ("export", "latency_runs"), ("world", "episode_steps"),
    ],
)  # fmt: skip
def test_a_count_below_one_is_named_with_its_minimum(section, name):
    assert attrgetter(f"{section}.{name}")(_with(section, **{name: 1})) == 1
    for value in (0, -3):
        with pytest.raises(UserError, match=rf"{section}\.{name} is {value}; expected at least 1\."):
            _with(section, **{name: value})


def test_of_an_option_given_twice_the_last_counts():
    config = parse("run", ["--preset", "demo", "--preset", "laptop"]).config
    assert config == PRESETS["laptop"]


def test_a_flag_may_say_what_is_so_already():
    for flag, filled in (("fill-holes", True), ("no-fill-holes", False)):
        given = parse("student train", ["--preset", "demo", f"--student.picture.{flag}"])
        assert given.config.student.picture.fill_holes == filled


def test_what_comes_with_the_project_is_not_measured_over():
    with pytest.raises(UserError, match="comes with the project, .*give --out FOLDER"):
        parse("teacher eval", ["pretrained", "--trials", "1"]).run()


def test_a_teacher_s_world_is_its_run_s_wherever_the_run_stands(tmp_path):
    config = dataclasses.replace(PRESETS["demo"], world=PRESETS["ppo_paper"].world)
    artifacts.finish(tmp_path / "teacher", "teacher", config, seconds=1.0, metrics={})
    for place in (str(tmp_path), str(tmp_path / "teacher")):
        for args in ([place, "--trials", "5"], ["--trials", "5", place]):
            assert parse("teacher eval", args).world == config.world
            assert parse("teacher eval", [*args, "--out", place]).world == config.world
    student = artifacts.finish(tmp_path / "student", "student", config, seconds=1.0, metrics={}).directory
    assert parse("teacher eval", [str(student)]).world == PRESETS["demo"].world  # and `run` says what it is


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("ddg score --real REAL --trajectories 200", "--trajectories"),
        ("ddg score --real REAL --repeat-scenes 2", "--repeat-scenes"),
        ("ddg score --curve-steps 9", "--curve-steps"),
        ("ddg curve --columns inpaint ddg", "--columns"),
        ("ddg curve --repeats 3", "--repeats"),
        ("ddg samplers --tsne-maps 9", "--tsne-maps"),
        ("ddg samplers --inpaint-radius-px 5", "--inpaint-radius-px"),
        ("ddg samplers --curve-trajectories 5", "--curve-trajectories"),
    ],
)
def test_what_a_score_would_not_read_is_refused(command, option, tmp_path):
    words = [str(tmp_path) if word == "REAL" else word for word in command.split()]
    with pytest.raises(UserError, match=rf"^{option}: .* does nothing with it; leave it out\.$"):
        parse(" ".join(words[:2]), [*words[2:], "--out", str(tmp_path / "out")]).run()


@pytest.mark.parametrize("kind", ["curve", "samplers"])
def test_a_second_extractor_is_refused_where_one_is_read(kind, tmp_path):
    several = ["--features", "depthfeat-v1", "resnet18", "--out", str(tmp_path)]
    with pytest.raises(
        UserError, match=rf"^--features depthfeat-v1 resnet18: `ddgrasp ddg {kind}` scores by one"
    ):
        parse(f"ddg {kind}", several).run()


def test_what_is_practised_on_a_rig_lies_apart_from_an_arms_own_and_another_rigs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert drive_command("127.0.0.1", True).endswith("--out runs/practice/calibration.json")
    assert drive_command("127.0.0.1", False).endswith("--camera rig --out runs/practice")
    (tmp_path / "runs" / "practice").mkdir(parents=True)
    (tmp_path / "runs" / "practice" / "calibration.json").touch()
    assert drive_command("127.0.0.1", False).endswith(
        "--out runs/practice --calibration runs/practice/calibration.json"
    )
    assert drive_command("127.0.0.2", False).endswith("--camera rig --out runs/practice/127.0.0.2")
