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
        self._held: list[tuple[str, str]] | None = None

    def hold(self) -> list[tuple[str, str]]:
        """From now on neither count nor log: keep events in the list that is returned.

        It is for a process whose events are to be counted and logged in another one.
        """
        self._held = []
        return self._held

    def warn(self, kind: str, message: str) -> None:
        """Count one event of `kind` and log `message` if it is among the first of its kind."""
        if self._held is not None:
            self._held.append((kind, message))
            return
        self.counts[kind] += 1
        if self.counts[kind] <= _LOGGED_PER_KIND:
            last = (
                " (further ones are only counted)" if self.counts[kind] == _LOGGED_PER_KIND else ""
            )
            logger.warning("%s: %s%s", kind, message, last)
