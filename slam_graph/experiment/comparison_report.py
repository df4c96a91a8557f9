# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The report of an experiment: Markdown, HTML with its pictures in it, and the table as JSON."""

from __future__ import annotations

import base64
import json
from html import escape
from pathlib import Path

from slam_graph.experiment.comparison import Comparison
from slam_graph.experiment.comparison_figures import Figure, draw
from slam_graph.experiment.comparison_results import ALIGNMENTS, Table
from slam_graph.experiment.comparison_summary import summarize
from slam_graph.results.metrics import finite, versions
from slam_graph.results.result_files import write_text

COLUMNS = (
    "algorithm",
    *(f"ATE {mode} [m]" for mode in ALIGNMENTS),
    "orientation [deg]",
    "NEES orientation",
    "NEES position",
    "NEES pose",
    "NIS / expected",
    "gated",
    "steps",
    "ms a frame",
    "first → last third",
    "peak MB",
    "status",
)

EXPLANATION = (
    "All algorithms were given the same recorded feature tracks and IMU samples. "
    "ATE is the root mean square of the position error of the causal estimate after no alignment, "
    "after alignment of yaw and position, and of the whole pose; orientation is after alignment "
    "of yaw and position. A NEES should be 3, that of the whole pose 6. NIS / expected, of the "
    "innovations of the images that passed the gate, should be 1; gated is the share that did not. "
    "Numbers are means over the seeds whose runs ended "
    "well; peak memory is the largest. Steps are those of Gauss-Newton a frame, without those that "
    "damping took back. Milliseconds are those of the back end, and the arrow goes "
    "from the median of the first third of the frames to that of the last: a growing cost shows "
    "there."
)

STYLE = (
    "body{font-family:sans-serif;max-width:75em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse}"
    "td,th{border:1px solid #bbb;padding:.25em .6em;text-align:right}"
    "td:first-child,th:first-child,td:last-child{text-align:left}img{max-width:100%}"
)


def write_report(comparison: Comparison) -> tuple[list[Table], list[Path]]:
    """Write the report of what has been done so far.

    Returns:
        The rows of the table, and the files.
    """
    rows = finite(summarize(comparison))
    names = dict.fromkeys(task.data for task in comparison.runs)
    figures = {name: list(draw(comparison, name)) for name in names}
    folder = comparison.folder
    files = [folder / name for name in ("report.md", "report.html", "summary.json")]
    write_text(files[0], [_markdown(comparison, rows, figures)])
    write_text(files[1], [_html(comparison, rows, figures)])
    table = {"rows": rows, "failures": comparison.failures, "versions": versions()}
    write_text(files[2], [json.dumps(table, indent=1, allow_nan=False), "\n"])
    return rows, files


def cells(row: Table) -> tuple[str, ...]:
    """A row of the table as text, in the order of `COLUMNS`."""
    status = ", ".join(f"{count} {name}" for name, count in row["status"].items())
    ends = f"{_number(row['ms_first_third'], 2)} → {_number(row['ms_last_third'], 2)}"
    return (
        row["algorithm"],
        *(_number(row["ate_m"][mode], 4) for mode in ALIGNMENTS),
        _number(row["orientation_deg"]["yaw"], 3),
        _number(row["nees"]["orientation"], 2),
        _number(row["nees"]["position"], 2),
        _number(row["nees"]["pose"], 2),
        _number(_ratio(row["nis"]["mean"], row["nis"]["expected_mean"]), 2),
        _number(row["nis"]["rejected"], 3),
        _number(row["steps"], 2),
        _number(row["ms_per_frame"], 2),
        ends,
        _number(row["peak_memory_mb"], 0),
        status,
    )


def _markdown(comparison: Comparison, rows: list[Table], figures: dict[str, list[Figure]]) -> str:
    lines = ["# Comparison of algorithms", "", EXPLANATION, ""]
    for name, drawn in figures.items():
        lines += [f"## {name}", "", _markdown_line(COLUMNS)]
        lines += [_markdown_line(("---",) + ("---:",) * (len(COLUMNS) - 2) + ("---",))]
        lines += [_markdown_line(cells(row)) for row in rows if row["data"] == name]
        lines.append("")
        for figure in drawn:
            lines += [f"![{figure.title}]({figure.file.relative_to(comparison.folder)})", ""]
    if comparison.failures:
        lines += ["## What could not be done", ""]
        lines += [f"- {name}: {reason}" for name, reason in comparison.failures.items()]
    return "\n".join(lines).rstrip() + "\n"


def _markdown_line(values: tuple[str, ...]) -> str:
    return "| " + " | ".join(values) + " |"


def _html(comparison: Comparison, rows: list[Table], figures: dict[str, list[Figure]]) -> str:
    title = "Comparison of algorithms"
    parts = [
        "<!DOCTYPE html>",
        f'<html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>',
        f"<h1>{title}</h1><p>{escape(EXPLANATION)}</p>",
    ]
    for name, drawn in figures.items():
        parts += [f"<h2>{escape(name)}</h2><table>", _html_line("th", COLUMNS)]
        parts += [_html_line("td", cells(row)) for row in rows if row["data"] == name]
        parts.append("</table>")
        for figure in drawn:
            data = base64.b64encode(figure.file.read_bytes()).decode("ascii")
            text = escape(figure.title, quote=True)
            parts.append(f'<p><img alt="{text}" src="data:image/png;base64,{data}"></p>')
    if comparison.failures:
        parts.append("<h2>What could not be done</h2><ul>")
        failures = comparison.failures.items()
        parts += [f"<li>{escape(name)}: {escape(reason)}</li>" for name, reason in failures]
        parts.append("</ul>")
    return "\n".join([*parts, "</html>", ""])


def _html_line(tag: str, values: tuple[str, ...]) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(value)}</{tag}>" for value in values) + "</tr>"


def _ratio(value: float | None, unit: float | None) -> float | None:
    return None if value is None or unit is None else value / unit


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
