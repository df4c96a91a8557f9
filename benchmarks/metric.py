# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A measured figure: which way is better, what it must reach, and when it counts as worse."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

Direction = Literal["lower", "higher", "band", "info"]
"""What is better: less, more, or within the bar's two ends. `info` is shown and never judged."""

DIRECTIONS: tuple[Direction, ...] = get_args(Direction)

Bar = float | tuple[float, float]

TOLERANCE = 0.15
"""By what share an error may be worse than the baseline: seeded runs repeat exactly on one
machine, but other versions of NumPy or OpenCV round otherwise, and the choices that an estimator
makes amplify that."""

EXACT = 0.0
"""For what is counted or answered by yes and no."""

QUANTISED_TOLERANCE = 0.05
"""For times and shares of a recording, which change by whole frames."""

TIMING_TOLERANCE = 0.30
"""For ratios of times of one run, which scatter with the caches of a machine. Load makes it worse
(a front end of 2.7 flows once came out at 4.3), so one quick benchmark alone judges a time, the
least of a few runs (`speed_quick`)."""

COMPUTING_TIMES = ("ms", "ms CPU", "ms = 1 LK", "s CPU", "s wall", "× real time")
"""Units of what a machine takes for something: another machine takes another time, so a figure in
them is shown and never judged. A ratio of two times of one run may be."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure of a benchmark.

    Attributes:
        key: name, `<benchmark>.<variant>.<figure>`.
        value: NaN where it could not be measured: then every bar is missed.
        unit: for the reader.
        direction: which way is better.
        bar: what must be reached: a limit (itself still good enough), the two ends of a band, or
            None.
        tolerance: by what share `value` may be worse than its baseline; None where an earlier value
            says nothing.
        held_out: whether it was measured on what no parameter was chosen on.
    """

    key: str
    value: float
    unit: str
    direction: Direction
    bar: Bar | None = None
    tolerance: float | None = TOLERANCE
    held_out: bool = False

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise ValueError(f"{self.key}: unknown direction '{self.direction}'")
        if isinstance(self.bar, tuple) != (self.direction == "band"):
            raise ValueError(f"{self.key}: a band has two ends, everything else at most one bar")
        if self.direction == "info" and self.bar is not None:
            raise ValueError(f"{self.key}: what is only shown has no bar")
        if self.direction != "info" and self.unit in COMPUTING_TIMES:
            raise ValueError(f"{self.key}: a time in {self.unit} depends on the machine; show it")

    @property
    def meets_bar(self) -> bool | None:
        """Whether the bar is reached; None without one."""
        if self.bar is None:
            return None
        if isinstance(self.bar, tuple):
            return self.bar[0] <= self.value <= self.bar[1]
        return self.value <= self.bar if self.direction == "lower" else self.value >= self.bar

    def worse_than(self, baseline: float) -> bool:
        """Whether the value is worse than an earlier one by more than the tolerance.

        A band is judged by its ends alone, and nothing is worse than what could not be measured.
        """
        if self.tolerance is None or self.direction in ("band", "info") or math.isnan(baseline):
            return False
        margin = self.tolerance * abs(baseline)
        if self.direction == "lower":
            return not self.value <= baseline + margin
        return not self.value >= baseline - margin

    @property
    def has_baseline(self) -> bool:
        """Whether a baseline keeps the value."""
        return self.direction != "info" and self.tolerance is not None

    def change_from(self, baseline: float) -> float:
        """Relative change from an earlier value; NaN where there is none."""
        return self.value / baseline - 1.0 if baseline else math.nan

    def under(self, benchmark: str) -> Metric:
        """The same figure with the name of its benchmark before its own."""
        return replace(self, key=f"{benchmark}.{self.key}")

    def to_table(self) -> dict[str, Any]:
        """All fields as JSON can hold them."""
        return {
            "key": self.key,
            "value": self.value if math.isfinite(self.value) else None,
            "unit": self.unit,
            "direction": self.direction,
            "bar": list(self.bar) if isinstance(self.bar, tuple) else self.bar,
            "tolerance": self.tolerance,
            "held_out": self.held_out,
            "meets_bar": self.meets_bar,
        }

    @staticmethod
    def from_table(key: str, table: Mapping[str, Any]) -> Metric:
        """The figure of a table as `to_table` makes it; fields that are left out are defaults."""
        bar, value = table.get("bar"), table["value"]
        return Metric(
            key,
            math.nan if value is None else float(value),
            table["unit"],
            table["direction"],
            (bar[0], bar[1]) if isinstance(bar, list) else bar,
            table["tolerance"],
            table.get("held_out", False),
        )


def info(key: str, value: float, unit: str) -> Metric:
    """A figure that is only shown."""
    return Metric(key, value, unit, "info", tolerance=None)
