"""What goes into a LeRobot dataset; and, where lerobot is installed, what its own reader reads from it."""

import json
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from app.commands import parse
from app.lerobot import card, dataset, demonstrations, deployments, steps
from app.lerobot.source import open_source
from ddgrasp import artifacts, contract
from ddgrasp.errors import UserError
from ddgrasp.presets import get_preset
from ddgrasp.progress import Progress
from ddgrasp.stages import get_stage
from demos.store import EpisodeStore
from lerobot_support import LENGTHS, OBJECTS, SIZE, write_demos, write_deployment, write_noisy
from recording_support import set_meta

NAMES = get_preset("debug").world.objects
QUIET = Progress(quiet=True)


def write(source, out, **changes):
    how = {"storage": "video", "task": "", "licence": "apache-2.0", "command": "ddgrasp", "progress": QUIET}
    return dataset.write(source, out, **{**how, **changes})


def test_demonstrations_are_the_store_s_episodes(tmp_path):
    written = write_demos(tmp_path)
    for place in (tmp_path, tmp_path / "demos", tmp_path / "demos" / "episodes.zarr"):
        assert len(open_source(place).episodes) == len(LENGTHS)
    for read, arrays, which in zip(open_source(tmp_path).episodes, written, OBJECTS, strict=True):
        episode = read()
        assert episode.task == f"grasp the {NAMES[which]} and lift it" and episode.success
        assert not episode.held.any()
        np.testing.assert_array_equal(episode.state, arrays["state"])
        np.testing.assert_array_equal(episode.action, arrays["action"])
        np.testing.assert_array_equal(episode.T_world_cam, arrays["T_world_cam"])
        depth_mm, rgb = zip(*episode.pictures(), strict=True)
        np.testing.assert_array_equal(depth_mm, arrays["depth_mm"])
        np.testing.assert_array_equal(rgb, arrays["rgb"])


def test_generated_depth_in_the_place_of_clean_depth(tmp_path):
    run = tmp_path / "run"
    written = write_demos(run)
    depth = write_noisy(run)
    source = open_source(run, noisy=run)
    assert "3.0% of the pixels have none" in source.about["Camera"] and "clean" not in source.about["Camera"]
    for read, clean, noisy in zip(source.episodes, written, depth, strict=True):
        depth_mm, rgb = zip(*read().pictures(), strict=True)
        np.testing.assert_array_equal(depth_mm, noisy)
        np.testing.assert_array_equal(rgb, clean["rgb"])
    chosen = open_source(run, [NAMES[0]], run / "noisy").episodes
    np.testing.assert_array_equal([picture for picture, _ in chosen[0]().pictures()], depth[1])


def test_depth_of_other_demonstrations_is_refused(tmp_path):
    write_demos(tmp_path / "run")
    write_noisy(tmp_path / "run")
    write_demos(tmp_path / "other")
    manifest = tmp_path / "other" / "demos" / "manifest.json"
    manifest.write_text(manifest.read_text() + "\n")  # made in the same second they would be the same
    with pytest.raises(UserError, match=r"run.noisy is not depth of the demonstrations in .*other.demos: "):
        open_source(tmp_path / "other", noisy=tmp_path / "run")
    with pytest.raises(UserError, match="nowhere.noisy holds no finished artifact"):
        open_source(tmp_path / "run", noisy=tmp_path / "nowhere")
    write_deployment(tmp_path / "arm" / "first")
    with pytest.raises(UserError, match="--noisy goes with demonstrations, and .*arm has none"):
        open_source(tmp_path / "arm", noisy=tmp_path / "run")


def test_a_selection_by_object_and_number(tmp_path):
    write_demos(tmp_path)
    chosen = open_source(tmp_path, [NAMES[1]])
    assert [len(read().state) for read in chosen.episodes] == [LENGTHS[0], LENGTHS[2]]
    assert [len(read().state) for read in open_source(tmp_path, [NAMES[1]], most=1).episodes] == [LENGTHS[0]]
    with pytest.raises(UserError, match="Unknown object 'pineapple'"):
        open_source(tmp_path, ["pineapple"])


def test_a_deployment_is_an_episode_with_its_verdict(tmp_path):
    states, depth_mm = write_deployment(tmp_path / "one", success=False, held=(0, 2), object="can")
    (read,) = open_source(tmp_path).episodes
    episode = read()
    assert (episode.success, episode.task) == (False, "grasp the can and lift it")
    np.testing.assert_array_equal(episode.state, states.astype(np.float32))
    np.testing.assert_array_equal([depth for depth, _ in episode.pictures()], depth_mm)
    # A step that was held moves no joint and leaves the gripper as it was: open at first, then closing.
    np.testing.assert_array_equal(episode.action[:, 7], [-1, 1, 1, 1])
    np.testing.assert_allclose(episode.action[:, 0], [0, 0.1, 0, 0.3], rtol=1e-6)
    assert episode.held.tolist() == [True, False, True, False]


def test_deployments_that_are_no_episodes_are_named(tmp_path):
    write_deployment(tmp_path / "judged")
    write_deployment(tmp_path / "open", success=None)
    _, depth_mm = write_deployment(tmp_path / "blind")
    (picture, *_) = sorted((tmp_path / "blind" / "depth").iterdir())
    cv2.imwrite(str(picture), np.zeros_like(depth_mm[0]))
    write_deployment(tmp_path / "thin", frames=1)
    write_deployment(tmp_path / "dry", dry_run=True)
    write_deployment(tmp_path / "torn")
    steps = tmp_path / "torn" / "steps.jsonl"
    steps.write_text(steps.read_text()[:-20])
    source = open_source(tmp_path)
    assert [read().name for read in source.episodes] == ["judged"]
    assert sorted(line.split(":")[0] for line in source.left_out) == ["blind", "dry", "open", "thin", "torn"]
    assert "dry: a dry run: the arm did not do what its steps say" in source.left_out
    assert "left out 1 of 4 frames" in " ".join(source.left_out)
    assert "1 pictures for 4 steps" in " ".join(source.left_out)
    assert open_source(tmp_path / "judged").episodes[0]().task == "grasp the object and lift it"
    with pytest.raises(UserError, match="no episode can be used .*film-every 1"):
        open_source(tmp_path / "thin")
    with pytest.raises(UserError, match="Unknown object 'can'"):
        open_source(tmp_path, ["can"])


def test_the_card_is_of_the_episodes_that_are_taken_and_of_what_their_depth_is(tmp_path):
    write_deployment(tmp_path / "a", robot="sim", camera="stereo", depth="inpaint")
    write_deployment(tmp_path / "b", robot="sim", camera="ideal")
    write_deployment(tmp_path / "c", robot="franka", camera="realsense")
    treated, ideal, raw = open_source(tmp_path).about["Camera"].split("; ")[1::2]
    about = open_source(tmp_path, most=1).about
    assert about["Robot"] == "Franka arm; driver or rig: sim."
    assert about["Camera"] == "stereo, across the table; its depth is what the policy saw, treated: inpaint."
    assert treated == "its depth is what the policy saw, treated: inpaint"
    assert ideal == "its depth is clean, without a camera's errors"
    assert raw == "its depth is raw, with its holes and noise."


def test_a_folder_without_episodes(tmp_path):
    with pytest.raises(UserError, match="has neither demos/episodes.zarr nor deployments"):
        open_source(tmp_path)


def test_every_step_has_what_the_features_say(tmp_path):
    write_demos(tmp_path)
    episode = open_source(tmp_path).episodes[0]()
    described = steps.features(SIZE, SIZE, True, "video")
    made = list(steps.frames(episode, "lift it"))
    for frame in made:
        assert frame.pop("task") == "lift it" and frame.keys() == described.keys()
        assert {key: value.shape for key, value in frame.items()} == {
            key: described[key]["shape"] for key in frame
        }
    assert [bool(frame[steps.DONE][0]) for frame in made] == [False] * 6 + [True]
    for key in (steps.STATE_KEY, steps.ACTION_KEY):
        assert len(described[key]["names"]) == 8 and described[key]["names"][0].startswith("joint1.")


def test_the_card_says_what_is_in_it(tmp_path):
    write_demos(tmp_path, with_rgb=False)
    source = open_source(tmp_path)
    contents = card.Contents(keys=tuple(steps.features(SIZE, None, True, "video")))
    for read in source.episodes:
        contents.count(read(), 3)
    how = {"name": "set", "storage": "video", "licence": "cc-by-4.0", "command": "ddgrasp demos export x"}
    text = card.render(source, contents, **how)
    assert (
        text.startswith("---\nlicense: cc-by-4.0\n") and f"3 episodes, {sum(LENGTHS)} steps at 10 Hz" in text
    )
    for said in (
        "3 of 3 succeeded", f"{NAMES[1]} 2", f"{NAMES[0]} 1", "Franka Emika Panda", "9 pixels", "millimetres",
        "ddgrasp demos export x", f"{contract.ACTION_SCALE_RAD:g} rad",
    ):  # fmt: skip
        assert said in text, said
    assert (
        steps.POSE in text
        and f"`{steps.COLOUR}`" not in text
        and "**Held**" not in text
        and "control periods" not in text
    )


def test_the_card_counts_what_the_loop_missed_and_held(tmp_path):
    write_deployment(tmp_path / "late", held=(1, 2), missed_deadlines=2)
    source = open_source(tmp_path)
    contents = card.Contents(keys=tuple(steps.features(SIZE, SIZE, False, "video")))
    contents.count(source.episodes[0](), 0)
    how = {"name": "set", "storage": "video", "licence": "cc-by-4.0", "command": "ddgrasp demos export x"}
    text = card.render(source, contents, **how)
    assert "**Time**: 2 control periods passed without a step" in text and "**Held**: in 2 steps" in text


def test_who_acted_is_in_every_step_and_counted_on_the_card(tmp_path):
    write_deployment(tmp_path / "new", held=(1,), by=("policy", "policy", "retry", "retry"))
    write_deployment(tmp_path / "old", held=(1,), by=())
    source = open_source(tmp_path)
    new, old = (read() for read in source.episodes)
    kinds = dataset._described(new, "video")
    made = [list(steps.frames(episode, "lift it")) for episode in (new, old)]
    assert all(frame.keys() - {"task"} == kinds.keys() for frames in made for frame in frames)
    flags = [[bool(frame[steps.BY_POLICY][0]) for frame in frames] for frames in made]
    assert flags == [[True, False, False, False], [False] * 4]
    contents = card.Contents(keys=tuple(kinds))
    for episode in (new, old):
        contents.count(episode, 0)
    how = {"name": "set", "storage": "video", "licence": "cc-by-4.0", "command": "ddgrasp demos export x"}
    text = card.render(source, contents, **how)
    assert "in 2 steps the control loop's rules acted" in text and "**Not noted**: 3 steps" in text
    assert f"| `{steps.BY_POLICY}` |" in text and "`by_policy` says where it is the policy's" in text
    write_deployment(tmp_path / "alone" / "one")
    contents = card.Contents()
    contents.count(open_source(tmp_path / "alone").episodes[0](), 0)
    assert (contents.retried, contents.unnoted) == (0, 0)


def test_colour_of_another_lens_is_called_so_on_the_card(tmp_path):
    for name in ("real", "rig"):
        write_deployment(tmp_path / name)
    set_meta(tmp_path / "real", color_aligned_to_depth=False)  # as a RealSense's
    source = open_source(tmp_path)
    episodes = [read() for read in source.episodes]
    assert [episode.color_aligned for episode in episodes] == [False, True]
    how = {"name": "set", "storage": "video", "licence": "cc-by-4.0", "command": "ddgrasp demos export x"}
    for chosen, said in ((episodes, True), (episodes[1:], False)):
        contents = card.Contents(keys=tuple(dataset._described(chosen[0], "video")))
        for episode in chosen:
            contents.count(episode, 0)
        text = card.render(source, contents, **how)
        assert ("**Colour**: in 1 of 2 episodes it is the colour camera's own picture" in text) == said


def test_deployments_of_two_sizes_are_refused_before_any_is_written(tmp_path):
    """With colour of its own lens, as from another camera; of what is not taken, sizes count for nothing."""
    for name, colour in (("a", SIZE), ("b", SIZE), ("c", (24, 32))):
        write_deployment(tmp_path / name, object="can" if name == "c" else "cube", colour=colour)
    said = r"c has depth of \(48, 64\) and colour of \(24, 32, 3\), a of .*48, 64, 3.*: a dataset has one"
    with pytest.raises(UserError, match=said):
        open_source(tmp_path)
    assert len(open_source(tmp_path, most=2).episodes) == len(open_source(tmp_path, ["cube"]).episodes) == 2


@pytest.mark.parametrize("told", [{"q_rad": [0.0] * 6 + [None]}, {"q_rad": [0.0] * 6}, {"width_m": None}])
def test_a_step_without_the_robot_s_state_is_no_step_of_a_dataset(tmp_path, told):
    """The loop holds the arm there and notes null; LeRobot would average it to no number at all."""
    for name in ("blind", "whole"):
        write_deployment(tmp_path / name, held=(2,))
    steps_file = tmp_path / "blind" / "steps.jsonl"
    rows = [json.loads(line) for line in steps_file.read_text().splitlines()]
    rows[2] |= told
    steps_file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    source = open_source(tmp_path)
    assert [read().name for read in source.episodes] == ["whole"]
    assert source.left_out == [
        "blind: in step 2 the robot told no whole state (seven joints and the opening)"
    ]


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({"action": [0.5, 0.5]}, r"in step 2 the action is [0.5, 0.5]; expected 8 numbers"),
        ({"action": 1.0}, "in step 2 the action is 1.0; expected 8 numbers"),
        ({"q_rad": ["x"] * 7}, "in step 2 the robot told no whole state (seven joints and the opening)"),
        ({"q_rad": 0.5}, "in step 2 the robot told no whole state (seven joints and the opening)"),
    ],
)
def test_a_step_of_something_else_leaves_its_deployment_out(tmp_path, told, said):
    for name in ("odd", "whole"):
        write_deployment(tmp_path / name)
    steps_file = tmp_path / "odd" / "steps.jsonl"
    rows = [json.loads(line) for line in steps_file.read_text().splitlines()]
    rows[2] |= told
    steps_file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert open_source(tmp_path).left_out == [f"odd: {said}"]


def test_a_report_without_its_count_of_pictures_leaves_its_deployment_out(tmp_path):
    for name in ("odd", "whole"):
        write_deployment(tmp_path / name)
    report = json.loads((tmp_path / "odd" / "report.json").read_text())
    (tmp_path / "odd" / "report.json").write_text(json.dumps({**report, "frames": None}))
    assert open_source(tmp_path).left_out == [
        "odd: its report.json does not say how many pictures there are (frames)"
    ]


def test_a_store_without_episodes_says_so(tmp_path):
    EpisodeStore(tmp_path / "run" / "demos" / "episodes.zarr", create=True)
    artifacts.finish(tmp_path / "run" / "demos", "demos", get_preset("debug"), seconds=1.0, metrics={})
    with pytest.raises(UserError, match="has no episode: collect some"):
        open_source(tmp_path / "run")


def test_what_stands_there_is_not_touched(tmp_path, monkeypatch):
    write_demos(tmp_path / "run")
    (tmp_path / "set").mkdir()
    with pytest.raises(UserError, match="set exists: choose another --out"):
        parse("demos export", [str(tmp_path / "run"), "--out", str(tmp_path / "set")]).run()


def test_without_lerobot_it_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lerobot", None)
    write_demos(tmp_path / "run")
    old = sys.version_info < (3, 12)
    remedy = "make setup PYTHON=python3.12" if old else "pip install"
    with pytest.raises(UserError, match=rf"lerobot 0.6 or newer, on Python 3.12 .*{remedy}") as refused:
        parse("demos export", [str(tmp_path / "run"), "--out", str(tmp_path / "set")]).run()
    assert not old or "pip install" not in str(refused.value), "the extra is empty there"
    assert not (tmp_path / "set").exists()


def test_the_command_on_the_card_is_the_one_that_was_typed(tmp_path):
    words = ["runs/demo", "--out", "sets/a b", "--episodes", "3", "--objects", "cube", "can"]
    said = parse("demos export", words)._command()
    assert said == "ddgrasp demos export runs/demo --out 'sets/a b' --episodes 3 --objects cube can"


# --- with lerobot ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Read:
    """A dataset as lerobot reads it."""

    dataset: Any
    written: list


@pytest.fixture(scope="module", params=["video", "images"])
def read(request, tmp_path_factory):
    """The demonstrations of `lerobot_support`, exported and opened again."""
    datasets = pytest.importorskip(
        "lerobot.datasets", reason="needs pip install -e '.[lerobot]', Python 3.12"
    )
    run = tmp_path_factory.mktemp("run")
    written = write_demos(run)
    out = run / "set"
    write(open_source(run), out, storage=request.param)
    return Read(datasets.LeRobotDataset("set", root=out), written)


def test_lerobot_reads_states_actions_and_depth_as_they_were(read):
    dataset, row = read.dataset, 0
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (3, sum(LENGTHS), 10)
    assert dataset.meta.depth_keys == [steps.DEPTH]
    for number, arrays in enumerate(read.written):
        for t in range(len(arrays["state"])):
            item = dataset[row]
            assert item["episode_index"] == number and item["frame_index"] == t
            np.testing.assert_array_equal(item["observation.state"].numpy(), arrays["state"][t])
            np.testing.assert_array_equal(item["action"].numpy(), arrays["action"][t])
            np.testing.assert_array_equal(item[steps.DEPTH].numpy()[0], arrays["depth_mm"][t])
            np.testing.assert_array_equal(item[steps.POSE].numpy(), arrays["T_world_cam"])
            assert bool(item["next.success"]) == (t == len(arrays["state"]) - 1)
            assert item["task"] == f"grasp the {NAMES[OBJECTS[number]]} and lift it"
            row += 1


def test_lerobot_finds_episodes_that_succeeded(read):
    found = read.dataset.meta.filter_episodes(lambda episode: episode["success"])
    assert found == [0, 1, 2]


def test_lerobot_gives_windows_of_time(read):
    import torch
    from lerobot.datasets import LeRobotDataset

    deltas = {steps.DEPTH: [-0.2, -0.1, 0.0], "action": [0.1 * i for i in range(4)]}
    windows = LeRobotDataset("set", root=read.dataset.root, delta_timestamps=deltas)
    batch = next(iter(torch.utils.data.DataLoader(windows, batch_size=2)))
    assert batch[steps.DEPTH].shape == (2, 3, 1, *SIZE) and batch["action"].shape == (2, 4, 8)
    expected = read.written[0]["depth_mm"][[0, 0, 1]]
    np.testing.assert_array_equal(batch[steps.DEPTH][1, :, 0].numpy(), expected)


def test_the_page_s_lines_read_it(read):
    page = (Path(__file__).parents[1] / "docs" / "data.md").read_text()
    _, code = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert '"sets/demo"' in code
    names: dict = {}
    exec(code.replace('"sets/demo"', repr(str(read.dataset.root))), names)
    assert names["before_the_first"].tolist() == [True, True, False]
    expected = read.written[0]["depth_mm"][[0, 0, 0]]
    np.testing.assert_array_equal(names["depth_mm"][:, 0].numpy(), expected)


def test_an_interrupted_export_leaves_nothing(read, tmp_path):
    write_demos(tmp_path / "run")
    source = open_source(tmp_path / "run")

    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(replace(source, episodes=[source.episodes[0], interrupted]), tmp_path / "sets" / "set")
    assert list((tmp_path / "sets").iterdir()) == []


def test_pictures_of_another_size_are_refused(read, tmp_path):
    write_demos(tmp_path / "run", with_rgb=False)
    source, other = open_source(tmp_path / "run"), open_source(read.dataset.root.parent)
    mixed = replace(source, episodes=[source.episodes[0], other.episodes[0]])
    with pytest.raises(UserError, match="a dataset has one size"):
        write(mixed, tmp_path / "set")


def test_a_video_caps_what_is_too_far_and_the_card_says_so(read, tmp_path):
    from lerobot.datasets import LeRobotDataset

    written = write_demos(tmp_path / "run", with_rgb=False, largest_mm=6000)
    contents = write(open_source(tmp_path / "run", most=1), tmp_path / "set")
    depth_mm = written[0]["depth_mm"]
    assert contents.farther == np.count_nonzero(depth_mm > 4095) > 0
    assert f"{contents.farther} pixels" in (tmp_path / "set" / "README.md").read_text()
    item = LeRobotDataset("set", root=tmp_path / "set")[2]
    np.testing.assert_array_equal(item[steps.DEPTH][0].numpy(), np.minimum(depth_mm[2], 4095))


def test_a_gripper_that_waits_for_a_slow_hand_is_told_as_it_was_told():
    asked = [*[0.1] * 7, 1.0]
    rows = [
        {"action": asked, "close": False},
        {"action": asked, "close": True},
        {"action": None, "close": True},
    ]
    assert deployments.actions(rows)[:, 7].tolist() == [-1.0, 1.0, 1.0]
    before = [{"action": asked}, {"action": None}]  # rows of before 2026-11-26
    assert deployments.actions(before)[:, 7].tolist() == [1.0, 1.0]


def test_the_stores_are_those_that_the_stages_write():
    import ddg_jax.generate
    import demos.stage

    assert (demonstrations.STORE, demonstrations.NOISY_STORE) == (demos.stage.STORE, ddg_jax.generate.STORE)
    assert demonstrations.STAGE == get_stage("demos").name
    assert demonstrations.NOISY_STAGE == get_stage("noisy").name
