# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The baseline: figures measured before, that must not get worse unnoticed."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from benchmarks.metric import Metric
from slam_graph.errors import DataError

SCHEMA_VERSION = 1

BASELINE_FILE = Path(__file__).with_name("baseline.json")

Baseline = Mapping[str, float]
"""Values by the key of their metric; NaN for what could not be measured."""


def read_baseline(path: Path = BASELINE_FILE) -> dict[str, float]:
    """The values of a baseline; none if there is no such file yet.

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
            key: math.nan if value is None else float(value)
            for key, value in table["values"].items()
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            f"{path}: not a baseline ({error}); write it anew with --update-baseline"
        ) from error


def updated(baseline: Baseline, metrics: Iterable[Metric], ran: Collection[str]) -> Baseline:
    """A baseline with the judged figures of the benchmarks that ran, and the others as they were.

    Args:
        baseline: the earlier values.
        metrics: what was measured.
        ran: names of the benchmarks that ran.
    """
    kept = {key: value for key, value in baseline.items() if benchmark_of(key) not in ran}
    return kept | {m.key: m.value for m in metrics if m.has_baseline}


def write_baseline(baseline: Baseline, path: Path = BASELINE_FILE) -> None:
    """Write a baseline, four significant digits a value."""
    values = {
        key: float(f"{value:.4g}") if math.isfinite(value) else None
        for key, value in sorted(baseline.items())
    }
    text = json.dumps({"schema_version": SCHEMA_VERSION, "values": values}, indent=2)
    path.write_text(text + "\n", encoding="utf-8")


def benchmark_of(key: str) -> str:
    """The name of the benchmark that a metric belongs to."""
    return key.partition(".")[0]


def complaints(metrics: Iterable[Metric], baseline: Baseline, ran: Collection[str]) -> list[str]:
    """Why a gate stays shut: a line for each bar missed and each figure that got worse or vanished.

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
        before = baseline.get(metric.key, math.nan)
        if metric.worse_than(before):
            lines.append(
                f"{metric.key} = {metric.value:.4g} {metric.unit} is worse than the baseline's "
                f"{before:.4g} by more than {metric.tolerance or 0.0:.0%}"
            )
    gone = [key for key in baseline if benchmark_of(key) in ran and key not in seen]
    return lines + [f"{key} is in the baseline but was not measured" for key in gone]
