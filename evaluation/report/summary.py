"""All numbers of a run in one place: report.json, and the table a run ends with.

Numbers come from the stages' manifests as they were measured; this module only adds Wilson intervals.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ddgrasp import artifacts, attempts, contract, tables
from ddgrasp.artifacts import Artifact
from ddgrasp.errors import UserError
from ddgrasp.stages import ON_REQUEST, STAGES, get_stage
from evaluation import backends, perception_table, teacher_trials, wilson
from evaluation.report import deployments
from evaluation.report.html import leaves
from evaluation.report.targets import MISSED, NOT_MEASURED, targets, verdict

REPORT = "report.json"
_TOP_LEVEL = "student_"
_STUDY = "study.html"
"""Page of `ddgrasp study table2`, which it writes itself."""
TESTS_PRESET = "debug"
"""Whose figures mean nothing."""


def build_report(run_dir: Path) -> dict[str, Any]:
    """Report of every finished stage under `run_dir`; UserError if there is none.

    Keys: `stages.<name>.{seconds, trained, loaded, machine, made_with}`, the last with what of its own
    sections that stage was made with and `config` has otherwise; `<name>` holds what that stage measured,
    except keys that start with `student_` (student_clean, student_ddg, student_rig), which stand at the top;
    `machine` (the last stage's), `versions`, `preset`, `scale` (below 1 in a trial run), `seed`, `config`;
    `targets`, each with what was measured and whether it is met; `outdated.<name>`, the parent for which that
    stage is left out: the one here is not what it was made of, or is left out itself. A success rate is
    {rate, n, successes, low, high}. `teacher.trials`, if `ddgrasp teacher eval` was run, are its rows;
    `teacher.backends`, if `ddgrasp teacher compare` was, is `evaluation.backends.table`;
    `student.perception`, if `ddgrasp student perception` was, is `evaluation.perception.tabulate`.
    """
    read = {
        stage.name: artifacts.read_artifact(run_dir / stage.name)
        for stage in (*STAGES, *ON_REQUEST)
        if artifacts.is_finished(run_dir / stage.name)
    }
    found = {name: made for name, made in read.items() if made.manifest.stage == name}
    if not found:
        raise UserError(f"{run_dir} {_why_nothing(run_dir)}")
    outdated = _outdated(found)
    finished = {name: artifact.manifest for name, artifact in found.items() if name not in outdated}
    flow = [stage.name for stage in STAGES if stage.name in finished]
    latest = finished[flow[-1]] if flow else next(iter(finished.values()))
    report: dict[str, Any] = {
        "preset": latest.config.get("preset"),
        "scale": latest.config.get("scale", 1.0),
        "seed": latest.seed,
        "contract_version": contract.CONTRACT_VERSION,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "machine": latest.machine,
        "versions": latest.versions,
        "outdated": outdated,
        "begun": [s.name for s in STAGES if s.name not in found and attempts.has_work(run_dir / s.name)],
        "stages": {},
    }
    for name, manifest in finished.items():
        report["stages"][name] = {
            "seconds": manifest.seconds,
            "trained": manifest.origin == "trained",
            "loaded": manifest.origin == "loaded",
            "created": manifest.created,
            "machine": manifest.machine,
            "made_with": _made_with(name, manifest.config, latest.config),
        }
        metrics = with_intervals(manifest.metrics)
        report[name] = {key: value for key, value in metrics.items() if not key.startswith(_TOP_LEVEL)}
        report.update({key: value for key, value in metrics.items() if key.startswith(_TOP_LEVEL)})
    if "teacher" in finished and (rows := teacher_trials.load(run_dir / "teacher")):
        report["teacher"]["trials"] = rows
    if "teacher" in finished:
        trained_on = finished["teacher"].config["world"]["backend"]
        if rows := backends.table(run_dir / "teacher", trained_on):
            report["teacher"]["backends"] = rows
    if "student" in finished and (rows := perception_table.load(run_dir / "student")):
        report["student"]["perception"] = rows
    report["config"] = latest.config
    report["targets"] = targets(report)
    return report


def _why_nothing(run_dir: Path) -> str:
    """Why there is nothing to report, and what to do."""
    if not run_dir.is_dir():
        return "is a file: name the folder it is in." if run_dir.exists() else "is not there: name a run."
    if artifacts.is_finished(run_dir):
        return f"is one finished stage: name the run that it is of, {run_dir.resolve().parent}."
    if (study := run_dir / _STUDY).is_file():
        return f"is a study, whose tables are in {study}: name folders of its rows, in {run_dir / 'trials'}."
    if deployments.find(run_dir):
        return "holds deployments: they are reported a folder at a time, `ddgrasp report FOLDER`."
    if inside := sorted(path.parent.name for path in run_dir.glob("*/trials.jsonl")):
        return f"holds trials, of {', '.join(inside)}: name one of these folders, or several."
    return "holds no finished stage: nothing to report. Start one with `ddgrasp run`."


def _made_with(stage: str, own: Mapping[str, Any], run: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of the stage's own sections whose value is not the run's, as one asked for later may have."""
    sections, there = get_stage(stage).sections, dict(leaves(run))
    return {
        name: value
        for name, value in leaves(own)
        if any(f"{name}.".startswith(f"{section}.") for section in sections)
        and (name not in there or there[name] != value)
    }


def _outdated(found: Mapping[str, Artifact]) -> dict[str, str]:
    """Stages made of what is not here -> the parent that is another here, or made of what is not here."""
    outdated: dict[str, str] = {}
    for name, artifact in found.items():  # parents come first
        for parent in get_stage(name).parents:
            made_of = artifact.manifest.parents.get(parent)
            if made_of and (parent in outdated or (parent in found and found[parent].hash != made_of)):
                outdated[name] = parent
    return outdated


def with_intervals(value: Any) -> Any:
    """`value` with rate, low and high added to every {"successes": k, "n": n} in it."""
    if isinstance(value, Mapping):
        if {"successes", "n"} <= value.keys():
            return {**value, **wilson.success(int(value["successes"]), int(value["n"]))}
        return {key: with_intervals(item) for key, item in value.items()}
    if isinstance(value, list):
        return [with_intervals(item) for item in value]
    return value


# --- for people ----------------------------------------------------------------------------------


def summary_rows(report: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """(stage, made or loaded, time, result) per line; the last line is the exported student in the rig."""
    rows = []
    there = {*report["stages"], *report.get("outdated", {})}
    asked_for = [stage for stage in ON_REQUEST if stage.name in there]
    for stage in (*STAGES[:-1], *asked_for, STAGES[-1]):
        entry = report["stages"].get(stage.name)
        if entry is None:
            rows.append((stage.name, "", "", _why_absent(stage.name, report)))
            continue
        section = report["config"].get(stage.name, {})
        start = section.get("start") or section.get("init_from", "")
        origin = "loaded" if entry["loaded"] else "this run" + (f", from {start}" if start else "")
        results = _results(stage.name, report) or [stage.makes]
        rows.append((stage.name, origin, _duration(entry["seconds"]), results[0]))
        rows.extend(("", "", "", result) for result in results[1:])
    if rig := _success(report, "student_rig"):
        apart = _apart(report["student_rig"])
        rows.append(("deploy", "", "", f"exported student on the development rig: success {rig}{apart}"))
    return rows


def _why_absent(stage: str, report: Mapping[str, Any]) -> str:
    outdated = report.get("outdated", {})
    if stage in report.get("begun", ()):
        return "begun, not finished: the same command with --resume goes on"
    if (parent := outdated.get(stage)) is None:
        return "not run"
    if parent in outdated:
        return f"left out: made of {parent}, which is left out"
    return f"left out: made of another {parent} than is here"


def _apart(rig: Mapping[str, Any]) -> str:
    """Objects of training and others, each as a count."""
    kinds = {kind: rig[kind] for kind in ("seen", "unseen") if kind in rig}
    return "".join(f", {kind} {counts['successes']} of {counts['n']}" for kind, counts in kinds.items())


def trial_run(report: Mapping[str, Any]) -> str:
    """What must be said of a run whose counts are too small to learn from, the tests' preset's or scaled down
    (`ddgrasp.scaling`); empty for any other.
    """
    if report["preset"] == TESTS_PRESET:
        return (
            f"Preset {TESTS_PRESET} passes through every stage in minutes and learns next to nothing: its "
            "figures say nothing."
        )
    if (scale := report.get("scale", 1.0)) == 1:
        return ""
    return (
        f"Trial run: the counts of preset {report['preset']} times {scale:g}, so that every stage is passed "
        "through. Its figures say nothing about the preset."
    )


def print_summary(report: Mapping[str, Any]) -> None:
    """Prints verdict and table of `summary_rows` to standard output, a trial run's with a warning above."""
    console = tables.console(width=160)
    if warning := trial_run(report):
        console.print(warning, style="bold", highlight=False)
    judged = targets(report)
    console.print(verdict(judged), style="bold", highlight=False)
    for target in judged:
        if target["met"] == MISSED:
            console.print(
                f"  not met: {target['target']}: {target['measured']}", style="red", highlight=False
            )
    columns = ("Stage", "From", "Time", "Measured (success: rate of n, Wilson 95 % interval)")
    console.print(tables.table(columns, summary_rows(report)))


def _results(stage: str, report: Mapping[str, Any]) -> list[str]:
    """What is said about a stage, most important first."""
    metrics = report.get(stage, {})
    if stage == "teacher":
        lines = [f"success {wilson.describe(metrics['success'])}"] if "success" in metrics else []
        lines += [f"{name}: {wilson.describe(rate)}" for name, rate in metrics.get("objects", {}).items()]
        return lines + [_on_backend(row) for row in metrics.get("backends", [])]
    if stage == "student":
        named = (("student_clean", "clean depth"), ("student_ddg", _own_depth(report)))
        return [
            f"{text}: success {rate}{perceived(report[key])}"
            for key, text in named
            if (rate := _success(report, key))
        ]
    if stage == "ddg" and {"recorded", "generated"} <= metrics.keys():
        shares = [metrics[key]["invalid_fraction"] for key in ("recorded", "generated")]
        judged_on = "held-out" if metrics.get("frames", {}).get("training", 1) else "recorded"
        return [f"invalid pixels: recorded {shares[0]:.1%}, generated {shares[1]:.1%} ({judged_on} frames)"]
    if stage == "export" and "max_abs_diff" in metrics:
        return [f"largest difference between JAX and ONNX actions {metrics['max_abs_diff']:.1e}"]
    if stage == "deploy" and "latency_ms" in metrics:
        latency = metrics["latency_ms"]
        if latency["p50"] is None:
            return ["frame to command not measured: on the real clock every step held, no frame came in time"]
        return [f"frame to command p50 {latency['p50']:.1f} ms, p99 {latency['p99']:.1f} ms"]
    if "targets" in metrics:
        met = [target["met"] for target in metrics["targets"] if target["met"] != NOT_MEASURED]
        return [f"{metrics['targets'][0]['target']}: {metrics['targets'][0]['measured']}",
                f"targets met: {met.count('met')} of {len(met)} measured"]  # fmt: skip
    return [
        f"{name.replace('_', ' ')} {_number(value)}"
        for name, value in metrics.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    ][:3]


def _own_depth(report: Mapping[str, Any]) -> str:
    """What the student was trained on, which is not always the generator's."""
    student = report["config"].get("student", {})
    source, ellipses = student.get("depth_source", "learned"), student.get("ellipse_dropout")
    name = "generated depth" if source == "learned" else "depth of its training"
    details = [source] if source != "learned" else []
    details += [f"{ellipses:g} elliptic holes a picture"] if ellipses else []
    return f"{name} ({', '.join(details)})" if details else name


def perceived(student: Mapping[str, Any]) -> str:
    """Perception's median error in new scenes; nothing where it was not measured."""
    error_mm = student.get("position_error_mm")
    return "" if error_mm is None else f", grasp perceived to {error_mm:.1f} mm"


def _on_backend(row: Mapping[str, Any]) -> str:
    drop = row["drop_points"]
    text = f"on {row['backend']}: success {wilson.describe(row['success'])}"
    return text if not drop else f"{text}, drop {drop:.1f} points"


def _success(report: Mapping[str, Any], key: str) -> str:
    value = report.get(key, {}).get("success")
    return wilson.describe(value) if value else ""


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"
