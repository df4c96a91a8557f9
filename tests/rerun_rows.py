# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings for Rerun, read back row by row."""

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

Row = dict[str, Any]
"""Components of one row by their names, and its `frame`."""


def rows_of(path: Path) -> Mapping[str, list[Row]]:
    """The rows of each entity, but for static ones, in the order of the frames."""
    rows: dict[str, list[Row]] = defaultdict(list)
    for chunk in RrdReader(path).stream():
        if chunk.is_static or "frame" not in chunk.timeline_names:
            continue
        rows[str(chunk.entity_path)] += [
            {name.split(":")[-1]: value for name, value in row.items() if value is not None}
            for row in chunk.to_record_batch().to_pylist()
        ]
    for found in rows.values():
        found.sort(key=lambda row: int(row["frame"]))
    return rows


def colour(packed: int) -> tuple[int, int, int]:
    """Red, green and blue of a colour as Rerun keeps it."""
    return packed >> 24, packed >> 16 & 255, packed >> 8 & 255
