# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The baseline: all figures of the last measurement of each benchmark.

The gate compares with it, so that a figure does not get worse unnoticed; the tables of the
documents are written from it (`benchmarks.tables`), so that they say what was measured.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.metric import Metric
from slam_graph.errors import DataError
from slam_graph.results.metrics import versions

SCHEMA_VERSION = 2

OMITTED = ("bar", "held_out")
"""Fields that the file leaves out where a figure has none of it."""

BASELINE_FILE = Path(__file__).with_name("baseline.json")


@dataclass(frozen=True, slots=True)
class Record:
    """What one benchmark found when it was last measured for the baseline.

    Attributes:
        versions: of the packages that it was measured with; or a note of where it is from.
        metrics: figures by their full key.
        texts: what runs said, by full keys too.
    """

    versions: Mapping[str, str]
    metrics: Mapping[str, Metric]
    texts: Mapping[str, str] = field(default_factory=dict)


Baseline = Mapping[str, Record]
"""Records by the name of the benchmark."""


def read_baseline(path: Path = BASELINE_FILE) -> Baseline:
    """The records of a baseline; none if there is no such file yet.

    Raises:
        DataError: if the file is not a baseline of this schema.
    """
    if not path.is_file():
        return {}
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        if table["schema_version"] != SCHEMA_VERSION:
            raise DataError(
                f"{path}: schema version {table['schema_version']}, expected {SCHEMA_VERSION}; "
                "write it anew with --update-baseline"
            )
        return {
            name: Record(
                record["versions"],
                {key: Metric.from_table(key, row) for key, row in record["figures"].items()},
                record.get("texts", {}),
            )
            for name, record in table["benchmarks"].items()
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            f"{path}: not a baseline ({error}); write it anew with --update-baseline"
        ) from error


def updated(
    baseline: Baseline,
    metrics: Iterable[Metric],
    ran: Collection[str],
    texts: Mapping[str, str] | None = None,
) -> Baseline:
    """A baseline with the figures of the benchmarks that ran, and the others as they were.

    Args:
        baseline: the earlier records.
        metrics: what was measured.
        ran: names of the benchmarks that ran.
        texts: what their runs said, by full keys.
    """
    found: dict[str, dict[str, Metric]] = {name: {} for name in ran}
    for metric in metrics:
        found[benchmark_of(metric.key)][metric.key] = metric
    said: dict[str, dict[str, str]] = {name: {} for name in ran}
    for key, text in (texts or {}).items():
        said[benchmark_of(key)][key] = text
    made = {name: Record(versions(), rows, said[name]) for name, rows in found.items() if rows}
    return {**baseline, **made}


def write_baseline(baseline: Baseline, path: Path = BASELINE_FILE) -> None:
    """Write a baseline, four significant digits a value."""
    benchmarks = {
        name: {
            "versions": dict(record.versions),
            "figures": {key: _rounded(metric) for key, metric in record.metrics.items()},
            **({"texts": dict(record.texts)} if record.texts else {}),
        }
        for name, record in sorted(baseline.items())
    }
    table = {"schema_version": SCHEMA_VERSION, "benchmarks": benchmarks}
    text = json.dumps(table, indent=1)
    path.write_text(_one_line_a_figure(text) + "\n", encoding="utf-8")


def benchmark_of(key: str) -> str:
    """The name of the benchmark that a metric belongs to."""
    return key.partition(".")[0]


def value_of(baseline: Baseline, key: str) -> float | None:
    """The value of a figure; None if the baseline does not have it."""
    record = baseline.get(benchmark_of(key))
    metric = None if record is None else record.metrics.get(key)
    return None if metric is None else metric.value


def text_of(baseline: Baseline, key: str) -> str | None:
    """What a run said; None if the baseline does not have it."""
    record = baseline.get(benchmark_of(key))
    return None if record is None else record.texts.get(key)


def complaints(metrics: Iterable[Metric], baseline: Baseline, ran: Collection[str]) -> list[str]:
    """Why a gate stays shut: a line for each bar missed and each figure worse, new or gone.

    Args:
        metrics: what was measured.
        baseline: what was measured before.
        ran: names of the benchmarks that ran; the baseline of others is not looked at.
    """
    lines = []
    seen = set()
    for metric in metrics:
        seen.add(metric.key)
        if metric.meets_bar is False:
            lines.append(f"{metric.key} = {metric.value:.4g} {metric.unit} misses {metric.bar}")
        before = value_of(baseline, metric.key)
        if metric.has_baseline and before is None:
            lines.append(f"{metric.key} is not in the baseline; add it with --update-baseline")
        if before is not None and metric.worse_than(before):
            lines.append(
                f"{metric.key} = {metric.value:.4g} {metric.unit} is worse than the baseline's "
                f"{before:.4g} by more than {metric.tolerance or 0.0:.0%}"
            )
    gone = [key for key in _judged(baseline, ran) if key not in seen]
    return lines + [f"{key} is in the baseline but was not measured" for key in gone]


def _judged(baseline: Baseline, ran: Collection[str]) -> Iterator[str]:
    for name, record in baseline.items():
        if name in ran:
            yield from (key for key, metric in record.metrics.items() if metric.has_baseline)


def _rounded(metric: Metric) -> dict[str, Any]:
    """A metric as the file keeps it: its key is said before it, and its bar judges it anew."""
    row = metric.to_table()
    del row["key"], row["meets_bar"]
    row = {field: value for field, value in row.items() if value or field not in OMITTED}
    if math.isfinite(metric.value):
        row["value"] = _four_digits(metric.value)
    if isinstance(metric.bar, float):
        row["bar"] = _four_digits(metric.bar)
    return row


def _four_digits(value: float) -> float:
    return float(f"{value:.4g}")


def _one_line_a_figure(text: str) -> str:
    """Indented JSON with the innermost tables on one line, so that a change is one line too."""
    lines: list[str] = []
    for line in text.splitlines():
        depth = len(line) - len(line.lstrip())
        if depth > 4 or (depth == 4 and line.strip().rstrip(",") == "}"):
            joined = lines[-1].endswith(("{", "[")) or line.strip()[0] in "}]"
            lines[-1] += ("" if joined else " ") + line.strip()
        else:
            lines.append(line)
    return "\n".join(lines)
