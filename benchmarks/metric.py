# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A measured figure: which way is better, what it must reach, and when it counts as worse."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

Direction = Literal["lower", "higher", "band", "info"]
"""What is better: less, more, or within the bar's two ends. `info` is shown and never judged."""

DIRECTIONS: tuple[Direction, ...] = get_args(Direction)

Bar = float | tuple[float, float]

TOLERANCE = 0.15
"""By what share an accuracy may be worse than the baseline: seeded runs repeat exactly on one
machine, but other versions of NumPy or OpenCV round otherwise, and the choices that an estimator
makes amplify that."""

TIMING_TOLERANCE = 0.30
"""The same for ratios of times, which scatter with the load and the caches of a machine."""


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
            says nothing, because it depends on the machine.
    """

    key: str
    value: float
    unit: str
    direction: Direction
    bar: Bar | None = None
    tolerance: float | None = TOLERANCE

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise ValueError(f"{self.key}: unknown direction '{self.direction}'")
        if isinstance(self.bar, tuple) != (self.direction == "band"):
            raise ValueError(f"{self.key}: a band has two ends, everything else at most one bar")
        if self.direction == "info" and self.bar is not None:
            raise ValueError(f"{self.key}: what is only shown has no bar")

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
            "meets_bar": self.meets_bar,
        }


def info(key: str, value: float, unit: str) -> Metric:
    """A figure that is only shown."""
    return Metric(key, value, unit, "info")
