"""Modes of failure from the object's trajectory, and what the terminal and the pages say of them."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from deploy.trial_log import read_log
from deploy.trials import TrialResult
from evaluation import failure_modes, rig_trials

LYING = (0.5, 0.1, 0.02)


def trial(moved, name="can", success=False, event="") -> TrialResult:
    """`moved`: the object's displacement at every step, metres."""
    places = [[float(x) for x in np.add(LYING, step)] for step in moved]
    return TrialResult(
        0,
        name,
        False,
        success,
        5,
        0,
        0,
        {},
        [event] * bool(event),
        *([] for _ in range(5)),
        object_pos_m=places,
    )


STILL, PUSHED, LIFTED = (0, 0, 0), (0.04, 0, -0.01), (0, 0.02, 0.2)


@pytest.mark.parametrize(
    ("moved", "mode"),
    [
        ([STILL, (0.002, 0.002, 0.001)], "never touched"),
        ([STILL, PUSHED, PUSHED], "not lifted"),
        ([STILL, (0, 0, 0.025), STILL], "not lifted"),
        ([STILL, LIFTED, PUSHED], "lifted and lost"),
        ([STILL, LIFTED, PUSHED, LIFTED], "still lifted at the end"),
        ([], "not recorded"),
    ],
)
def test_the_trajectory_of_the_object_tells_the_mode(moved, mode):
    assert failure_modes.mode(trial(moved)) == mode
    assert failure_modes.mode(trial(moved, event="step 3 (0.30 s) fault: it met something")) == (
        "ended by the robot"
    )
    assert failure_modes.mode(trial(moved, success=True)) is None


def test_failures_are_counted_by_mode_and_object_most_frequent_first():
    results = [trial([STILL, PUSHED], "can"), trial([STILL, LIFTED, STILL], "cube"), trial([STILL], "can")]
    results += [trial([STILL, LIFTED, PUSHED], "can"), trial([STILL, LIFTED], "cube", success=True)]
    table = rig_trials.tabulate(results)
    assert table["failures"] == {
        "never touched": {"can": 1},
        "not lifted": {"can": 1},
        "lifted and lost": {"cube": 1, "can": 1},
    }
    rows = failure_modes.rows(table["failures"])
    assert rows[0] == ("lifted and lost", "2", "cube 1, can 1") and len(rows) == 3
    told = rig_trials.describe(table).splitlines()
    assert told[-1] == "failures: lifted and lost 2, never touched 1, not lifted 1"
    assert rig_trials.describe(rig_trials.tabulate(results[-1:])).endswith("failures: none")


def test_a_log_of_before_is_read_and_its_failures_are_not_recorded(tmp_path):
    old = asdict(trial([STILL, PUSHED]))
    del old["object_pos_m"]
    (tmp_path / "trials.jsonl").write_text(f"{{}}\n{json.dumps(old)}\n")
    table = rig_trials.tabulate(read_log(tmp_path / "trials.jsonl")[1])
    assert table["failures"] == {"not recorded": {"can": 1}}
