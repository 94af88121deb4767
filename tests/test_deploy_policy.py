"""An exported file on the robot side: checks at loading, frame buffer, chunks, noise."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from ddgrasp import contract
from ddgrasp.contract import D455_STREAM, FR3, PANDA
from ddgrasp.depth import at_profile
from ddgrasp.errors import UserError
from deploy.policy import OnnxPolicy
from deploy_support import HOME_RAD, SHAPE, constant_bias, depth_mm, describe, write_policy
from tutorial_support import TUTORIALS, code

STATE = np.zeros(8, np.float32)


def frames_weighted() -> np.ndarray:
    """(3, 4, 8): row 0 of the chunk shows the three frames' millimetres in entries 0 to 2."""
    gain = np.zeros((3, 4, 8))
    for frame in range(3):
        gain[frame, 0, frame] = 1.0
    return gain


def test_first_frame_fills_the_buffer_then_oldest_leaves_first(tmp_path):
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", depth_gain=frames_weighted()))
    seen = [policy.act(depth_mm(mm), STATE)[:3].tolist() for mm in (500, 600, 700, 800)]
    assert seen == [[500, 500, 500], [500, 500, 600], [500, 600, 700], [600, 700, 800]]
    policy.forget()
    assert policy.act(depth_mm(900), STATE)[:3].tolist() == [900, 900, 900]


def test_a_camera_may_fill_its_buffer_again(tmp_path):
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", depth_gain=frames_weighted()))
    buffer = depth_mm(0)
    for mm in (500, 600, 700):
        buffer[:] = mm
        seen = policy.act(buffer, STATE)[:3].tolist()
    assert seen == [500, 600, 700]


def test_state_reaches_the_network_in_order(tmp_path):
    gain = np.zeros((9, 4, 8))
    gain[np.arange(8), 0, np.arange(8)] = 2.0
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", state_gain=gain))
    state = np.arange(8, dtype=np.float32) / 16
    np.testing.assert_array_equal(policy.act(depth_mm(), state), 2 * state)


def test_the_network_is_told_how_the_opening_changes_also_while_a_chunk_is_played(tmp_path):
    gain = np.zeros((9, 4, 8))
    gain[8, :, 0] = 1.0
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", state_gain=gain), execute_steps=2)
    widths, told = (0.46875, 0.4375, 0.3125, 0.3125, 0.28125), []
    for width in widths:
        told.append(float(policy.act(depth_mm(), np.array([0, 0, 0, 0, 0, 0, 0, width], np.float32))[0]))
    assert told == [0.0, 0.0, -0.125, -0.125, -0.03125]
    policy.forget()
    assert policy.act(depth_mm(), np.full(8, 0.3, np.float32))[0] == 0.0


def test_chunk_is_played_for_execute_steps_and_frames_keep_coming(tmp_path):
    # Row r of the chunk is r + 10 * newest frame (in metres).
    gain = np.zeros((3, 4, 8))
    gain[2] = 0.01
    bias = np.arange(4.0)[:, None] * np.ones(8)
    path = write_policy(tmp_path / "p.onnx", describe(execute_steps=3), depth_gain=gain, bias=bias)
    policy = OnnxPolicy(path)
    inferred, rows = [], []
    for mm in (100, 200, 300, 400, 500):
        inferred.append(policy.will_infer)
        rows.append(float(policy.act(depth_mm(mm), STATE)[0]))
    assert inferred == [True, False, False, True, False]
    np.testing.assert_allclose(rows, [1 + 0, 1 + 1, 1 + 2, 4 + 0, 4 + 1], rtol=1e-6)


def test_a_closing_lasts_as_long_as_the_file_says(tmp_path):
    # The gripper's command is 1 - 0.01 * newest frame: below 100 mm it closes.
    gain, bias = np.zeros((3, 4, 8)), np.zeros((4, 8))
    gain[2, :, 7], bias[:, 7] = -0.01, 1.0

    def commands(policy: OnnxPolicy, *frames_mm: int) -> list[bool]:
        return [bool(policy.act(depth_mm(mm), STATE)[7] > 0) for mm in frames_mm]

    path = write_policy(tmp_path / "p.onnx", describe(closing_steps=3), depth_gain=gain, bias=bias)
    policy = OnnxPolicy(path)
    assert commands(policy, 200, 50, 200, 200, 200) == [False, True, True, True, False]
    assert commands(policy, 50) == [True]
    policy.reset(0)
    assert commands(policy, 200) == [False]
    path = write_policy(tmp_path / "q.onnx", depth_gain=gain, bias=bias)
    assert commands(OnnxPolicy(path), 50, 200) == [True, False]


def test_execute_steps_can_be_overridden_within_the_chunk(tmp_path):
    path = write_policy(tmp_path / "p.onnx")
    assert OnnxPolicy(path).execute_steps == 1
    assert OnnxPolicy(path, execute_steps=4).execute_steps == 4
    with pytest.raises(UserError, match="execute_steps is 5.*choose 1 to 4"):
        OnnxPolicy(path, execute_steps=5)


def test_noise_is_zero_or_seeded_normal(tmp_path):
    path = write_policy(tmp_path / "p.onnx", noise_gain=1.0)
    assert not OnnxPolicy(path, noise="zero").act(depth_mm(), STATE).any()
    policy = OnnxPolicy(path, noise="normal", seed=3)
    first = [policy.act(depth_mm(), STATE) for _ in range(2)]
    policy.reset(3)
    again = [policy.act(depth_mm(), STATE) for _ in range(2)]
    np.testing.assert_array_equal(first, again)
    expected = np.random.default_rng(3).standard_normal((1, 4, 8), dtype=np.float32)[0, 0]
    np.testing.assert_array_equal(first[0], expected)
    assert not np.array_equal(first[0], first[1])
    with pytest.raises(UserError, match="noise is 'uniform'"):
        OnnxPolicy(path, noise="uniform")


def test_metres_go_in_as_metres(tmp_path):
    path = write_policy(tmp_path / "p.onnx", describe("float32_m"), depth_gain=frames_weighted())
    policy = OnnxPolicy(path)
    depth = np.full(SHAPE, 0.75, np.float32)
    assert policy.check_frame(depth) == ""
    assert policy.act(depth, STATE)[2] == pytest.approx(0.75)


def test_cameras_millimetres_are_made_metres_for_a_file_that_takes_those(tmp_path):
    path = write_policy(tmp_path / "p.onnx", describe("float32_m"), depth_gain=frames_weighted())
    in_metres, in_millimetres = OnnxPolicy(path), OnnxPolicy(path)
    depth = depth_mm(750)
    assert in_millimetres.check_frame(depth) == in_millimetres.check_unit(depth) == ""
    given: list[np.ndarray] = []
    in_millimetres.watch = lambda frames, state: given.append(frames)
    np.testing.assert_array_equal(
        in_millimetres.act(depth, STATE), in_metres.act(depth * np.float32(0.001), STATE)
    )
    assert given[0].dtype == np.float32 and given[0].max() == pytest.approx(0.75)
    assert "median 1 cannot be mm" in in_millimetres.check_unit(np.ones(SHAPE, np.uint16))


@pytest.mark.parametrize(
    ("depth", "problem"),
    [
        (depth_mm(), ""),
        (depth_mm().astype(np.float32), "wrong depth: type float32"),
        (depth_mm()[:-1], "wrong depth: size"),
        (np.zeros(SHAPE, np.uint16), "all-invalid depth"),
        (
            np.pad(depth_mm()[:1, :1], ((0, SHAPE[0] - 1), (0, SHAPE[1] - 1))),
            "almost all-invalid depth: 0.69 %",
        ),
    ],
)
def test_frames_in_millimetres_are_checked(tmp_path, depth, problem):
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx"))
    assert policy.check_frame(depth).startswith(problem) and bool(policy.check_frame(depth)) == bool(problem)


def test_frames_in_metres_are_checked_for_nan_and_unit(tmp_path):
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", describe("float32_m")))
    depth = np.full(SHAPE, 0.7, np.float32)
    depth[2, 3], depth[4, 5] = np.nan, np.inf
    assert policy.check_frame(depth) == "non-finite depth: 2 pixels"
    assert policy.check_unit(np.full(SHAPE, 0.7, np.float32)) == ""
    assert "median 700 cannot be m" in policy.check_unit(np.full(SHAPE, 700, np.float32))


def test_metres_rounded_into_integers_are_noticed(tmp_path):
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx"))
    assert "median 1 cannot be mm" in policy.check_unit(np.ones(SHAPE, np.uint16))


def test_wrong_files_get_one_line(tmp_path):
    with pytest.raises(UserError, match=r"absent\.onnx: no such file; make one with `ddgrasp export`"):
        OnnxPolicy(tmp_path / "absent.onnx")
    (tmp_path / "text.onnx").write_text("not a model")
    with pytest.raises(UserError, match="cannot load it") as error:
        OnnxPolicy(tmp_path / "text.onnx")
    assert "\n" not in str(error.value)
    with pytest.raises(UserError, match="not a policy of this project"):
        OnnxPolicy(write_policy(tmp_path / "p.onnx", properties={"author": "someone"}))
    with pytest.raises(UserError, match="contract version 99"):
        OnnxPolicy(write_policy(tmp_path / "p.onnx", describe(contract_version=99)))


def test_folder_in_place_of_the_file_names_the_file(tmp_path):
    export = tmp_path / "run" / "export"
    export.mkdir(parents=True)
    for folder in (export, export.parent):
        with pytest.raises(UserError) as error:
            OnnxPolicy(folder)
        assert str(error.value) == f"{folder} is a folder: name the file, {export / 'policy.onnx'}."


def test_damaged_file_of_a_finished_export_says_what_to_delete(tmp_path):
    path = write_policy(tmp_path / "policy.onnx")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(UserError, match=r"cannot load it .*; make one with `ddgrasp export`\.$"):
        OnnxPolicy(path)
    (tmp_path / "manifest.json").write_text("{}")
    for present in (True, False):
        with pytest.raises(UserError) as error:
            OnnxPolicy(path)
        assert str(error.value).endswith(f"; delete {tmp_path}, then make it again with `ddgrasp export`.")
        assert ("cannot load it" in str(error.value)) is present
        path.unlink(missing_ok=True)


def test_graph_that_contradicts_its_metadata_is_refused(tmp_path):
    lying = describe(profile=contract.D455.scaled(0.05)).to_json()
    with pytest.raises(UserError, match="'depth' has shape"):
        OnnxPolicy(write_policy(tmp_path / "p.onnx", properties={"ddgrasp": lying}))
    lying = describe("float32_m").to_json()
    with pytest.raises(UserError, match=r"tensor\(uint16\).*float32_m"):
        OnnxPolicy(write_policy(tmp_path / "p.onnx", properties={"ddgrasp": lying}))


def test_a_file_that_fits_by_its_shapes_and_does_not_run_is_refused(tmp_path):
    path = write_policy(tmp_path / "p.onnx")
    model = onnx.load(path)
    state = next(node for node in model.graph.input if node.name == "state")
    state.type.tensor_type.elem_type = TensorProto.DOUBLE
    for node in model.graph.node:
        node.input[:] = ["narrow" if name == "state" else name for name in node.input]
    model.graph.node.insert(0, helper.make_node("Cast", ["state"], ["narrow"], to=TensorProto.FLOAT))
    onnx.save(model, path)
    with pytest.raises(UserError, match="p.onnx: it does not run .*double"):
        OnnxPolicy(path)


def test_warm_up_leaves_no_trace(tmp_path):
    path = write_policy(
        tmp_path / "p.onnx", depth_gain=frames_weighted(), bias=constant_bias(0.0), noise_gain=1.0
    )
    cold, warm = (OnnxPolicy(path, noise="normal", seed=1) for _ in range(2))
    warm.warm_up()
    np.testing.assert_array_equal(warm.act(depth_mm(), STATE), cold.act(depth_mm(), STATE))


def test_what_cannot_be_used_is_refused_and_the_next_frame_goes_on(tmp_path):
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx"))
    for depth, state, message in (
        (depth_mm()[:-1], STATE, "wrong depth: size"),
        (depth_mm(), STATE[:7], r"wrong state: size \(7,\), expected \(8,\)"),
        (depth_mm(), np.full(8, np.nan, np.float32), "wrong state: .* is not finite"),
    ):
        with pytest.raises(UserError, match=message):
            policy.act(depth, state)
        policy.act(depth_mm(), STATE)


def test_the_page_s_first_lines_run(monkeypatch):
    first, known, *_ = code("../onnx.md")
    monkeypatch.chdir(Path(__file__).parents[1])
    made: dict = {}
    exec(first, made)
    assert made["start_rad"] == list(HOME_RAD)
    info = OnnxPolicy("pretrained/student/policy.onnx").info
    assert (info.execute_steps, info.action_scale_rad) == (1, 0.1)
    assert (round(info.camera["fx"], 1), info.camera["position"]) == (168.6, [0.94, 0.0, 0.56])
    assert np.isfinite(made["target_rad"]).all() and made["action"].shape == (1, info.chunk, 8)
    exec(known, made)
    np.testing.assert_allclose(made["action"][0, 0], made["expected"], atol=5e-4)


@pytest.fixture
def page(tmp_path, monkeypatch):
    """The page's own lines, and the class that the loop calls, on one file."""
    rng = np.random.default_rng(0)
    gain, state_gain = rng.normal(0, 1e-3, (3, 4, 8)), rng.normal(0, 1, (9, 4, 8))
    info = describe(execute_steps=2, closing_steps=3)
    path = write_policy(tmp_path / "policy.onnx", info, depth_gain=gain, state_gain=state_gain)
    monkeypatch.chdir(tmp_path)
    made: dict = {}
    for lines in (block for block in code("../onnx.md") if "\ndef " in block or block.startswith("def ")):
        exec(lines, made)
    return made, OnnxPolicy(path)


def test_the_page_s_lines_do_what_the_policy_class_does(page):
    rng, (lines, policy) = np.random.default_rng(1), page
    info, closed, depth = policy.info, [], depth_mm()
    for step in range(20):
        depth[:], width_m = rng.integers(400, 900), float(rng.uniform(0, 0.08))  # a camera's own buffer
        q_rad = HOME_RAD + rng.normal(0, 0.1, 7)
        state = np.append(q_rad, width_m).astype(np.float32)
        if step % 7 == 5:  # something is over the lens
            policy.forget()
            policy.wait(state)
            assert lines["act"](np.zeros_like(depth), q_rad, width_m) is None
            continue
        action = policy.act(depth, state)
        target_rad, close = lines["act"](depth, q_rad, width_m)
        wanted = q_rad + info.action_scale_rad * np.clip(action[:7], -1, 1)
        np.testing.assert_allclose(
            target_rad, np.clip(wanted, info.joint_lower_rad, info.joint_upper_rad), atol=1e-6
        )
        assert close == (action[7] > 0)
        closed.append(close)
    assert True in closed and False in closed
    for broken in ((np.full(7, np.nan), 0.08), (HOME_RAD, np.nan)):
        assert lines["act"](depth, *broken) is None


def test_the_page_s_picture_is_the_driver_s(page):
    lines, policy = page
    had, wanted = D455_STREAM, policy.info.profile
    assert (wanted.height_px, wanted.width_px) == depth_mm().shape
    counts = np.random.default_rng(0).integers(0, 2000, (had.height_px, had.width_px)).astype(np.uint16)
    for cx_px in (had.cx_px, had.cx_px + 150.0):  # the second sees less than all of it
        stream = replace(had, cx_px=cx_px)
        taken = lines["at_policy"](counts, stream.fx_px, stream.fy_px, stream.cx_px, stream.cy_px)
        np.testing.assert_array_equal(taken, at_profile(counts, stream, wanted))


def test_the_page_s_limits_are_within_both_arms():
    (line,) = (
        line
        for line in (TUTORIALS / "../onnx.md").read_text().splitlines()
        if "within both arms' are" in line
    )
    low, high = (
        np.array([getattr(arm, name) for arm in (PANDA, FR3)])
        for name in ("joint_lower_rad", "joint_upper_rad")
    )
    told = np.array(re.findall(r"(-?\d\.\d+) to (-?\d\.\d+)", line), float)
    np.testing.assert_allclose(told, np.stack([low.max(0), high.min(0)], axis=1))


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (np.append(np.degrees(HOME_RAD), 0.08), "cannot be radians"),
        (np.append(HOME_RAD, 80.0), "an opening of 80 cannot be metres"),
    ],
)
def test_a_state_in_other_units_is_refused(tmp_path, state, said):
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx"))
    with pytest.raises(UserError, match=said):
        policy.act(depth_mm(), state.astype(np.float32))


def test_nothing_is_kept_or_told_of_what_runs(tmp_path):
    path, home = write_policy(tmp_path / "p.onnx"), tmp_path / "home"
    home.mkdir()
    quiet = ("CI", "ORT_DISABLE_TELEMETRY", "ORT_RUNNING_UNIT_TESTS", "XDG_CACHE_HOME")
    env = {name: value for name, value in os.environ.items() if name not in quiet} | {"HOME": str(home)}
    lines = f"from deploy.policy import OnnxPolicy; OnnxPolicy({str(path)!r}).warm_up()"
    subprocess.run([sys.executable, "-c", lines], env=env, check=True, cwd=Path(__file__).parents[1])
    assert list(home.rglob("*")) == []
