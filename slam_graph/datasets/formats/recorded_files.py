# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the files of a recording of tracks have in common; `track_recording` describes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_graph.errors import DataError
from slam_graph.sensors import FeatureObservations

AGAIN = "record it again"
"""What to do with a file that is damaged, for messages."""


def check_length(file: Path, expected: int) -> None:
    """Refuse a file that is not as long as the recorder left it.

    Args:
        file: of the recording.
        expected: bytes, by what ``meta.yaml`` says.

    Raises:
        DataError: if it is missing or has another length.
    """
    size = file.stat().st_size if file.is_file() else -1
    if size != expected:
        found = "missing" if size < 0 else f"{size} bytes long"
        raise DataError(f"{file}: {found}, by meta.yaml it should have {expected} bytes; {AGAIN}")


def packed(seen: FeatureObservations, record: np.dtype[Any]) -> NDArray[np.void]:
    """Rows (N,) of a type with `id`, `pixel` and `normalized`, in which these are filled in."""
    rows = np.empty(len(seen), record)
    rows["id"], rows["pixel"], rows["normalized"] = seen.ids, seen.pixels, seen.normalized
    return rows
