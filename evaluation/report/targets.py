"""What a run is held to, and whether it got there: the verdict that a report opens with."""

from collections.abc import Mapping, Sequence
from typing import Any

from ddgrasp import contract
from evaluation import wilson

MET, MISSED, NOT_MEASURED = "met", "not met", "not measured"
PAPER_TEACHER, PAPER_LOWEST_OBJECT, PAPER_STUDENT = 0.954, 0.911, 0.957
"""Success in the paper (arXiv 2511.12912): teacher, the teacher's worst object, student on a real robot."""
SCORES = {"score": "", "score_real": "real depth: ", "samplers": ""}
"""Stages that judge themselves (their metrics have `targets` of the same form) and what tells them apart."""

Target = dict[str, str]
"""`target`, `measured` and `met`: MET, MISSED or NOT_MEASURED."""


def targets(report: Mapping[str, Any]) -> list[Target]:
    """Every target of a run with what was measured; success reaches one if the measured rate does."""
    teacher, deploy = report.get("teacher", {}), report.get("deploy", {})
    rates = [counts for counts in teacher.get("objects", {}).values() if counts.get("n")]
    lowest = min(rates, key=lambda counts: counts["rate"], default=None)
    rig = report.get("student_rig", {}).get("success")
    return [
        _rate(f"teacher succeeds in {PAPER_TEACHER:.1%} (paper)", teacher.get("success"), PAPER_TEACHER),
        _rate(f"teacher with its worst object in {PAPER_LOWEST_OBJECT:.1%} (paper)", lowest,
              PAPER_LOWEST_OBJECT),
        *(
            target | {"target": of + target["target"]}
            for stage, of in SCORES.items()
            for target in report.get(stage, {}).get("targets", ())
        ),
        _largest("ONNX file computes what JAX does, to", report.get("export", {}).get("max_abs_diff"),
                 report["config"].get("export", {}).get("max_abs_diff", 0.0)),
        _rate(f"exported student succeeds in {PAPER_STUDENT:.1%} on the rig (paper: a real robot)", rig,
              PAPER_STUDENT),
        _largest("frame to command, 99 of 100 within", deploy.get("latency_ms", {}).get("p99"),
                 1e3 * contract.CONTROL_DT_S, " ms"),
        _largest("missed deadlines of the 10 Hz loop: at most", deploy.get("missed_deadlines"), 0),
    ]  # fmt: skip


def verdict(judged: Sequence[Target]) -> str:
    """How many are met, missed and not measured, in one line."""
    count = [sum(target["met"] == state for target in judged) for state in (MET, MISSED, NOT_MEASURED)]
    return f"Targets: {count[0]} met, {count[1]} not met, {count[2]} not measured."


def _rate(name: str, success: Mapping[str, Any] | None, least: float) -> Target:
    if not success or not success.get("n"):
        return _target(name, None, False)
    return _target(name, wilson.describe(dict(success)), success["rate"] >= least)


def _largest(name: str, value: float | None, bound: float, unit: str = "") -> Target:
    measured = None if value is None else f"{value:.3g}{unit}"
    return _target(f"{name} {bound:.3g}{unit}", measured, value is not None and value <= bound)


def _target(name: str, measured: str | None, reached: bool) -> Target:
    met = NOT_MEASURED if measured is None else MET if reached else MISSED
    return {"target": name, "measured": measured or "", "met": met}
