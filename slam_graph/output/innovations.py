# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How far the images of each frame were from what was predicted of them."""

from __future__ import annotations

from array import array
from dataclasses import astuple, fields

import numpy as np
from numpy.typing import NDArray

from slam_graph.backend.gating import Innovations

FloatArray = NDArray[np.float64]

COLUMNS = tuple(field.name for field in fields(Innovations))


class InnovationLog:
    """A growing table with a row for each frame of which something was predicted."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._rows = array("d")

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def append(self, stamp_ns: int, innovations: Innovations) -> None:
        """Add a frame, unless nothing was tested in it."""
        if innovations.tested:
            self._stamps_ns.append(stamp_ns)
            self._rows.extend(map(float, astuple(innovations)))

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(N,) times of the frames."""
        return np.array(self._stamps_ns, dtype=np.int64)

    def columns(self) -> dict[str, FloatArray]:
        """(N,) values of each attribute of `Innovations`, by its name."""
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, len(COLUMNS))
        return dict(zip(COLUMNS, rows.T, strict=True))
