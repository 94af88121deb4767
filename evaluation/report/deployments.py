"""Deployments as one page: how each ended, how it kept time, its film, what happened in it."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_text, read_json
from deploy.record import ENDED, FILM_FILE, REPORT_FILE, STEPS_FILE
from evaluation import wilson
from evaluation.report.html import REPORT_HTML, contents, film_file, heading, page, table

_HEADER = ("deployment", "policy", "robot", "camera", "ended", "steps", "missed", "holds", "frame to command")
_NOTE = (
    "<p class=note>Success: of deployments that were judged, and of those that a fault ended, which failed "
    "unless report.json says otherwise. Dry runs do not count, nor what was interrupted and never judged. "
    "Missed: control steps left out since the one before took too long. Holds: steps in which the arm stood "
    "still for want of a frame or a state. Frame to command: from a frame in hand to the command sent.</p>"
)

_COUNTS, _TIMES = ("steps", "holds", "missed_deadlines"), ("p50", "p99")
_FIELDS = (*_COUNTS, "fault", "events", "latency_ms")
"""What the page shows of a report."""


@dataclass(frozen=True)
class Deployment:
    """What one folder holds."""

    folder: Path
    report: Mapping[str, Any]

    @property
    def is_driven(self) -> bool:
        """Whether the arm was to move."""
        return not self.report.get("dry_run")

    @property
    def success(self) -> bool | None:
        """As judged; a fault that nobody judged is a failure, as on the rigs. None counts for nothing."""
        judged = self.report["success"]
        faulted = self.report["fault"] and self.is_driven and not self.report["interrupted"]
        return False if judged is None and faulted else judged

    @property
    def ended(self) -> str:
        """In a few words."""
        if self.report["fault"]:
            judged = f"{ENDED[True]}, then " if self.success else ""
            return f"{judged}fault: {self.report['fault']}"
        if not self.is_driven:
            return "dry run"
        judged = ENDED[self.report["success"]]
        if not self.report["interrupted"]:
            return judged
        return "interrupted" if self.report["success"] is None else f"{judged}, then interrupted"


def find(folder: Path) -> list[Deployment]:
    """Those in `folder`, oldest first; `folder` itself if it is one. Unfinished ones are left out."""
    places = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())] if folder.is_dir() else []
    finished = (place for place in places if (place / STEPS_FILE).exists() and (place / REPORT_FILE).exists())
    return [Deployment(place, _report(place / REPORT_FILE)) for place in finished]


def _report(path: Path) -> Mapping[str, Any]:
    """A report, of which people may set `success` by hand. Raises UserError unless it is one."""
    report = read_json(path)
    if not isinstance(report, dict) or "success" not in report:
        raise UserError(
            f"{path} has no 'success': it is not what `ddgrasp deploy` leaves; move it elsewhere."
        )
    if report["success"] not in (True, False, None):
        raise UserError(f'{path}: "success" is {report["success"]!r}; expected true, false or null.')
    if absent := [name for name in _FIELDS if name not in report]:
        raise UserError(f"{path} lacks {', '.join(absent)}: change nothing in it but 'success'.")
    if wrong := [f"{name} is {report[name]!r}" for name in _damaged(report)]:
        raise UserError(f"{path}: {', '.join(wrong)}: change nothing in it but 'success'.")
    return {"interrupted": False, **report}


def _damaged(report: Mapping[str, Any]) -> list[str]:
    """Fields of another kind than `ddgrasp deploy` writes."""
    times, events = report["latency_ms"], report["events"]
    taken = [times.get(name, "") for name in _TIMES] if isinstance(times, dict) else [""]
    timed = all(time is None for time in taken) or all(isinstance(time, int | float) for time in taken)
    listed = isinstance(events, list) and all(isinstance(event, str) for event in events)
    counted = [name for name in _COUNTS if not isinstance(report[name], int) or report[name] < 0]
    return counted + ["latency_ms"] * (not timed) + ["events"] * (not listed)


def write(folder: Path, deployments: Sequence[Deployment]) -> Path:
    """Writes the page into `folder`; returns its path."""
    path = folder / REPORT_HTML
    atomic_write_text(path, render(deployments))
    return path


def render(deployments: Sequence[Deployment]) -> str:
    """The page."""
    body = [
        "<h1>Deployments</h1>",
        f"<p class={_alarm(deployments)}>{escape(verdict(deployments))}</p>",
        contents([_title(deployment) for deployment in deployments]),
        _NOTE,
        table(_HEADER, [_row(deployment) for deployment in deployments]),
        *(part for deployment in deployments for part in _section(deployment)),
    ]
    return page("Deployments: DiffuDepGrasp-JAX", body)


def verdict(deployments: Sequence[Deployment]) -> str:
    """How many succeeded of those that count, for each policy, robot and camera apart, how many nobody
    judged, what ended by a fault, deadlines missed; without dry runs."""
    driven = [deployment for deployment in deployments if deployment.is_driven]
    alike: dict[tuple[str, ...], list[Deployment]] = {}  # by the file's hash: its path may be typed otherwise
    for deployment in sorted(driven, key=_setup):
        policy, robot, camera, sha256 = _setup(deployment)
        alike.setdefault((sha256 or policy, robot, camera), []).append(deployment)
    setups = [_setup(some[0]) for some in alike.values()]
    rates = [_rate(some) for some in alike.values()]
    if len(setups) > 1:  # a rig's trials say nothing of an arm's, nor one policy's of another's
        rates = [f"{_named(setup, setups)}: {rate}" for setup, rate in zip(setups, rates, strict=True)]
    rate = "; ".join(rates) or _rate([])
    faults = sum(bool(deployment.report["fault"]) for deployment in driven)
    missed = sum(deployment.report["missed_deadlines"] for deployment in driven)
    steps = sum(deployment.report["steps"] for deployment in driven)
    dry = len(deployments) - len(driven)
    beside = f" Beside them {dry} dry run{'s' * (dry > 1)}." if dry else ""
    return f"Success {rate}. Ended by a fault: {faults}. Missed deadlines: {missed} in {steps} steps.{beside}"


def _setup(deployment: Deployment) -> tuple[str, str, str, str]:
    """Policy, robot, camera, and the policy's hash: a file may be exported again under its name."""
    policy, robot, camera, sha256 = (
        str(deployment.report.get(name, "")) for name in ("policy", "robot", "camera", "policy_sha256")
    )
    return policy, robot, camera, sha256


def _named(setup: tuple[str, str, str, str], setups: Collection[tuple[str, str, str, str]]) -> str:
    policy, robot, camera, sha256 = setup
    alike = [other for other in setups if other[:3] == setup[:3]]
    which = f" ({sha256[:8] or 'hash not noted'})" if len(alike) > 1 else ""
    return f"{policy}{which} on {robot} with {camera}"


def _rate(driven: Sequence[Deployment]) -> str:
    """Success of those that count, and how many do not."""
    outcomes = [deployment.success for deployment in driven if deployment.success is not None]
    if not outcomes:
        return "none was judged"
    unjudged = len(driven) - len(outcomes)
    rate = wilson.describe(wilson.success(sum(outcomes), len(outcomes)))
    return f"{rate}, {unjudged} not judged" if unjudged else rate


def _row(deployment: Deployment) -> list[str]:
    report = deployment.report
    latency = report["latency_ms"]
    time = "" if latency["p50"] is None else f"p50 {latency['p50']:.1f} ms, p99 {latency['p99']:.1f} ms"
    numbers = (str(report[name]) for name in ("steps", "missed_deadlines", "holds"))
    about = (str(report.get(name, "")) for name in ("policy", "robot", "camera"))
    return [deployment.folder.name, *about, deployment.ended, *numbers, time]


def _section(deployment: Deployment) -> list[str]:
    parts = [heading(_title(deployment))]
    if (strip := deployment.folder / FILM_FILE).exists():
        parts.append(film_file(strip, f"film of {deployment.folder.name}"))
    if events := deployment.report["events"]:
        parts.append("<pre>" + escape("\n".join(events)) + "</pre>")
    return parts


def _title(deployment: Deployment) -> str:
    return f"{deployment.folder.name}: {deployment.ended}"


def _alarm(deployments: Sequence[Deployment]) -> str:
    """Red where a deadline was missed or a robot failed."""
    driven = (deployment.report for deployment in deployments if deployment.is_driven)
    return "missed" if any(report["missed_deadlines"] or report["fault"] for report in driven) else "verdict"
