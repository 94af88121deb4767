"""Which seeds are for developing on the rigs and which are for testing: no number is both.

What was chosen, tuned or debugged by looking at trials is a development figure. Test seeds are looked at once
for each row of a table, and docs/test_rig.md counts the looks.
"""

from typing import Literal

Split = Literal["development", "test"]
SEEDS: dict[Split, range] = {"development": range(1000), "test": range(1_000_000, 1_001_000)}


def seed(split: Split, number: int) -> int:
    """The seed `number`, from 0, of a split. Raises ValueError if the split has fewer."""
    if not 0 <= number < len(SEEDS[split]):
        raise ValueError(f"{split} has seeds 0 to {len(SEEDS[split]) - 1}, not {number}")
    return SEEDS[split][number]
