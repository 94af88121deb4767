"""Artefacts survive a full disk and an interruption, and refuse what does not fit."""

import dataclasses
import errno
import json
import os
import resource
import stat
import subprocess
import sys
import tempfile
import textwrap
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from app.cli import main
from ddgrasp import artifacts, attempts, contract
from ddgrasp.config import Config, ExportConfig, WorldConfig
from ddgrasp.config_hash import config_hash
from ddgrasp.errors import UserError
from ddgrasp.files import (
    atomic_path,
    atomic_write_bytes,
    atomic_write_json,
    atomic_write_text,
    new_folder,
    read_json,
    replaced_folder,
    to_json,
    user_cache,
)
from ddgrasp.presets import PRESETS
from ddgrasp.scaling import with_values
from ddgrasp.stages import get_stage

CONFIG = Config(preset="debug")


def _finish(directory, config=CONFIG, **kwargs):
    return artifacts.finish(directory, "export", config, seconds=1.5, metrics={"x": 1}, **kwargs)


def test_a_failing_write_leaves_the_previous_file_and_no_litter(tmp_path):
    path = tmp_path / "params.bin"
    atomic_write_bytes(path, b"old")
    with pytest.raises(KeyboardInterrupt), atomic_path(path) as temporary:
        temporary.write_bytes(b"half of the n")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["params.bin"]


def test_bytes_are_on_the_disk_before_they_have_their_name_and_the_name_is(tmp_path, monkeypatch):
    """Or a power cut leaves an empty file of that name."""
    did: list[str] = []
    fsync, rename = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda number: did.append("on disk") or fsync(number))
    monkeypatch.setattr(os, "replace", lambda one, other: did.append("named") or rename(one, other))
    atomic_write_text(tmp_path / "a.json", "1")
    assert did == ["on disk", "named", "on disk"]


def test_what_a_process_of_the_same_number_left_or_writes_is_in_nobody_s_way(tmp_path, monkeypatch):
    """In a container every process is number 1."""
    monkeypatch.setattr(os, "getpid", lambda: 1)
    with new_folder(tmp_path / "set") as left, atomic_path(tmp_path / "file") as half:
        left.mkdir()
        half.write_bytes(b"half")
        with new_folder(tmp_path / "set") as folder:
            folder.mkdir(exist_ok=False)
        atomic_write_bytes(tmp_path / "file", b"whole")
        assert half.read_bytes() == b"half" and (tmp_path / "file").read_bytes() == b"whole"


def test_another_s_half_written_file_stays_where_it_may_be_at_work(tmp_path):
    with atomic_path(tmp_path / "study.png") as temporary:
        temporary.write_bytes(b"half")
        attempts.begin(tmp_path, "export", CONFIG, clean=False)
        assert temporary.exists()
        attempts.begin(tmp_path, "export", CONFIG)
        assert not temporary.exists()
        temporary.write_bytes(b"whole")


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path / "sets" / "set") as temporary:
        (temporary / "inner").mkdir(parents=True)
        raise KeyboardInterrupt
    assert list((tmp_path / "sets").iterdir()) == []
    with new_folder(tmp_path / "sets" / "set") as temporary:
        temporary.mkdir()
        (temporary / "file").write_text("whole")
        assert [path.name for path in (tmp_path / "sets").iterdir()] == [temporary.name]
    assert (tmp_path / "sets" / "set" / "file").read_text() == "whole"
    assert len(list((tmp_path / "sets").iterdir())) == 1
    with pytest.raises(OSError), new_folder(tmp_path / "sets" / "set") as temporary:
        temporary.mkdir()
    assert (tmp_path / "sets" / "set" / "file").read_text() == "whole"


def test_a_folder_is_replaced_by_a_whole_one_or_stays(tmp_path):
    path = tmp_path / "sets" / "set"
    for text in ("first", "second"):
        with replaced_folder(path) as temporary:
            temporary.mkdir()
            (temporary / "file").write_text(text)
        assert (path / "file").read_text() == text
    with pytest.raises(KeyboardInterrupt), replaced_folder(path) as temporary:
        temporary.mkdir()
        raise KeyboardInterrupt
    assert (path / "file").read_text() == "second"
    assert [there.name for there in path.parent.iterdir()] == ["set"]


def test_a_link_to_a_folder_is_replaced_and_what_it_leads_to_stays(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "file").write_text("kept")
    (tmp_path / "sets").mkdir()
    (tmp_path / "sets" / "set").symlink_to(tmp_path / "elsewhere")
    with replaced_folder(tmp_path / "sets" / "set") as temporary:
        temporary.mkdir()
    assert [there.name for there in (tmp_path / "sets").iterdir()] == ["set"]
    assert not (tmp_path / "sets" / "set").is_symlink()
    assert (tmp_path / "elsewhere" / "file").read_text() == "kept"


def test_a_folder_that_cannot_be_synced_costs_no_file(tmp_path, monkeypatch):
    """As shared folders of virtual machines."""
    sync = os.fsync

    def of_files_alone(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", of_files_alone)
    atomic_write_text(tmp_path / "file", "whole")
    assert (tmp_path / "file").read_text() == "whole"

    def full(descriptor):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="Input/output error"):
        atomic_write_text(tmp_path / "other", "half")
    assert [there.name for there in tmp_path.iterdir()] == ["file"]


def test_programs_that_others_may_have_written_are_not_run(tmp_path, monkeypatch, capsys):
    for name in ("DDGRASP_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def nowhere():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nowhere)
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    (cache := user_cache("jax").parent).chmod(0o777)
    assert cache == tmp_path / f"ddgrasp-{os.getuid()}"
    with pytest.raises(UserError, match="may be written to by others: delete it, or set DDGRASP_CACHE"):
        user_cache("jax")
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    assert main(["objects", "list"]) == 2 and "set DDGRASP_CACHE" in capsys.readouterr().err
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "mine"))
    assert main(["objects", "list"]) == 0
    cache.chmod(0o700)
    assert user_cache("jax") == cache / "jax"
    monkeypatch.setattr(os, "getuid", lambda: cache.lstat().st_uid + 1)
    (tmp_path / f"ddgrasp-{os.getuid()}").mkdir()  # somebody else's
    with pytest.raises(UserError, match="may be written to by others"):
        user_cache("jax")


def test_who_is_interrupted_between_two_renames_keeps_the_old_folder(tmp_path, monkeypatch):
    path, rename, renames = tmp_path / "set", os.replace, []

    def interrupted(source, target):
        renames.append(target)
        if len(renames) == 2:
            raise KeyboardInterrupt
        rename(source, target)

    path.mkdir()
    (path / "file").write_text("old")
    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt), replaced_folder(path) as temporary:
        temporary.mkdir()
    assert (path / "file").read_text() == "old" and renames[1:] == [path, path]
    assert [there.name for there in tmp_path.iterdir()] == ["set"]


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"DDGRASP_CACHE": "/a", "XDG_CACHE_HOME": "/b"}, "/a/jax"),
        ({"XDG_CACHE_HOME": "/b"}, "/b/ddgrasp/jax"),
        ({"HOME": "/c"}, "/c/.cache/ddgrasp/jax"),
        ({"XDG_CACHE_HOME": "", "DDGRASP_CACHE": "", "HOME": "/c"}, "/c/.cache/ddgrasp/jax"),
    ],
)
def test_caches_are_where_the_environment_says(environment, expected, monkeypatch):
    for name in ("DDGRASP_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert user_cache("jax") == Path(expected)


@pytest.mark.parametrize("make", [atomic_path, new_folder])
def test_what_cannot_be_written_is_called_by_its_own_name(make, tmp_path):
    path = tmp_path / "is" / "there"
    (path / "file").mkdir(parents=True)
    with pytest.raises(OSError) as replaced, make(path) as temporary:
        temporary.mkdir() if make is new_folder else temporary.touch()
    assert str(replaced.value).endswith(f": '{path}'")
    with pytest.raises(FileNotFoundError) as opened, make(tmp_path / "new") as temporary:
        open(temporary)
    assert str(opened.value).endswith(f": '{tmp_path / 'new'}'")


def test_a_disk_that_fills_up_mid_write_leaves_the_previous_artifact(tmp_path):
    """The limit on file size makes the operating system itself refuse the write half-way."""
    path = tmp_path / "params.bin"
    atomic_write_bytes(path, b"old")
    code = f"""
        import resource, sys
        from ddgrasp.files import atomic_write_bytes
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, {resource.getrlimit(resource.RLIMIT_FSIZE)[1]}))
        try:
            atomic_write_bytes({str(path)!r}, bytes(100_000))
        except OSError as error:
            sys.exit(error.errno)
    """
    result = subprocess.run([sys.executable, "-c", textwrap.dedent(code)])
    assert result.returncode == 27  # EFBIG
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["params.bin"]


def test_a_manifest_round_trips_and_names_its_parents(tmp_path):
    parent = artifacts.finish(tmp_path / "student", "student", CONFIG, seconds=2, metrics={})
    child = _finish(tmp_path / "export", parents=[parent], origin="loaded")
    read = artifacts.read_artifact(tmp_path / "export")
    assert read == child
    assert read.manifest.parents == {"student": parent.hash}
    assert (read.manifest.origin, read.manifest.seconds, read.manifest.metrics) == ("loaded", 1.5, {"x": 1})
    assert read.manifest.versions["ddgrasp"] == version("ddgrasp")
    assert read.manifest.versions["mujoco"].startswith("3.17.")


def test_every_finish_has_its_own_hash(tmp_path):
    first = artifacts.finish(tmp_path / "a", "teacher", CONFIG, seconds=1, metrics={"loss": 0.1})
    second = artifacts.finish(tmp_path / "b", "teacher", CONFIG, seconds=1, metrics={"loss": 0.2})
    assert first.hash != second.hash


def test_the_config_hash_covers_a_stage_and_what_it_is_made_from_only():
    changed = dataclasses.replace(CONFIG, export=dataclasses.replace(CONFIG.export, latency_runs=7))
    assert config_hash(changed, "export") != config_hash(CONFIG, "export")
    assert config_hash(changed, "teacher") == config_hash(CONFIG, "teacher")
    renamed = dataclasses.replace(CONFIG, preset="mine")
    assert config_hash(renamed, "export") == config_hash(CONFIG, "export")
    reseeded = dataclasses.replace(CONFIG, seed=1)
    assert config_hash(reseeded, "teacher") != config_hash(CONFIG, "teacher")


def test_an_accepted_difference_is_no_part_of_what_a_stage_is(tmp_path):
    looser = dataclasses.replace(CONFIG, export=dataclasses.replace(CONFIG.export, max_abs_diff=1e-3))
    assert config_hash(looser, "export") == config_hash(CONFIG, "export")
    attempts.begin(tmp_path, "deploy", CONFIG)
    (tmp_path / "student").touch()
    attempts.begin(tmp_path, "deploy", looser)
    _finish(tmp_path / "export")
    artifacts.require(tmp_path, "export", looser)


@pytest.mark.parametrize(
    ("name", "value", "stage"),
    [
        ("evaluation.teacher_trials", 7, "teacher"),  # decides which policy is kept
        ("evaluation.student_trials", 7, "student"),
        ("deploy.noise", "normal", "student"),  # how the student acts in DAgger
        ("evaluation.rig_trials", 7, "deploy"),
    ],
)
def test_what_a_stage_reads_of_another_section_is_part_of_what_it_is(name, value, stage):
    changed = with_values(CONFIG, {name: value})
    assert config_hash(changed, stage) != config_hash(CONFIG, stage)
    before = get_stage(stage).parents
    assert all(config_hash(changed, p) == config_hash(CONFIG, p) for p in before)


@pytest.mark.parametrize(
    ("name", "stage"),
    [
        ("deploy.workers", "deploy"),
        ("teacher.checkpoint_every", "deploy"),
        ("ddg.training.checkpoint_every", "ddg"),
    ],
)
def test_how_a_result_comes_about_may_change_on_resume(name, stage, tmp_path):
    attempts.begin(tmp_path, stage, CONFIG)
    (tmp_path / "work").touch()
    attempts.check_place(tmp_path, stage, with_values(CONFIG, {name: 3}))


@pytest.mark.parametrize("name", ["deploy.franka.host", "deploy.realsense.serial"])
def test_a_lab_s_own_devices_do_not_forbid_to_go_on(name, tmp_path):
    attempts.begin(tmp_path, "deploy", CONFIG)
    (tmp_path / "work").touch()
    section, field = name.split(".")[1:]
    mine = dataclasses.replace(getattr(CONFIG.deploy, section), **{field: "192.168.0.7"})
    deploy = dataclasses.replace(CONFIG.deploy, **{section: mine})
    attempts.check_place(tmp_path, "deploy", dataclasses.replace(CONFIG, deploy=deploy))


def test_an_artifact_of_another_config_is_refused_naming_both_values(tmp_path):
    _finish(tmp_path / "export")
    other = dataclasses.replace(CONFIG, export=ExportConfig(latency_runs=7))
    with pytest.raises(UserError, match=r"export\.latency_runs is 200 there, 7 here") as error:
        artifacts.require(tmp_path, "export", other)
    assert config_hash(CONFIG, "export") in str(error.value)
    assert config_hash(other, "export") in str(error.value)
    assert "\n" not in str(error.value)
    artifacts.require(tmp_path, "export", CONFIG)


def test_an_unfinished_attempt_of_another_config_is_refused(tmp_path):
    attempts.begin(tmp_path / "teacher", "teacher", CONFIG)
    (tmp_path / "teacher" / "checkpoint").touch()
    attempts.begin(tmp_path / "teacher", "teacher", CONFIG)
    other = dataclasses.replace(CONFIG, world=WorldConfig(episode_steps=7))
    with pytest.raises(UserError, match=r"world\.episode_steps is 60 there, 7 here"):
        attempts.begin(tmp_path / "teacher", "teacher", other)


@pytest.mark.parametrize("damage", ["whole", "config", "inputs"])
def test_notes_that_are_none_are_named(tmp_path, damage):
    (directory := tmp_path / "teacher").mkdir()
    begun = {"contract_version": contract.CONTRACT_VERSION, "inputs": {}, "config": to_json(CONFIG)}
    (directory / attempts.STARTED).write_text(json.dumps([] if damage == "whole" else begun | {damage: []}))
    (directory / "checkpoint").touch()
    with pytest.raises(UserError, match=r"teacher/started\.json does not say how a stage was begun: delete"):
        attempts.begin(directory, "teacher", CONFIG)
    artifacts.finish(directory, "teacher", CONFIG, seconds=1, metrics={})
    with pytest.raises(UserError, match=r"teacher/started\.json does not say how a stage was begun: delete"):
        attempts.check_inputs(directory, {})
    path = directory / artifacts.MANIFEST
    made = read_json(path)
    path.write_text(json.dumps([] if damage == "whole" else made | {damage.replace("inputs", "parents"): 3}))
    with pytest.raises(UserError, match=r"teacher/manifest\.json is no manifest of this project: move it"):
        artifacts.require(tmp_path, "teacher", CONFIG)


def test_an_unfinished_attempt_with_other_inputs_is_refused(tmp_path):
    attempts.begin(tmp_path / "ddg", "ddg", CONFIG, {"data": "/a"})
    (tmp_path / "ddg" / "checkpoint").touch()
    with pytest.raises(UserError, match="data is '/a' there, '/b' here"):
        attempts.begin(tmp_path / "ddg", "ddg", CONFIG, {"data": "/b"})
    with pytest.raises(UserError, match="begun with other inputs: model is None there, 'x' here"):
        attempts.begin(tmp_path / "ddg", "ddg", CONFIG, {"data": "/a", "model": "x"})
    with pytest.raises(UserError, match="begun with other inputs: data is '/a' there, None here"):
        attempts.begin(tmp_path / "ddg", "ddg", CONFIG)


def test_an_attempt_that_left_nothing_binds_nobody(tmp_path):
    attempts.begin(tmp_path / "ddg", "ddg", CONFIG, {"data": "/a typing error"})
    (tmp_path / "ddg" / ".tmp-123-params").write_bytes(b"half")
    (tmp_path / "ddg" / ".tmp-123-checkpoint" / "0").mkdir(parents=True)
    (tmp_path / "ddg" / ".tmp-123-checkpoint" / "0" / "state").write_bytes(b"half")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "ddg" / ".tmp-123-link").symlink_to(tmp_path / "elsewhere")
    assert not attempts.has_work(tmp_path / "ddg")
    attempts.begin(tmp_path / "ddg", "ddg", CONFIG, {"data": "/b"})
    assert [file.name for file in (tmp_path / "ddg").iterdir()] == [attempts.STARTED]
    assert (tmp_path / "elsewhere").is_dir()
    assert read_json(tmp_path / "ddg" / attempts.STARTED)["inputs"] == {"data": "/b"}


def test_empty_folders_bind_nobody_and_a_file_in_them_does(tmp_path):
    directory, other = tmp_path / "teacher", dataclasses.replace(CONFIG, seed=5)
    attempts.begin(directory, "teacher", CONFIG)
    (directory / "checkpoints" / "0").mkdir(parents=True)
    assert not attempts.has_work(directory)
    attempts.begin(directory, "teacher", other)
    (directory / "checkpoints" / "0" / "state").touch()
    assert attempts.has_work(directory)
    with pytest.raises(UserError, match="teacher was begun with another configuration .*seed is 5 there, 0"):
        attempts.begin(directory, "teacher", CONFIG)


def test_an_artifact_of_another_contract_version_is_refused(tmp_path):
    _finish(tmp_path / "export")
    path = tmp_path / "export" / artifacts.MANIFEST
    value = json.loads(path.read_text())
    value["contract_version"] = 99
    path.write_text(json.dumps(value))
    with pytest.raises(UserError, match=f"contract version 99, this code has {contract.CONTRACT_VERSION}"):
        artifacts.read_manifest(tmp_path / "export")


@pytest.mark.parametrize("text", ['{"stage": "exp', "[]", '{"stage": "export"}', "\xff"])
def test_a_damaged_manifest_is_named(tmp_path, text):
    _finish(tmp_path / "export")
    (tmp_path / "export" / artifacts.MANIFEST).write_text(text, encoding="latin-1")
    with pytest.raises(UserError, match=r"manifest\.json"):
        artifacts.read_manifest(tmp_path / "export")


@pytest.mark.parametrize(
    "damage",
    [
        {"manifest_version": "13"},
        {"manifest_version": None},
        {"origin": "x"},
        {"origin": ["trained"]},
        {"seed": "<script>alert(1)</script>"},
        {"seed": True},
        {"seconds": "long"},
        {"seconds": float("nan")},
        {"seconds": 10**400},
        {"versions": ["jax"]},
        {"machine": "a laptop"},
        {"machine": {"processor": "a"}},
        {"machine": {"processor": "a", "cores": 2, "accelerators": [1]}},
        {"config": {"preset": "debug", "student": 3}},
        {"config": {"preset": "debug", "student": {"head": None}}},
        {"config": {"preset": "debug", "world": {"random": []}}},
        {"config": {"preset": "debug", "deploy": []}, "manifest_version": 5},
        {"config": {"preset": "debug", "ddg": 3}, "manifest_version": 1},
        {"config": {"student": {"input_width_px": "wide"}}, "manifest_version": 1},
    ],
    ids=str,
)
def test_a_manifest_of_other_values_than_this_project_writes_is_named(tmp_path, damage):
    directory = _finish(tmp_path / "export").directory
    path = directory / artifacts.MANIFEST
    path.write_text(json.dumps(read_json(path) | damage))
    with pytest.raises(UserError) as error:
        artifacts.require(tmp_path, "export", CONFIG)
    assert str(error.value) == (
        f"{path} is no manifest of this project: move it elsewhere if it is another program's; if "
        f"{directory} is a stage of a run, delete that and run the stage again."
    )
    if not damage.keys() <= {"config", "manifest_version"}:
        return
    begun = {"contract_version": contract.CONTRACT_VERSION, "inputs": {}, "config": to_json(CONFIG)}
    path.rename(directory / "checkpoint")
    (directory / attempts.STARTED).write_text(json.dumps(begun | damage))
    with pytest.raises(UserError, match=r"started\.json does not say how a stage was begun: delete"):
        attempts.begin(directory, "export", CONFIG)


def test_an_absent_stage_is_named_with_the_remedy(tmp_path):
    with pytest.raises(
        UserError, match="has no finished stage 'teacher': make it first, `ddgrasp teacher train --out"
    ):
        artifacts.require(tmp_path, "teacher", CONFIG)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_config_survives_its_journey_through_json(name):
    value = json.loads(json.dumps(to_json(PRESETS[name])))
    assert artifacts.config_from_json(value) == PRESETS[name]


def test_a_config_without_a_field_that_has_no_default_is_refused():
    with pytest.raises(UserError, match="config lacks 'preset', which has no default"):
        artifacts.config_from_json({"world": {}})


def test_a_config_with_an_unknown_field_is_refused():
    value = to_json(CONFIG)
    value["world"]["gravity"] = 3
    with pytest.raises(UserError, match=r"config\.world has no field 'gravity'"):
        artifacts.config_from_json(value)


def test_json_is_strict_and_plain(tmp_path):
    value = {"nan": float("nan"), "array": np.arange(3), "number": np.float32(0.5), "path": tmp_path, 1: (2,)}
    atomic_write_json(tmp_path / "a.json", value)
    assert read_json(tmp_path / "a.json") == {
        "nan": None, "array": [0, 1, 2], "number": 0.5, "path": str(tmp_path), "1": [2],
    }  # fmt: skip
