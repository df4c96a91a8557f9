# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a front end counts and times in a frame."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from slam_graph.frontend.tracks import Mask


class FrameStats(defaultdict[str, float]):
    """Counts and milliseconds (`…_ms`) of a frame, by name; zero for what did not occur."""

    def __init__(self) -> None:
        super().__init__(float)

    def add(self, name: str, number: int) -> None:
        """Count some more."""
        self[name] += number

    def count(self, **fates: Mask) -> None:
        """Count features by what became of them."""
        for fate, features in fates.items():
            self.add(fate, int(np.count_nonzero(features)))

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage."""
        start = time.perf_counter()
        yield
        self[stage] += (time.perf_counter() - start) * 1e3
