"""How many trials are behind every success rate."""

from dataclasses import dataclass

from ddgrasp.config.checks import Count, Section


@dataclass(frozen=True)
class EvalConfig(Section, name="evaluation"):
    """Trials behind every success rate."""

    teacher_trials: Count = 300
    """Episodes of the teacher in its own simulation."""
    student_trials: Count = 100
    """Episodes of the student on clean depth and on that of its training."""
    rig_trials: Count = 120
    """Episodes of the exported student on the development rig, the objects of training and the six unseen
    ones in turn."""
