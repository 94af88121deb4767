"""study.html, study.png and what the terminal shows of a study."""

from collections.abc import Mapping
from html import escape
from typing import Any

from evaluation import wilson
from evaluation.failure_modes import MODES, NOTE
from evaluation.paired import describe_p
from evaluation.report import success_chart
from evaluation.report.html import image, page, table
from evaluation.rig_trials import STEREO, describe_stereo
from evaluation.table2.results import describe_set
from evaluation.table2.rows import DEPLOYED, ROWS, TABLES, TRAINING

_COLUMNS = (
    "row", "training depth", "depth of the policy", "in simulation, own depth", "seen", "unseen", "all",
    "reference alone / row alone", "p", "p (Holm)",
)  # fmt: skip
_GROUPS = ("seen", "unseen", "all")


def table_rows(study: Mapping[str, Any], set_of_trials: str, name: str) -> list[tuple[str, ...]]:
    """The lines of one table for one set of trials, cells as in `_COLUMNS`; "" where nothing is known."""
    of = study["sets"][set_of_trials]
    tests = {test["row"]: test for test in of["tables"][name]}
    return [_line(study, of["rows"].get(row), row, tests.get(row)) for row in TABLES[name].rows]


def _line(
    study: Mapping[str, Any], tried: Mapping[str, Any] | None, name: str, test: Mapping[str, Any] | None
) -> tuple[str, ...]:
    row = ROWS[name]
    made = study["rows"].get(name, {})
    simulated = made.get("student", {}).get("simulation", {}).get("own", {})
    source = f" ({made['generator_from']})" if made.get("generator_from") else ""
    source += f", {made['ellipses']:g} elliptic holes a picture" if made.get("ellipses") else ""
    rig = ("not tried", "", "") if tried is None else tuple(_rate(tried.get(group)) for group in _GROUPS)
    pairs = f"{test['only_reference']} / {test['only_row']} of {test['n']}" if test else ""
    p_values = (describe_p(test["p"]), describe_p(test["p_holm"])) if test else ("", "")
    own = _rate(simulated.get("success"))
    return (row.title, f"{TRAINING[row.source]}{source}", DEPLOYED[row.depth], own, *rig, pairs, *p_values)


def _rate(success: Mapping[str, Any] | None) -> str:
    return wilson.describe(dict(success)) if success else ""


def apart(study: Mapping[str, Any], set_of_trials: str, name: str) -> list[str]:
    """A sentence for each row that one table for one set of trials does not compare, and why."""
    return [
        f"{ROWS[row['row']].title} was tried otherwise than {ROWS[row['against']].title} and is not compared "
        f"with it: {', '.join(row['differs'])}."
        for row in study["sets"][set_of_trials]["apart"][name]
    ]


def object_rows(study: Mapping[str, Any], set_of_trials: str) -> tuple[list[str], list[list[str]]]:
    """(objects, lines) of successes by object: title, then "k of n" per object."""
    tried = study["sets"][set_of_trials]["rows"]
    names = success_chart.objects(tried)
    return names, [
        [ROWS[row].title, *(_count(made["objects"].get(name)) for name in names)]
        for row, made in tried.items()
    ]


def mode_rows(study: Mapping[str, Any], set_of_trials: str) -> list[list[str]]:
    """(title, failed trials of each of `failure_modes.MODES`) of every row tried; "" for none."""
    return [
        [ROWS[row].title, *(str(sum(made["failures"].get(how, {}).values()) or "") for how in MODES)]
        for row, made in study["sets"][set_of_trials]["rows"].items()
    ]


def _count(success: Mapping[str, Any] | None) -> str:
    return f"{success['successes']} of {success['n']}" if success else ""


def render(study: Mapping[str, Any], picture: bytes) -> str:
    """The page: one file with every set of trials, tables and picture."""
    title = f"Table II: what training depth does to grasping, preset {escape(str(study['preset']))}"
    body = [
        f"<h1>{title}</h1>",
        "<p class=note>Success: rate of n trials, Wilson 95 % interval. p: McNemar's exact test on the same "
        "trials (seed, object, camera), two-sided, against the table's reference; Holm: corrected for all "
        "rows of the table that were tried as the reference was. Both rigs are simulated; no real robot was "
        "used. "
        f"{escape(study['created'])}, {escape(study['machine']['processor'])}.</p>",
        *(
            f"<p>{escape(ROWS[row].title)} left out: {escape(why)}</p>"
            for row, why in study["left_out"].items()
        ),
    ]
    for name in study["sets"]:
        trials = study["sets"][name]["trials"]
        tables = ", each before a table of its own" if trials.get("camera") == "other_tables" else ""
        set_to = f", {describe_stereo(trials[STEREO])}" if STEREO in trials else ""
        body.append(f"<h2>Trials: {escape(describe_set(name) + tables + set_to)}</h2>")
        for key in _begun(study["sets"][name]["rows"]):
            of = TABLES[key]
            body.append(f"<h3>{of.title}, reference {ROWS[of.reference].title}</h3>")
            body.append(table(_COLUMNS, table_rows(study, name, key)))
            body += [f"<p class=missed>{escape(line)}</p>" for line in apart(study, name, key)]
        objects, lines = object_rows(study, name)
        body.append("<h3>By object</h3>" + table(["row", *objects], lines))
        body.append(f"<h3>Failures by mode</h3><p class=note>{NOTE}</p>")
        body.append(table(["row", *MODES], mode_rows(study, name)))
    if study["sets"]:
        body.append(image(picture, "success with intervals, and by object"))
    return page(title, body)


def describe(study: Mapping[str, Any], set_of_trials: str) -> str:
    """One set's tables as text, of the rows that were tried."""
    lines = []
    for name in _begun(study["sets"][set_of_trials]["rows"]):
        of = TABLES[name]
        lines.append(f"{of.title} ({set_of_trials}; reference: {ROWS[of.reference].title})")
        for line in table_rows(study, set_of_trials, name):
            if line[4] != "not tried":
                p = f"p (Holm) {line[9]}" if line[9] else ""
                lines.append(f"  {line[0]:<36} {line[6]:<36} {line[7]:<18} {p}".rstrip())
        lines += [f"  {line}" for line in apart(study, set_of_trials, name)]
    return "\n".join(lines)


def _begun(tried: Mapping[str, Any]) -> list[str]:
    """Tables of which a row was tried that no table before them has."""
    names, seen = [], set()
    for name, of in TABLES.items():
        if any(row in tried for row in of.rows if row not in seen):
            names.append(name)
        seen |= set(of.rows)
    return names


def draw(study: Mapping[str, Any]) -> bytes:
    """PNG: per set of trials, success of every row tried with its interval, and by object."""
    tried = {name: of["rows"] for name, of in study["sets"].items()}
    return success_chart.draw(
        {name: {ROWS[row].title: made for row, made in rows.items()} for name, rows in tried.items()}
    )
