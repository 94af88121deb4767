"""Learning curves of teachers as one picture: success against control steps and against minutes.

    python -m benchmarks.teacher_curves LABEL=RUN [LABEL=RUN ...] [--out runs/teacher_curves.png]

RUN is a run's directory; runs with the same label, such as several seeds, get one colour. Every point is a
deterministic evaluation during training: the policy that is kept is the best of them, and is measured anew.
"""

import argparse
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.command import one_line
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes, to_png
from ddgrasp.progress import read_curves

_LINES = ("-", "--", ":", "-.")
"""Of the runs with one label."""


@one_line
def main() -> None:
    """Writes the picture and prints its path."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="LABEL=RUN")
    parser.add_argument("--out", type=Path, default=Path("runs/teacher_curves.png"))
    args = parser.parse_args()
    picture = draw([_named(text) for text in args.runs])
    atomic_write_bytes(args.out, picture)
    print(args.out)


def draw(runs: list[tuple[str, Path]]) -> bytes:
    """PNG of the curves of `runs`, (label, run's directory); UserError where there are none."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    by_steps, by_minutes = figure.subplots(1, 2, sharey=True)
    labels = list(dict.fromkeys(label for label, _ in runs))
    for i, label in enumerate(labels):
        for j, run in enumerate(run for other, run in runs if other == label):
            curves = read_curves(run / "teacher")
            if "control_steps" not in curves:
                raise UserError(f"{run} holds no teacher's evaluations: give the directory of a run.")
            success = [100 * value for _, value in curves["eval_success"]]
            style = {"color": f"C{i}", "linestyle": _LINES[j % len(_LINES)], "label": None if j else label}
            by_steps.plot([value / 1e6 for _, value in curves["control_steps"]], success, **style)
            by_minutes.plot([value for _, value in curves["minutes"]], success, **style)
    _finish(by_steps, "control steps, millions")
    _finish(by_minutes, "minutes of training, evaluations included")
    by_steps.set_ylabel("success, %")
    by_steps.legend(frameon=False, loc="lower right")
    return to_png(figure, dpi=120)


def _named(text: str) -> tuple[str, Path]:
    label, separator, run = text.partition("=")
    if not separator:
        raise UserError(f"{text!r} has no label: write it as LABEL=RUN.")
    return label, Path(run)


def _finish(axes: Axes, label: str) -> None:
    axes.set_xlabel(label)
    axes.set_ylim(-3, 103)
    axes.set_xlim(left=0)
    axes.grid(alpha=0.3)


if __name__ == "__main__":
    main()
