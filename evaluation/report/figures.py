"""Pictures of a run, drawn with Matplotlib into PNG bytes. Depth has one colour map, invalid pixels a colour
that is not in it."""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Float32, Real, UInt8
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ddgrasp.depth import to_metres, to_millimetres
from ddgrasp.files import to_png
from rig.film import INVALID_RGB, colored

DEPTH_COLORS = "viridis_r"
"""What `rig.film.colored` draws depth in, for scales beside pictures."""
MAX_FRAMES = 8
"""Most frames in one film strip."""
TITLE_IN, GAP_IN, SCALE_IN, SCALE_HIGH_IN = 0.3, 0.06, 0.85, 1.6
"""Inches above pictures for a title, between them, beside them for the scale of depth, and its height."""
LINE_IN, LETTER_IN = 0.18, 0.08
"""Inches for a line of a label beside pictures, and for each letter of it."""
CURVE_BOX = (0.22, 0.2, 0.72, 0.67)
"""Left, bottom, width and height of a curve's axes, shares of its picture."""


def depth_to_metres(depth: Real[np.ndarray, "*any"]) -> Float32[np.ndarray, "*any"]:
    """Depth as float32 metres, 0 = invalid; integer input is millimetres, float input metres."""
    metres = to_metres(depth) if np.issubdtype(depth.dtype, np.integer) else depth
    return np.where(np.isfinite(metres), metres, 0.0).astype(np.float32)


def depth_range_m(depths: Sequence[Float[np.ndarray, "..."]]) -> tuple[float, float]:
    """(near, far) that shows most valid pixels of all `depths` (metres): 1st and 99th percentile."""
    valid = np.concatenate([depth[depth > 0].ravel() for depth in depths]) if depths else np.empty(0)
    if valid.size == 0:
        return 0.0, 1.0
    near, far = np.percentile(valid, (1, 99))
    return float(near), float(max(far, near + 0.01))


def color_depth(
    depth_m: Float[np.ndarray, "*b H W"], near_m: float, far_m: float
) -> UInt8[np.ndarray, "*b H W 3"]:
    """`rig.film.colored` of depth in metres: (..., H, W) to (..., H, W, 3) uint8."""
    return colored(to_millimetres(depth_m), 1000.0 * near_m, 1000.0 * far_m)


def draw_panels(panels: Mapping[str, Real[np.ndarray, "..."]]) -> bytes:
    """PNG of images side by side, all depth on one scale; see `Progress.picture` for what a panel may be."""
    frames = {title: _as_frames(panel) for title, panel in panels.items()}
    depths = [depth_to_metres(frame) for frame in frames.values() if frame.ndim == 3]
    near, far = depth_range_m(depths)
    strips = {
        title: _to_rgb(frame) if frame.ndim == 4 else color_depth(depth_to_metres(frame), near, far)
        for title, frame in frames.items()
    }
    strips = {title: _thin(strip) for title, strip in strips.items()}
    longest = max(len(strip) for strip in strips.values())
    if longest == 1:
        figure = _grid([[strip[0] for strip in strips.values()]], list(strips), [""], scale=bool(depths))
    else:
        rows = [list(strip) for strip in strips.values()]
        figure = _grid(rows, [""] * longest, list(strips), scale=bool(depths))
    if depths:
        _depth_legend(figure, near, far)
    return to_png(figure)


def draw_sheet(rows: Mapping[str, Sequence[Real[np.ndarray, "_ _ 3"]]], titles: Sequence[str]) -> bytes:
    """PNG of colour pictures (H, W, 3), uint8 or in [0, 1], one named row each; `titles` of the columns."""
    return to_png(_grid([list(_to_rgb(np.stack(row))) for row in rows.values()], list(titles), list(rows)))


def draw_curve(points: Sequence[tuple[int, float]], title: str, x_label: str, unit: str) -> bytes:
    """PNG of one curve of (step, value) points, to be read on a telephone.

    Args:
      points: in the order of their steps.
      title: the curve's name.
      x_label: what a step is.
      unit: of the values; "%" of shares, which are drawn times 100.
    """
    figure = Figure(figsize=(3.6, 2.4))
    axes = figure.add_axes(CURVE_BOX)  # a layout that looks for its margins doubles the time, of 37 in a run
    steps, values = zip(*points, strict=True)
    factor = 100.0 if unit == "%" else 1.0
    axes.plot(steps, [factor * v for v in values], linewidth=1.4, marker="." if len(points) < 3 else "")
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x_label, fontsize=9)
    axes.set_ylabel(unit or "no unit", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.locator_params(nbins=5)
    axes.ticklabel_format(axis="y", scilimits=(-2, 5))  # what is longer has no room beside the axis
    for axis in (axes.xaxis, axes.yaxis):
        axis.get_offset_text().set_fontsize(8)
    axes.grid(alpha=0.3)
    return to_png(figure)


def _as_frames(panel: np.ndarray) -> np.ndarray:
    """(T, H, W, 3) RGB or (T, H, W) depth."""
    panel = np.asarray(panel)
    is_rgb = panel.ndim >= 3 and panel.shape[-1] == 3
    if panel.ndim not in ((3, 4) if is_rgb else (2, 3)):
        raise ValueError(f"picture panel of shape {panel.shape}; expected (T,) (H, W) depth or (H, W, 3) RGB")
    single = 3 if is_rgb else 2
    return panel[None] if panel.ndim == single else panel


def _thin(strip: np.ndarray) -> np.ndarray:
    """At most MAX_FRAMES of a film, evenly spread, first and last included."""
    if len(strip) <= MAX_FRAMES:
        return strip
    return strip[np.linspace(0, len(strip) - 1, MAX_FRAMES).round().astype(int)]


def _to_rgb(frames: np.ndarray) -> np.ndarray:
    return frames / 255.0 if frames.dtype == np.uint8 else np.clip(frames, 0.0, 1.0)


def _grid(rows: list[list[np.ndarray]], titles: list[str], labels: list[str], scale: bool = False) -> Figure:
    """Named rows of pictures below their titles; `scale`: with room for `_depth_legend` on the right.

    Margins are fixed: a layout that looks for them takes longer than the drawing.
    """
    columns = max(len(row) for row in rows)
    height, width = rows[0][0].shape[:2]
    panel_in = max(1.3, min(3.4, 13.0 / columns))
    high_in = panel_in * height / width
    labels = [textwrap.fill(label, max(1, int(high_in / LETTER_IN))) for label in labels]
    lines = max(label.count("\n") + 1 if label else 0 for label in labels)
    left_in, right_in = GAP_IN + LINE_IN * lines, SCALE_IN if scale else GAP_IN
    size_in = (
        left_in + (panel_in + GAP_IN) * columns - GAP_IN + right_in,
        max(SCALE_HIGH_IN if scale else 0.0, TITLE_IN + (high_in + GAP_IN) * len(rows)),
    )
    figure = Figure(figsize=size_in)
    margins = {
        "left": left_in / size_in[0],
        "right": 1.0 - right_in / size_in[0],
        "bottom": GAP_IN / size_in[1],
        "top": 1.0 - TITLE_IN / size_in[1],
        "wspace": GAP_IN / panel_in,
        "hspace": GAP_IN / high_in,
    }
    panels = figure.subplots(len(rows), columns, squeeze=False, gridspec_kw=margins)
    for r, row in enumerate(rows):
        for c, axes in enumerate(panels[r]):
            if c >= len(row):
                axes.set_axis_off()
                continue
            axes.imshow(row[c], interpolation="nearest")
            axes.set_xticks([])
            axes.set_yticks([])
            axes.set_title(titles[c] if r == 0 else "", fontsize=9)
            axes.set_ylabel(labels[r] if c == 0 else "", fontsize=9)
    return figure


def _depth_legend(figure: Figure, near_m: float, far_m: float) -> None:
    """A scale of depth, and what no depth is drawn in, right of a `_grid` that left room for it."""
    width_in, height_in = figure.get_size_inches()
    left, wide = 1.0 - (SCALE_IN - 0.15) / width_in, 0.12 / width_in
    box = (left, 0.5 / height_in, wide, 1.0 - (0.5 + TITLE_IN) / height_in)
    bar = figure.colorbar(ScalarMappable(Normalize(near_m, far_m), DEPTH_COLORS), cax=figure.add_axes(box))
    bar.set_label("depth (m)", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    red, green, blue = (level / 255 for level in INVALID_RGB)
    figure.legend(
        handles=[Patch(color=(red, green, blue), label="no depth")],
        loc="lower right", fontsize=8, frameon=False, borderpad=0.0, handlelength=1.0,
    )  # fmt: skip
