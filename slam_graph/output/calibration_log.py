# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How an estimated calibration came about: its parameters at every frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from slam_graph.sensors.calibration_estimate import CalibrationEstimate


class CalibrationLog:
    """A growing table with a row for each frame; empty where nothing is calibrated.

    Attributes:
        latest: the last estimate, None before the first.
    """

    def __init__(self) -> None:
        self.latest: CalibrationEstimate | None = None
        self._rows: list[tuple[int, list[float]]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def append(self, estimate: CalibrationEstimate) -> None:
        """Add the estimate at the next frame."""
        self.latest = estimate
        parameters = estimate.parameters()
        values = [parameter.value for parameter in parameters]
        self._rows.append((estimate.stamp_ns, values + [p.sigma for p in parameters]))

    def table(self) -> dict[str, dict[str, Any]] | None:
        """The last estimate: start, value and standard deviation of each parameter by its name."""
        if self.latest is None:
            return None
        return {
            parameter.name: {
                "start": parameter.start,
                "value": parameter.value,
                "sigma": parameter.sigma,
            }
            for parameter in self.latest.parameters()
        }

    def csv_lines(self) -> Iterator[str]:
        """The table as CSV: values of all parameters, then their standard deviations."""
        if self.latest is None:
            return
        names = [parameter.name for parameter in self.latest.parameters()]
        yield ",".join(["stamp_ns", *names, *(f"sigma_{name}" for name in names)]) + "\n"
        for stamp_ns, row in self._rows:
            yield ",".join([str(stamp_ns), *(f"{value:.9g}" for value in row)]) + "\n"
