# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of the errors of a run that a command prints."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from slam_graph.cli.console import number

_Table = dict[str, Any]


def accuracy_rows(accuracy: _Table, title: str = "alignment") -> Iterator[tuple[str, ...]]:
    """Absolute and relative errors under each alignment, or once why there are none."""
    reasons = {table.get("unavailable") for table in accuracy.values()}
    if len(reasons) == 1 and None not in reasons:
        yield title, f"no errors: {reasons.pop()}"
        return
    yield title, "ATE rmse [m]", "[deg]", "RPE rmse, 1 m [m]", "[deg]", "scale"
    for mode, table in accuracy.items():
        if "unavailable" in table:
            yield mode, table["unavailable"]
            continue
        steps = table["rpe"]
        yield (
            mode,
            number(table["ate"]["translation_m"]["rmse"]),
            number(table["ate"]["rotation_deg"]["rmse"], 3),
            number(steps["translation_m"]["rmse"] if "delta_m" in steps else None),
            number(steps["rotation_deg"]["rmse"] if "delta_m" in steps else None, 3),
            number(table["scale"]),
        )


def segment_rows(metrics: _Table) -> Iterator[tuple[str, ...]]:
    """Errors of each segment, aligned by itself in what nothing measured."""
    start_ns, mode = metrics["extent"]["start_ns"], metrics["extent"]["unmeasured"]
    yield "segment", "from [s]", "to [s]", "joined by", f"ATE rmse, {mode} [m]", "[deg]", "smoothed"
    for count, segment in enumerate(metrics["segments"]):
        causal, smoothed = (
            ((segment[name] or {}).get(mode) or {}).get("ate") for name in ("accuracy", "smoothed")
        )
        yield (
            str(count),
            *(f"{(segment[end] - start_ns) * 1e-9:.2f}" for end in ("begin_ns", "end_ns")),
            segment["joined_by"],
            number(causal and causal["translation_m"]["rmse"]),
            number(causal and causal["rotation_deg"]["rmse"], 3),
            number(smoothed and smoothed["translation_m"]["rmse"]),
        )
