"""`--scale`: which counts it changes, what it leaves, where it is told."""

import dataclasses
import re
from dataclasses import replace

import pytest

from app.commands import describe_commands, parse
from ddgrasp.config import Config
from ddgrasp.config.checks import kinds
from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS
from ddgrasp.scaling import KEPT, SCALED, scaled, value_of
from evaluation.report.summary import TESTS_PRESET, trial_run

SIZE = re.compile(
    r"_px$|_percent$|_size$|width|heads|channels|keypoints|features$|stride|space_to_depth|hidden|blocks$"
    r"|pattern|dots|subpixel|chunk|execute_steps|closing_steps|^seed$|^score\."
)
"""Names of whole numbers that are sizes of networks, pictures or the camera's parts, not counts of work."""


def whole_numbers(section: object, prefix: str = ""):
    for field in kinds(type(section)):
        value, name = getattr(section, field), prefix + field
        if dataclasses.is_dataclass(value):
            yield from whole_numbers(value, f"{name}.")
        elif isinstance(value, int) and not isinstance(value, bool):
            yield name


def test_every_count_is_either_scaled_or_said_to_stay():
    unknown = [
        name
        for name in whole_numbers(PRESETS["paper"])
        if name not in SCALED and name not in KEPT and (not SIZE.search(name) or "batch" in name)
    ]
    assert unknown == []


@pytest.mark.parametrize("name", sorted(PRESETS))
@pytest.mark.parametrize("factor", [0.3, 1e-3, 1e-9])
def test_counts_shrink_to_their_least_and_nothing_else_changes(name, factor):
    preset = PRESETS[name]
    small = scaled(preset, factor)
    for field, least in SCALED.items():
        before, after = value_of(preset, field), value_of(small, field)
        assert min(before, 1) <= after <= before
        if field not in ("teacher.num_envs",):
            assert after == min(before, max(least, round(factor * before)))
    assert small.teacher.num_envs % small.teacher.minibatches == 0
    assert small.scale == factor
    assert small.world == preset.world and small.student.encoder == preset.student.encoder
    assert small.ddg.unet == preset.ddg.unet and small.ddg.depth == preset.ddg.depth


def test_by_hand():
    small = scaled(PRESETS["paper"], 0.001)
    assert (small.demos.episodes, small.record.trajectories, small.teacher.num_envs) == (2, 2, 64)
    assert (small.student.training.steps, small.student.dagger.steps) == (40, 5)
    assert scaled(PRESETS["paper"], 1.0) == PRESETS["paper"]


def test_the_option_scales_the_preset_and_counts_given_stay():
    args = ["--preset", "paper", "--scale", "0.001", "--demos.episodes", "17", "--world.backend", "cpu"]
    config = parse("run", args).config  # pyright: ignore[reportAttributeAccessIssue]
    expected = scaled(PRESETS["paper"], 0.001)
    world, demos = replace(expected.world, backend="cpu"), replace(expected.demos, episodes=17)
    assert config == replace(expected, world=world, demos=demos)


@pytest.mark.parametrize(
    "value, message",
    [("0", "scale is 0.0; expected above 0, up to 1"), ("2", "scale is 2.0; expected above 0, up to 1"),
     ("nan", "scale is nan; expected a finite number"), ("small", "scale is 'small'; expected a number")],
)  # fmt: skip
def test_a_factor_out_of_bounds_is_refused(value, message):
    with pytest.raises(UserError, match=re.escape(message)):
        parse("run", ["--preset", "debug", "--scale", value])


def test_help_and_report_say_what_a_scaled_run_is():
    assert "--scale 0.001" in describe_commands()
    assert trial_run({"preset": "paper", "scale": 1.0}) == ""
    assert "Preset debug" in trial_run({"preset": TESTS_PRESET, "scale": 1.0})
    assert TESTS_PRESET in PRESETS
    assert "preset paper times 0.001" in trial_run({"preset": "paper", "scale": 0.001})
    assert Config("test").scale == 1
