"""Stage report: reads every manifest of a run, writes report.json and report.html, prints the table."""

from pathlib import Path
from typing import Any

from ddgrasp.files import atomic_write_json, atomic_write_text
from evaluation.report.html import REPORT_HTML
from evaluation.report.run_page import render_html
from evaluation.report.summary import REPORT, build_report


def write_report(run_dir: Path) -> dict[str, Any]:
    """Writes `run_dir/report.json` and `run_dir/report.html` from the finished stages; returns the report."""
    report = build_report(run_dir)
    atomic_write_json(run_dir / REPORT, report)
    atomic_write_text(run_dir / REPORT_HTML, render_html(report, run_dir))
    return report
