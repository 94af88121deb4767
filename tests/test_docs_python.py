"""The blocks of docs/python.md are one script, which runs."""

import numpy as np
import pytest

from deploy.trials import TrialResult
from tutorial_support import TUTORIALS, code

PAGE = "../python.md"


def test_the_page_s_script_runs(capsys):
    made: dict = {}
    for block in code(PAGE):
        exec(block, made)
    assert made["clean_m"].shape == made["noisy_m"].shape == (180, 320)
    assert np.linalg.norm(made["grasp_m"] - np.array([0.48, 0.0, 0.03])) < 0.04, "the box stands elsewhere"
    assert 0.05 < np.mean(made["made_mm"] == 0) - np.mean(made["clean_m"] == 0) < 0.15
    assert capsys.readouterr().out.startswith("94.8 % of 600")


@pytest.mark.parametrize("name", [*TrialResult.__dataclass_fields__])
def test_every_field_of_a_trial_is_in_the_table(name):
    table = [line for line in (TUTORIALS / PAGE).read_text().splitlines() if line.startswith("| `")]
    assert any(f"`{name}`" in line for line in table)
