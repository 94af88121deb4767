"""Manifests and started stages of earlier versions are read, accepted and continued."""

import dataclasses
import json
from pathlib import Path

import pytest

from ddgrasp import artifacts, attempts, contract, upgrades
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_json, read_json, to_json
from ddgrasp.presets import PRESETS
from ddgrasp.stages import ON_REQUEST, STAGES
from upgrades_support import config_hash_of_version, downgraded

ROOT = Path(__file__).parents[1]


def _as_before(config):
    """`config` as it was before versions 5, 7, 8, 9, 10 and 14: a closing of the gripper could be taken back,
    demos were taken whole, holes stayed holes, a generator did not know where in the picture it is, the
    policy alone acted, and a teacher's values went on behind the time limit."""
    head = dataclasses.replace(config.student.head, closing_steps=0)
    picture = dataclasses.replace(config.student.picture, fill_holes=False)
    training = dataclasses.replace(config.student.training, demo_stretch_steps=0)
    student = dataclasses.replace(config.student, head=head, picture=picture, training=training)
    deploy = dataclasses.replace(config.deploy, retry=False)
    ddg = dataclasses.replace(config.ddg, unet=dataclasses.replace(config.ddg.unet, position=False))
    teacher = dataclasses.replace(config.teacher, bootstrap_time_limit=True)
    return dataclasses.replace(config, ddg=ddg, student=student, deploy=deploy, teacher=teacher)


CONFIG = _as_before(PRESETS["camera"])
FLAT = downgraded(to_json(CONFIG), 1)
ALL_STAGES = [stage.name for stage in (*STAGES, *ON_REQUEST)]


def write_version_1(directory: Path, stage: str, config=FLAT) -> None:
    """A finished stage as version 1 left it: flat names, no version."""
    artifacts.finish(directory, stage, CONFIG, seconds=1.0, metrics={"x": 1})
    path = directory / artifacts.MANIFEST
    value = read_json(path)
    del value["manifest_version"]
    path.write_text(json.dumps(value | {"config": config}))


def of_version_2(name: str) -> dict:
    """A preset's JSON, the fields that version 2 lacked at what it did."""
    value = to_json(PRESETS[name])
    return json.loads(json.dumps(upgrades.upgraded(downgraded(value, 2), 2)))


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_version_1_and_back_loses_nothing(name):
    value = of_version_2(name)
    if name not in ("paper", "ppo", "ppo_paper"):  # these use fields that version 2 lacked
        assert value == json.loads(json.dumps(to_json(_as_before(PRESETS[name]))))
    flat = json.loads(json.dumps(downgraded(value, 1)))
    assert {"train_steps", "widths", "prior", "sample_batch"} <= flat["ddg"].keys()
    assert {"input_height_px", "head_batch_size", "dagger_teacher_share"} <= flat["student"].keys()
    assert flat["deploy"]["franka_host"] == "172.16.0.2" and flat["world"]["random"]["crop_px"] == 24
    assert not any(isinstance(field, dict) for field in (*flat["ddg"].values(), *flat["student"].values()))
    assert upgrades.upgraded(flat, 1) == value
    assert upgrades.upgraded(value, upgrades.VERSION) == value


@pytest.mark.parametrize("version", range(2, upgrades.VERSION + 1))
def test_what_a_version_lacked_is_taken_away_and_comes_back(version):
    value = json.loads(json.dumps(to_json(CONFIG)))
    before = upgrades.without(value, version)
    assert before is not None and (before == value) == (version == upgrades.VERSION)
    assert upgrades.upgraded(before, max(version, 3)) == value if version > 2 else "scale" not in before
    newer = json.loads(json.dumps(to_json(PRESETS["demo"])))  # retries, which version 9 could not
    assert (upgrades.without(newer, version) is None) == (version < 14)


def test_a_field_more_is_a_version_more():
    assert upgrades.VERSION == max(upgrades._ADDED_AFTER) + 1, "raise VERSION with its table"


def test_fields_named_by_hand_arrive_where_they_belong():
    flat = {
        "preset": "mine",
        "ddg": {"prior": "metric_inverse_depth", "sample_steps": 3, "train_steps": 7, "init_from": "a"},
        "student": {"width": 24, "denoiser_width": 40, "hand_view_width": 48, "train_steps": 9},
        "deploy": {"workers": 5, "realsense_serial": "123"},
        "world": {"random": {"crop_px": 24, "size": 0.1}},
    }
    config = artifacts.config_from_json(upgrades.upgraded(flat, 1))
    assert (config.ddg.prior.source, config.ddg.init_from) == ("metric_inverse_depth", "a")
    assert (config.ddg.sampling.steps, config.ddg.training.steps) == (3, 7)
    assert (config.student.encoder.width, config.student.head.width) == (24, 40)
    assert (config.student.hand_view.width, config.student.training.steps) == (48, 9)
    assert (config.deploy.workers, config.deploy.realsense.serial) == (5, "123")
    assert config.world.random.size == 0.1


def test_the_paper_presets_picture_of_version_1_becomes_one_that_an_encoder_takes():
    flat = downgraded(to_json(PRESETS["paper"]), 1)
    flat["student"] |= {"input_height_px": 225, "input_width_px": 290}
    student = artifacts.config_from_json(upgrades.upgraded(flat, 1)).student
    assert student == _as_before(PRESETS["paper"]).student


@pytest.mark.parametrize(
    ("rounds", "source", "start"),
    [
        (8, "", "guide"),
        (0, "", "nothing"),
        (8, "pretrained/teacher", "pretrained/teacher"),
        (0, "runs/a", "runs/a"),
    ],
)
def test_what_a_teacher_of_version_2_started_from_is_named(rounds, source, start):
    old = json.loads(json.dumps(downgraded(to_json(CONFIG), 2)))
    assert "start" not in old["teacher"] and "gripper_std" not in old["teacher"] and "scale" not in old
    old["teacher"] |= {"clone_rounds": rounds, "init_from": source}
    config = artifacts.config_from_json(upgrades.upgraded(old, 2))
    assert (config.teacher.start, config.teacher.clone_rounds) == (start, 8)
    assert config.world.reward.distance == "funnel" and config.teacher.target_kl == 0.0
    again = downgraded(to_json(config), 2)["teacher"]
    assert again["init_from"] == source and (again["clone_rounds"] == 0) == (start == "nothing")


@pytest.mark.parametrize("stage", ALL_STAGES)
def test_a_stage_of_version_1_is_finished_for_the_same_configuration(stage, tmp_path):
    write_version_1(tmp_path / stage, stage)
    artifact = artifacts.require(tmp_path, stage, CONFIG)
    assert artifacts.config_from_json(artifact.manifest.config) == CONFIG
    assert artifact.manifest.manifest_version == upgrades.VERSION


def test_another_configuration_is_told_by_its_present_name(tmp_path):
    flat = json.loads(json.dumps(FLAT))
    flat["ddg"]["sample_steps"] = 3
    write_version_1(tmp_path / "ddg", "ddg", flat)
    with pytest.raises(UserError, match=r"ddg\.sampling\.steps is 3 there, 2 here"):
        artifacts.require(tmp_path, "ddg", CONFIG)


def test_a_stage_begun_by_version_1_goes_on(tmp_path):
    directory = tmp_path / "student"
    directory.mkdir()
    (directory / "checkpoint").touch()
    started = {"contract_version": contract.CONTRACT_VERSION, "inputs": {}, "config": FLAT}
    atomic_write_json(directory / attempts.STARTED, started)
    attempts.begin(directory, "student", CONFIG)
    other = dataclasses.replace(CONFIG.student.training, steps=5)
    other = dataclasses.replace(CONFIG, student=dataclasses.replace(CONFIG.student, training=other))
    with pytest.raises(UserError, match=r"student\.training\.steps is 3000 there, 5 here"):
        attempts.begin(directory, "student", other)


def test_the_hash_of_version_1_is_the_one_that_version_recorded():
    """The pretrained teacher's manifest holds it, over the sections that a teacher depended on then."""
    manifest = read_json(ROOT / "pretrained" / "teacher" / artifacts.MANIFEST)
    config = artifacts.config_from_json(upgrades.upgraded(manifest["config"], 1))
    assert config_hash_of_version(1, config, ("seed", "world", "teacher")) == manifest["config_hash"]


@pytest.mark.parametrize(("stage", "preset"), [("teacher", "laptop"), ("student", "demo")])
def test_the_pretrained_folder_is_read_and_accepted(stage, preset):
    artifact = artifacts.read_artifact(ROOT / "pretrained" / stage)
    config = artifacts.config_from_json(artifact.manifest.config)
    assert (config.preset, artifact.manifest.stage) == (preset, stage)
    if stage == "teacher":
        artifacts.check_config(artifact, config)
        laptop = PRESETS["laptop"]
        as_then = dataclasses.replace(laptop.teacher, bootstrap_time_limit=True)
        artifacts.check_config(artifact, dataclasses.replace(laptop, world=config.world, teacher=as_then))


def test_a_manifest_of_a_later_version_is_refused_by_its_number(tmp_path):
    artifacts.finish(tmp_path / "export", "export", CONFIG, seconds=1.0, metrics={})
    path = tmp_path / "export" / artifacts.MANIFEST
    path.write_text(json.dumps(read_json(path) | {"manifest_version": 99}))
    with pytest.raises(UserError, match=f"is of version 99, this code reads up to {upgrades.VERSION}"):
        artifacts.read_manifest(tmp_path / "export")


# --- what is in the folder, and not made from the tables ---------------------------------------------

ABSENT = "absent"
BY_HAND: dict[int, tuple[str, tuple[tuple[str, object, str, object], ...]]] = {
    1: (
        "teacher",
        (
            ("student.denoiser_width", 256, "student.head.width", 256),
            ("ddg.sample_steps", 5, "ddg.sampling.steps", 5),
            ("teacher.init_from", "", "teacher.start", "guide"),
            ("world.random.crop_px", 24, "world.random.crop_px", ABSENT),
            ("student.depth_source", ABSENT, "student.depth_source", "learned"),
        ),
    ),
    8: (
        "student",
        (
            ("ddg.unet.position", ABSENT, "ddg.unet.position", False),
            ("student.picture.fill_holes", True, "student.picture.fill_holes", True),
            ("student.training.edge_noise_px", 0.6, "student.training.edge_noise_px", 0.6),
        ),
    ),
    9: (
        "d435",
        (
            ("deploy.retry", ABSENT, "deploy.retry", False),
            ("deploy.franka.approach_m_s", ABSENT, "deploy.franka.approach_m_s", 0.06),
            ("ddg.unet.blocks", [1, 1, 1], "ddg.unet.blocks", (1, 1, 1)),
        ),
    ),
    10: (
        "table2/ddg",
        (
            ("deploy.retry", True, "deploy.retry", True),
            ("deploy.franka.approach_below_m", ABSENT, "deploy.franka.approach_below_m", 0.16),
            ("deploy.franka.give_way", ABSENT, "deploy.franka.give_way", 0.5),
        ),
    ),
    12: (
        "table2/paper_generator",
        (
            ("student.dextrah_scale", ABSENT, "student.dextrah_scale", 1.0),
            ("deploy.franka.give_way", 0.5, "deploy.franka.give_way", 0.5),
            ("ddg.unet.position", True, "ddg.unet.position", True),
        ),
    ),
    13: (
        "table2/rand_noise_double",
        (
            ("student.dextrah_scale", 2.0, "student.dextrah_scale", 2.0),
            ("student.depth_source", "dextrah", "student.depth_source", "dextrah"),
            ("student.picture.fill_holes", False, "student.picture.fill_holes", False),
        ),
    ),
    15: (
        "ddg",
        (
            ("ddg.graft.window_shape", "box", "ddg.graft.window_shape", "box"),
            ("ddg.graft.window_px", 5.0, "ddg.graft.window_px", 5.0),
        ),
    ),
    18: (
        "table2/rand_noise_normal",
        (
            ("student.dextrah_normal_m", 0.01, "student.dextrah_normal_m", 0.01),
            ("student.depth_source", "dextrah", "student.depth_source", "dextrah"),
        ),
    ),
}
"""Version -> a manifest of it in pretrained/, and (field there, its value, field today, its value)."""


def _shipped() -> list[Path]:
    """Folders of the stages that come with the project; the features' network has a manifest of its own."""
    paths = (ROOT / "pretrained").rglob(artifacts.MANIFEST)
    return sorted(path.parent for path in paths if "stage" in read_json(path))


def test_every_manifest_that_comes_along_is_read_and_is_of_its_own_configuration():
    assert len(_shipped()) >= 8
    for directory in _shipped():
        artifact = artifacts.read_artifact(directory)
        config = artifacts.config_from_json(artifact.manifest.config)
        artifacts.check_config(artifact, config)  # fields that a version lacked are there, or it would differ


@pytest.mark.parametrize("version", BY_HAND)
def test_values_written_down_by_hand_are_today_s(version):
    name, fields = BY_HAND[version]
    written = read_json(ROOT / "pretrained" / name / artifacts.MANIFEST)
    assert written.get("manifest_version", 1) == version
    config = artifacts.config_from_json(artifacts.read_manifest(ROOT / "pretrained" / name).config)
    for old, there, new, today in fields:
        assert _at(written["config"], old) == there, old
        assert _at(config, new) == today, new


def test_every_version_that_comes_along_has_values_written_down_by_hand():
    found = {read_json(path / artifacts.MANIFEST).get("manifest_version", 1) for path in _shipped()}
    assert found == BY_HAND.keys()


def _at(value, name: str):
    """The dotted field `name` of a configuration or of its JSON, ABSENT if it has none."""
    for part in name.split("."):
        value = value.get(part, ABSENT) if isinstance(value, dict) else getattr(value, part, ABSENT)
    return value
