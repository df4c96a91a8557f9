# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The report of a comparison: a table with a row for each algorithm on each data set, and figures.

It is written as Markdown, as one HTML file with the figures in it, and the table as JSON.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable, Iterable
from html import escape
from typing import Any

import numpy as np

from slam_graph.experiment.comparison_figures import Figure, draw
from slam_graph.experiment.comparison_plan import Comparison
from slam_graph.experiment.comparison_results import (
    ALIGNMENTS,
    STAGE,
    Table,
    alignment_of,
    numbers,
    read_result,
    read_series,
)
from slam_graph.experiment.tasks import RunTask
from slam_graph.results import ResultFolder

_COLUMNS = (
    "algorithm",
    "ATE [m]",
    *(f"ATE {mode} [m]" for mode in ALIGNMENTS),
    "orientation [deg]",
    "aligned in",
    "ATE world of fixes [m]",
    "orientation world of fixes [deg]",
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

_EXPLANATION = (
    "All algorithms were given the same recorded feature tracks and samples. ATE is the root mean "
    "square position error of the causal estimate. It and the orientation are taken after the "
    "alignment that is named, of what nothing measured: yaw and position with an IMU, SE(3) "
    "without one, scale too with one camera alone; other columns have other alignments. Errors in "
    "the world of the fixes are without any alignment, of runs that ended in that world, where the "
    "truth is in it too. The ideal "
    "NEES is 3, for the pose 6. The ideal NIS / expected, over the innovations that passed the "
    "gate, is 1; gated is the share that did not pass. Steps are accepted Gauss-Newton steps per "
    "frame. Milliseconds are those of the back end per frame; the column after gives their median "
    "in the first and last third of the frames, between which a growing cost shows. Numbers are "
    "means over the seeds whose runs have status ok; peak memory is the maximum. Columns without a "
    "number are left out."
)

_STYLE = (
    "body{font-family:sans-serif;max-width:75em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse}"
    "td,th{border:1px solid #bbb;padding:.25em .6em;text-align:right}"
    "td:first-child,th:first-child,td:last-child{text-align:left}img{max-width:100%}"
)


def write_report(comparison: Comparison) -> None:
    """Write the report of the tasks done so far, and fill `rows`, `table` and `files` of it."""
    rows = _summarize(comparison)
    names = dict.fromkeys(task.data for task in comparison.runs)
    figures = {name: list(draw(comparison, name)) for name in names}
    folder = ResultFolder(comparison.folder)
    folder.text("report.md", [_markdown(comparison, rows, figures)])
    folder.text("report.html", [_html(comparison, rows, figures)])
    folder.json(
        "summary.json",
        {
            "rows": rows,
            "runs": _runs_done(comparison),
            "failures": comparison.failures,
            "versions": _versions(comparison),
        },
    )
    cells = [(str(row["data"]), *_cells(row)) for row in rows]
    comparison.rows, comparison.table = rows, [("data", *_COLUMNS), *cells]
    comparison.files = folder.files


def _runs_done(comparison: Comparison) -> list[str]:
    """The results that the report is of, without suffix and relative to its folder.

    Those of earlier comparisons may lie beside them.
    """
    done = (task.result for task in comparison.runs if task.is_done())
    return [path.relative_to(comparison.folder).with_suffix("").as_posix() for path in done]


def _versions(comparison: Comparison) -> dict[str, str]:
    """Versions of what the first run that was done depends on."""
    results = (read_result(task.result) for task in comparison.runs if task.is_done())
    found = (result["metrics"] for result in results if result is not None)
    return next((metrics.get("versions", {}) for metrics in found), {})


def _cells(row: Table) -> tuple[str, ...]:
    """A row of the table as text, in the order of `_COLUMNS`."""
    status = ", ".join(f"{count} {name}" for name, count in row["status"].items())
    ends = f"{_number(row['ms_first_third'], 2)} → {_number(row['ms_last_third'], 2)}"
    return (
        row["algorithm"],
        _number(row["ate_m"][row["alignment"]], 4),
        *(_number(row["ate_m"][mode], 4) for mode in ALIGNMENTS),
        _number(row["orientation_deg"][row["alignment"]], 3),
        "-" if row["ate_m"][row["alignment"]] is None else row["alignment"],
        _number(row["in_world_of_fixes"]["ate_m"], 4),
        _number(row["in_world_of_fixes"]["orientation_deg"], 3),
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


def _summarize(comparison: Comparison) -> list[Table]:
    """A row for each algorithm and data set, in the order of the plan.

    Errors, NEES and times are means over the runs with status `ok`; peak memory is the largest.
    """
    groups: dict[tuple[str, str], list[RunTask]] = {}
    for task in comparison.runs:
        groups.setdefault((task.data, task.algorithm), []).append(task)
    return [_row(data, algorithm, tasks) for (data, algorithm), tasks in groups.items()]


def _row(data: str, algorithm: str, tasks: list[RunTask]) -> Table:
    found = [(task, read_result(task.result)) for task in tasks if task.is_done()]
    results = [result for _, result in found if result is not None]
    statuses = Counter(result["metrics"]["status"] for result in results)
    statuses["not_done"] = len(tasks) - len(results)
    good = [result["metrics"] for result in results if result["metrics"]["status"] == "ok"]
    ends = [_cost_at_ends(task) for task, result in found if result is not None]
    return {
        "data": data,
        "algorithm": algorithm,
        "seeds": len(tasks),
        "status": dict(+statuses),
        "alignment": alignment_of(good[0]) if good else "yaw",
        "ate_m": {mode: _mean(good, _ate(mode, "translation_m")) for mode in ALIGNMENTS},
        "orientation_deg": {mode: _mean(good, _ate(mode, "rotation_deg")) for mode in ALIGNMENTS},
        "in_world_of_fixes": {
            name: _mean([m for m in good if m.get("world", {}).get("of_truth")], _ate("none", part))
            for name, part in (("ate_m", "translation_m"), ("orientation_deg", "rotation_deg"))
        },
        "nees": {
            part: _mean(good, lambda m, part=part: m["nees"][part]["mean"])  # type: ignore[misc]
            for part in ("orientation", "position", "pose")
        },
        "nis": {
            part: _mean(good, lambda m, part=part: m["nis"][part])  # type: ignore[misc]
            for part in ("mean", "expected_mean", "mean_before_gate", "inside_bounds", "rejected")
        },
        "steps": _average(r["mean_steps"] for r in results if r["mean_steps"] is not None),
        "ms_per_frame": _mean(good, lambda m: m["timing"]["stages"][STAGE]["mean_ms"]),
        "ms_first_third": _average(first for first, _ in ends),
        "ms_last_third": _average(last for _, last in ends),
        "peak_memory_mb": max(
            (r["metrics"]["peak_memory_mb"] or 0.0 for r in results), default=None
        ),
    }


def _cost_at_ends(task: RunTask) -> tuple[float, float]:
    """Median milliseconds per frame of the first and of the last third of the estimated frames."""
    series = read_series(task.result)
    values = series.get(f"ms_{STAGE}", np.zeros(0))
    values = values[np.isfinite(series.get("ms_backend.gauss_newton", values))]
    third = len(values) // 3
    if third == 0:
        return np.nan, np.nan
    return float(np.median(values[:third])), float(np.median(values[-third:]))


def _ate(mode: str, part: str) -> Callable[[Table], Any]:
    return lambda metrics: metrics["accuracy"][mode]["ate"][part]["rmse"]


def _mean(metrics: list[Table], get: Callable[[Table], Any]) -> float | None:
    """Mean over the runs that have the number."""
    return _average(numbers(metrics, get))


def _average(values: Iterable[float]) -> float | None:
    """Mean of the finite values, or None."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else None


def _table_of(rows: list[Table], name: str) -> list[tuple[str, ...]]:
    """Titles and rows of one data set, without the columns that have no number there."""
    cells = [_COLUMNS, *(_cells(row) for row in rows if row["data"] == name)]
    columns = [column for column in zip(*cells, strict=True) if set(column[1:]) != {"-"}]
    return list(zip(*columns, strict=True))


def _markdown(comparison: Comparison, rows: list[Table], figures: dict[str, list[Figure]]) -> str:
    lines = ["# Comparison of algorithms", "", _EXPLANATION, ""]
    for name, drawn in figures.items():
        titles, *cells = _table_of(rows, name)
        lines += [f"## {name}", "", _markdown_line(titles)]
        lines += [_markdown_line(("---",) + ("---:",) * (len(titles) - 2) + ("---",))]
        lines += map(_markdown_line, cells)
        lines.append("")
        for figure in drawn:
            lines += [f"![{figure.title}]({figure.file.relative_to(comparison.folder)})", ""]
    if comparison.failures:
        lines += ["## Failed tasks", ""]
        lines += [f"- {name}: {reason}" for name, reason in comparison.failures.items()]
    return "\n".join(lines).rstrip() + "\n"


def _markdown_line(values: tuple[str, ...]) -> str:
    return "| " + " | ".join(values) + " |"


def _html(comparison: Comparison, rows: list[Table], figures: dict[str, list[Figure]]) -> str:
    title = "Comparison of algorithms"
    parts = [
        "<!DOCTYPE html>",
        f'<html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>',
        f"<h1>{title}</h1><p>{escape(_EXPLANATION)}</p>",
    ]
    for name, drawn in figures.items():
        titles, *cells = _table_of(rows, name)
        parts += [f"<h2>{escape(name)}</h2><table>", _html_line("th", titles)]
        parts += [_html_line("td", row) for row in cells]
        parts.append("</table>")
        for figure in drawn:
            data = base64.b64encode(figure.file.read_bytes()).decode("ascii")
            text = escape(figure.title, quote=True)
            parts.append(f'<p><img alt="{text}" src="data:image/png;base64,{data}"></p>')
    if comparison.failures:
        parts.append("<h2>Failed tasks</h2><ul>")
        failures = comparison.failures.items()
        parts += [f"<li>{escape(name)}: {escape(reason)}</li>" for name, reason in failures]
        parts.append("</ul>")
    return "\n".join([*parts, "</html>", ""])


def _html_line(tag: str, values: tuple[str, ...]) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(value)}</{tag}>" for value in values) + "</tr>"


def _ratio(value: float | None, unit: float | None) -> float | None:
    return None if value is None or not unit else value / unit


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
