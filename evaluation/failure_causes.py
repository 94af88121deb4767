"""Why trials failed, as far as the object's way tells: counts by cause."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from deploy.trials import TrialResult

FAULT = "ended by the robot"
UNTOUCHED = "never touched"
NOT_LIFTED = "not lifted"
LOST = "lifted and lost"
HELD = "still lifted at the end"
UNKNOWN = "not recorded"
CAUSES = (FAULT, UNTOUCHED, NOT_LIFTED, LOST, HELD, UNKNOWN)
"""In the order in which they are asked for: the first that fits is a trial's. `FAULT` is a reflex or a lost
connection, `UNKNOWN` a trial of before 2026-11-25, whose log does not say where the object was."""
TOUCHED_M, LIFTED_M = 0.005, 0.03
"""An object that has been further than this from where it lay was touched, or higher, lifted."""


def cause(result: TrialResult) -> str | None:
    """One of `CAUSES`; None if the trial succeeded."""
    if result.success:
        return None
    if any(" fault: " in event for event in result.events):
        return FAULT
    if not result.object_m:
        return UNKNOWN
    way_m = np.array(result.object_m) - result.object_m[0]
    if np.linalg.norm(way_m, axis=1).max() < TOUCHED_M:
        return UNTOUCHED
    if way_m[:, 2].max() < LIFTED_M:
        return NOT_LIFTED
    return HELD if way_m[-1, 2] >= LIFTED_M else LOST


def count(results: Sequence[TrialResult]) -> dict[str, dict[str, int]]:
    """Cause -> object -> failed trials; neither is there without one."""
    found: dict[str, dict[str, int]] = {name: {} for name in CAUSES}
    for result in results:
        if why := cause(result):
            found[why][result.object_name] = found[why].get(result.object_name, 0) + 1
    return {why: objects for why, objects in found.items() if objects}


def rows(failures: Mapping[str, Mapping[str, int]]) -> list[tuple[str, str, str]]:
    """(cause, how many, of which objects) of what `count` gives, most frequent first."""
    ordered = sorted(failures.items(), key=lambda item: -sum(item[1].values()))
    return [
        (why, str(sum(objects.values())), ", ".join(f"{name} {n}" for name, n in objects.items()))
        for why, objects in ordered
    ]


def describe(table: Mapping[str, Any]) -> str:
    """One line for a terminal of what `rig_trials.tabulate` gives; "" if nothing failed."""
    counted = [f"{why} {n}" for why, n, _ in rows(table.get("failures", {}))]
    return f"failures: {', '.join(counted)}" if counted else ""
