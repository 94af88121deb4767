"""How failed trials failed: the phase that the grasp got to, as far as the object's trajectory tells."""

from collections.abc import Mapping, Sequence

import numpy as np

from deploy.trials import TrialResult

FAULT = "ended by the robot"
UNTOUCHED = "never touched"
NOT_LIFTED = "not lifted"
LOST = "lifted and lost"
HELD = "still lifted at the end"
UNKNOWN = "not recorded"
MODES = (FAULT, UNTOUCHED, NOT_LIFTED, LOST, HELD, UNKNOWN)
"""In the order in which they are asked for: the first that fits is a trial's. `FAULT` is a reflex or a lost
connection, `UNKNOWN` a trial without positions of the object (`TrialResult.object_pos_m`)."""
MOVED_M = 0.005
"""An object that is this far from where it lay has been touched."""
LIFTED_M = 0.03
"""An object that is this high above where it lay is lifted."""
NOTE = (
    f"Touched: the object was more than {1e3 * MOVED_M:.0f} mm from where it lay; lifted: more than "
    f"{1e2 * LIFTED_M:.0f} cm above."
)


def mode(result: TrialResult) -> str | None:
    """One of `MODES`; None if the trial succeeded."""
    if result.success:
        return None
    if result.fault:
        return FAULT
    if not result.object_pos_m:
        return UNKNOWN
    moved_m = np.array(result.object_pos_m) - result.object_pos_m[0]
    if np.linalg.norm(moved_m, axis=1).max() <= MOVED_M:
        return UNTOUCHED
    if moved_m[:, 2].max() <= LIFTED_M:
        return NOT_LIFTED
    return HELD if moved_m[-1, 2] > LIFTED_M else LOST


def count(results: Sequence[TrialResult]) -> dict[str, dict[str, int]]:
    """Mode -> object -> failed trials; neither is there without one."""
    found: dict[str, dict[str, int]] = {name: {} for name in MODES}
    for result in results:
        if how := mode(result):
            found[how][result.object_name] = found[how].get(result.object_name, 0) + 1
    return {how: objects for how, objects in found.items() if objects}


def rows(failures: Mapping[str, Mapping[str, int]]) -> list[tuple[str, str, str]]:
    """(mode, how many, of which objects) of what `count` gives, most frequent first."""
    ordered = sorted(failures.items(), key=lambda item: -sum(item[1].values()))
    return [
        (how, str(sum(objects.values())), ", ".join(f"{name} {n}" for name, n in objects.items()))
        for how, objects in ordered
    ]


def describe(failures: Mapping[str, Mapping[str, int]]) -> str:
    """What `count` gives in one line."""
    return ", ".join(f"{how} {n}" for how, n, _ in rows(failures)) or "none"
