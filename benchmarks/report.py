# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Results for people and for programs: an aligned table, Markdown, and JSON."""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.baseline import Baseline, value_of
from benchmarks.metric import Metric
from benchmarks.suite import Outcome
from slam_graph.results.metrics import versions

SCHEMA_VERSION = 2

HEADER = ("figure", "value", "unit", "bar", "verdict", "baseline", "change")

HELD_OUT = "held out of every choice:"
"""Before the figures that were measured where no parameter was chosen (`benchmarks.recordings`)."""

Results = Mapping[str, Outcome]
"""What each benchmark found, by its name, in the order of running."""


def lines(results: Results, baseline: Baseline) -> Iterator[str]:
    """An aligned table of all benchmarks, each followed by its notes."""
    tables = {
        (name, held_out): rows(name, metrics, baseline)
        for name, outcome in results.items()
        for held_out, metrics in parted(outcome)
    }
    everything = [HEADER, *(row for table in tables.values() for row in table)]
    widths = [max(len(row[column]) for row in everything) for column in range(len(HEADER))]

    def aligned(row: tuple[str, ...]) -> str:
        pairs = zip(row, widths, range(len(row)), strict=True)
        cells = (cell.rjust(w) if k in (1, 5, 6) else cell.ljust(w) for cell, w, k in pairs)
        return "  ".join(cells).rstrip()

    yield aligned(HEADER)
    for name, outcome in results.items():
        yield ""
        yield name
        for held_out, _ in parted(outcome):
            if held_out:
                yield HELD_OUT
            yield from map(aligned, tables[name, held_out])
        yield from (f"  note: {note}" for note in remarks(outcome))


def markdown(results: Results, baseline: Baseline) -> Iterator[str]:
    """The same for a page of the docs, a table for each benchmark."""
    for name, outcome in results.items():
        yield f"### {name}"
        yield ""
        for held_out, metrics in parted(outcome):
            if held_out:
                yield from (HELD_OUT, "")
            yield "| " + " | ".join(HEADER) + " |"
            yield "|---|---:|---|---|---|---:|---:|"
            for row in rows(name, metrics, baseline):
                yield "| " + " | ".join(cell.strip() for cell in row) + " |"
            yield ""
        yield from (f"- {note}" for note in remarks(outcome))
        if remarks(outcome):
            yield ""


def measured(results: Results) -> list[Metric]:
    """All figures, with the names of their benchmarks before their own."""
    return [metric.under(name) for name, outcome in results.items() for metric in outcome.metrics]


def texts(results: Results) -> dict[str, str]:
    """What runs said, by keys with the names of their benchmarks."""
    return {
        f"{name}.{key}": text
        for name, outcome in results.items()
        for key, text in outcome.texts.items()
    }


def table(results: Results) -> dict[str, Any]:
    """All that was measured, as JSON can hold it."""
    return {
        "schema_version": SCHEMA_VERSION,
        "versions": versions(),
        "machine": {"architecture": platform.machine(), "cores": os.cpu_count()},
        "benchmarks": {
            name: {
                "metrics": [metric.under(name).to_table() for metric in outcome.metrics],
                "notes": remarks(outcome),
                "texts": texts({name: outcome}),
            }
            for name, outcome in results.items()
        },
    }


def remarks(outcome: Outcome) -> list[str]:
    """What is to be said beside the figures."""
    return [f"FAILED: {outcome.failure}", *outcome.notes] if outcome.failure else outcome.notes


def parted(outcome: Outcome) -> list[tuple[bool, list[Metric]]]:
    """The figures on what parameters were chosen on, then those on what is held out, if any."""
    parts = [(held, [m for m in outcome.metrics if m.held_out is held]) for held in (False, True)]
    return [part for part in parts if part[1]]


def rows(name: str, metrics: Sequence[Metric], baseline: Baseline) -> list[tuple[str, ...]]:
    """The cells of the table of figures of a benchmark."""
    return [_row(metric, value_of(baseline, f"{name}.{metric.key}")) for metric in metrics]


def _row(metric: Metric, before: float | None) -> tuple[str, ...]:
    verdict = {True: "ok", False: "MISSED", None: ""}[metric.meets_bar]
    change = ""
    if before is not None:
        share = metric.change_from(before)
        change = "" if math.isnan(share) else f"{share:+.1%}"
        if metric.worse_than(before):
            verdict = f"{verdict} WORSE".strip()
    return (
        f"  {metric.key}",
        number(metric.value),
        metric.unit,
        bar_text(metric),
        verdict,
        "" if before is None else number(before),
        change,
    )


def number(value: float) -> str:
    """A value with four significant digits; a dash for what could not be measured."""
    return f"{value:.4g}" if math.isfinite(value) else "-"


def bar_text(metric: Metric) -> str:
    """The bar as a condition on the value."""
    if metric.bar is None:
        return ""
    if isinstance(metric.bar, tuple):
        return f"{metric.bar[0]:g} … {metric.bar[1]:g}"
    return f"{'≤' if metric.direction == 'lower' else '≥'} {metric.bar:g}"
