# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Counted warnings: what went wrong without ending the run, by cause.

A `Diagnostics` is passed to whatever reads or estimates. It counts every event by its kind and logs
the first few of each kind, so that a fault that repeats on every frame neither floods the log nor
gets lost. The counts go into `metrics.json`.
"""

from __future__ import annotations

import logging
from collections import Counter

__all__ = ["Diagnostics"]

logger = logging.getLogger("slam_graph")

_LOGGED_PER_KIND = 5
"""So many events of one kind are written to the log; further ones are only counted."""


class Diagnostics:
    """Counts events by kind, e.g. ``imu_gap`` or ``image_unreadable``.

    Attributes:
        counts: events so far, by kind.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def warn(self, kind: str, message: str) -> None:
        """Count one event of `kind` and log `message` if it is among the first of its kind."""
        self.counts[kind] += 1
        if self.counts[kind] <= _LOGGED_PER_KIND:
            last = (
                " (further ones are only counted)" if self.counts[kind] == _LOGGED_PER_KIND else ""
            )
            logger.warning("%s: %s%s", kind, message, last)
