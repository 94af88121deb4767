"""What the pages of a report are made of: one file with everything in it, to be opened or sent by mail."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from evaluation import wilson
from evaluation.report.meanings import explain, show
from evaluation.report.targets import MET, MISSED, Target, verdict

REPORT_HTML = "report.html"
_QUALITY = 75
"""The films' WebP takes a sixth of the PNG files that they are made from."""
_WEBP_MOST_PX = 16_383
"""A side of a WebP picture (RFC 9649: 14 bits)."""

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }
body { color: #1b1f24; background: #fff; overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #d5d9de; }
h3 { font-size: 1rem; margin-bottom: .3rem; }
table { border-collapse: collapse; margin: .6rem 0; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; overflow-wrap: normal; }
th, td { text-align: left; padding: .2rem .9rem .2rem 0; vertical-align: top; }
tr { border-bottom: 1px solid #eceef1; }
tr.last td, .verdict { font-weight: 600; }
td.met { color: #116329; } .missed { color: #b42318; font-weight: 600; }
nav a { margin-right: .9rem; white-space: nowrap; } a { color: #0550ae; }
img { max-width: 100%; display: block; margin: .5rem 0; }
.film img { max-width: none; width: max(100%, 60rem); }
.curves { display: grid; grid-template-columns: repeat(auto-fill, minmax(16rem, 1fr)); gap: .5rem 1rem; }
.curves p { margin: 0; font-size: 13px; }
@media (max-width: 40rem) { th, td { padding-right: .5rem; font-size: 13px; } body { margin: 1rem auto; } }
.note { color: #57606a; } details { margin: .5rem 0; } pre { overflow: auto; font-size: 12px; }
"""


def page(title: str, body: Sequence[str]) -> str:
    """An HTML document with the report's style; `title` and `body` are HTML already."""
    phone = '<meta name=viewport content="width=device-width, initial-scale=1">'
    icon = '<link rel=icon href="data:,">'  # none: a browser would ask for one
    head = f"<meta charset=utf-8>{phone}{icon}<title>{title}</title><style>{_STYLE}</style>"
    lines = "\n".join(body)
    return f"<!doctype html><html lang=en><head>{head}</head><body>\n{lines}\n</body></html>\n"


def heading(title: str) -> str:
    """A section's heading, which `contents` links to."""
    return f'<h2 id="{_anchor(title)}">{escape(title)}</h2>'


def contents(titles: Sequence[str]) -> str:
    """Links to the sections of those `heading`s."""
    links = (f'<a href="#{_anchor(title)}">{escape(title)}</a>' for title in titles)
    return f"<nav aria-label=Contents>{' '.join(links)}</nav>"


def judgement(judged: Sequence[Target]) -> list[str]:
    """The verdict, and the table of targets, missed ones in red."""
    rows = "".join(
        f"<tr><td>{escape(t['target'])}<td>{escape(t['measured'])}<td class={_mark(t['met'])}>{t['met']}</tr>"
        for t in judged
    )
    return [
        f"<p class=verdict>{escape(verdict(judged))}</p>",
        f"<div class=wide><table><tr><th>Target<th>Measured<th></tr>{rows}</table></div>",
    ]


def image(data: bytes, alt: str, kind: str = "png") -> str:
    """An image element with the picture in it."""
    return f'<img alt="{escape(alt)}" src="data:image/{kind};base64,{base64.b64encode(data).decode()}">'


def film(data: bytes, alt: str, kind: str = "png") -> str:
    """A film strip, which a narrow screen scrolls instead of shrinking it."""
    return f'<div class="wide film">{image(data, alt, kind)}</div>'


def film_file(strip: Path, alt: str) -> str:
    """`film` of a PNG on disk, smaller; a line where it is no whole one."""
    import cv2

    from sensors.recordings.pictures import decoded

    # OpenCV is given no names: one that is no UTF-8 ends the process.
    stored = strip.read_bytes() if strip.is_file() else b""
    picture = decoded(stored)
    if picture is None:
        return f"<p>{escape(strip.name)} cannot be shown: it is no whole PNG.</p>"
    if max(picture.shape) > _WEBP_MOST_PX:
        return film(stored, alt)
    _, data = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    return film(data.tobytes(), alt, "webp")


def table(header: Sequence[str], rows: Sequence[Sequence[str]], last_bold: bool = False) -> str:
    """A table of plain text, which is escaped; too wide a one scrolls by itself."""
    head = "<tr>" + "".join(f"<th>{escape(title)}</th>" for title in header) + "</tr>" if header else ""
    lines = []
    for index, row in enumerate(rows):
        mark = " class=last" if last_bold and index == len(rows) - 1 else ""
        lines.append(f"<tr{mark}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    return f"<div class=wide><table>{head}{''.join(lines)}</table></div>"


def numbers(values: Mapping[str, Any], stage: str = "") -> str:
    """A table of nested numbers: name, value with its unit, what it means in `stage`."""
    rows = [(name, text, explain(f"{stage}.{name}")[1]) for name, text in flatten(values)]
    return table(("Number", "Value", "Meaning"), rows) if rows else ""


def records(rows: Sequence[Mapping[str, Any]], stage: str = "") -> str:
    """A table of objects, a column for each of their keys, and under it what the columns mean."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    cells = [
        [text(row.get(column, ""), explain(f"{stage}.{column}")[0]) for column in columns] for row in rows
    ]
    meanings = (f"{column}: {meaning}" for column in columns if (meaning := explain(f"{stage}.{column}")[1]))
    return table(columns, cells) + f"<p class=note>{escape('; '.join(meanings))}</p>"


def is_records(value: Any) -> bool:
    """Whether `value` is a list of objects, which is shown as a table."""
    return isinstance(value, list) and bool(value) and all(isinstance(item, Mapping) for item in value)


def flatten(value: Mapping[str, Any]) -> list[tuple[str, str]]:
    """`leaves` as people read them."""
    return [(name, text(item, explain(name)[0])) for name, item in leaves(value)]


def leaves(value: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """(dotted name, value) of every number and text in nested objects; a success rate is one line, and lists
    of objects, which are tables, are left out."""
    lines = []
    for key, item in value.items():
        name = f"{prefix}{key}"
        if is_records(item):
            continue
        if isinstance(item, Mapping) and not _is_success(item):
            lines.extend(leaves(item, f"{name}."))
        else:
            lines.append((name, item))
    return lines


def text(value: Any, unit: str = "") -> str:
    """A value as people read it: a success rate with its interval, a number with its unit."""
    if _is_success(value):
        return wilson.describe(value)
    if isinstance(value, list):
        return ", ".join(text(item, unit) for item in value)
    return show(value, unit)


def _is_success(value: Any) -> bool:
    return isinstance(value, Mapping) and {"rate", "n", "low", "high"} <= value.keys()


def _mark(met: str) -> str:
    return {MET: "met", MISSED: "missed"}.get(met, "note")


def _anchor(title: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in title.lower())
