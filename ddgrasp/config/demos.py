"""The teacher's episodes that the student learns from."""

from dataclasses import dataclass
from typing import Annotated

from ddgrasp.config.checks import Count, Range, Section, Share


@dataclass(frozen=True)
class DemosConfig(Section, name="demos"):
    """Teacher episodes for the student."""

    episodes: Count = 240
    """Successful episodes to keep (the paper: about 1200)."""
    parallel: Annotated[int, Range(1, 65_536)] = 60
    """Environments rolled out together."""
    action_noise: Annotated[float, Range(0, 2)] = 0.4
    """Standard deviation of the perturbations of the executed actions (range -1 to 1); labels stay the
    teacher's."""
    noise_share: Share = 0.05
    """Probability per step that a perturbation of four steps starts."""
    rgb: bool = True
    """Keep colour as well."""
