# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Time series in Rerun: their names, units and colours, and rows that are sent many at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.visualization.rerun_palette import (
    AXES,
    CYCLE,
    GREEN,
    GREY,
    LIGHT_GREY,
    ORANGE,
    SKY,
    VERMILLION,
    YELLOW,
    Colour,
)
from slam_graph.visualization.rerun_stream import RerunStream

XYZ = ("x", "y", "z")
_BAND = ("x ±3σ", "y ±3σ", "z ±3σ", "−3σ x", "−3σ y", "−3σ z")
_MAX_STEPS = 8
_ROWS_AT_ONCE = 40
"""Rows that are kept before they are sent together: two seconds of frames."""
_ROWS_IN_FILES = 4000
"""The same where nobody waits for them: each piece costs a kilobyte."""


@dataclass(frozen=True, slots=True)
class Plot:
    """One plot.

    Attributes:
        entity: its values.
        title: with the unit; short, as up to five share the head of a tile.
        names: of the values.
        colours: of the values.
        bounds: names of what is drawn thinner beside them, at `entity/bounds`.
        bound_colours: of these.
        needs_truth: whether it is only there with a ground truth.
    """

    entity: str
    title: str
    names: tuple[str, ...] = XYZ
    colours: tuple[Colour, ...] = AXES
    bounds: tuple[str, ...] = ()
    bound_colours: tuple[Colour, ...] = ()
    needs_truth: bool = False


def _with_band(entity: str, title: str, needs_truth: bool = False) -> Plot:
    return Plot(entity, title, XYZ, AXES, _BAND, 2 * AXES, needs_truth)


STATE_PLOTS = (
    Plot("state/velocity", "velocity [m/s]"),
    _with_band("state/gyro_bias", "gyro bias [rad/s]"),
    _with_band("state/accel_bias", "accel bias [m/s²]"),
)
IMU_PLOTS = (
    Plot("imu/gyro", "angular rate [rad/s]"),
    Plot("imu/accel", "specific force [m/s²]"),
)
ERROR_PLOTS = (
    _with_band("error/position", "position error [m]", True),
    _with_band("error/orientation", "orientation error [°]", True),
    Plot(
        "consistency/nees",
        "NEES",
        ("position", "orientation"),
        (ORANGE, SKY),
        ("95 % of χ² with 3", "lower"),
        (GREY, GREY),
        True,
    ),
    Plot(
        "consistency/nis",
        "NIS / dof",
        ("images",),
        (ORANGE,),
        ("expected", "95 %", "lower"),
        (LIGHT_GREY, GREY, GREY),
    ),
)
WORK_PLOTS = (
    Plot(
        "backend/milliseconds", "time [ms]", ("read", "front end", "back end"), (GREY, SKY, ORANGE)
    ),
    Plot(
        "backend/stages",
        "back end [ms]",
        ("propagation", "cost", "Gauss-Newton", "marginalization"),
        (SKY, GREEN, ORANGE, VERMILLION),
    ),
    Plot(
        "backend/counts",
        "features",
        ("tracked", "other cameras", "estimated", "poses in state"),
        (SKY, GREEN, ORANGE, YELLOW),
    ),
    Plot(
        "backend/rejected",
        "rejected",
        ("RANSAC", "gate", "stereo"),
        (YELLOW, VERMILLION, SKY),
    ),
    Plot(
        "backend/cost",
        "cost",
        ("before", *(f"after step {k}" for k in range(1, _MAX_STEPS))),
        (VERMILLION, *CYCLE[:3], *CYCLE[3:5], CYCLE[6], CYCLE[7])[:_MAX_STEPS],
    ),
)
PLOTS = {plot.entity: plot for plot in (*STATE_PLOTS, *IMU_PLOTS, *ERROR_PLOTS, *WORK_PLOTS)}


@dataclass(slots=True)
class _Rows:
    frames: list[int] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    values: list[Sequence[float] | FloatArray] = field(default_factory=list)


@dataclass(slots=True)
class _Samples:
    frames: list[int] = field(default_factory=list)
    stamps_ns: list[IntArray] = field(default_factory=list)
    values: list[FloatArray] = field(default_factory=list)


class SeriesLog:
    """Rows of plots, sent many at a time: a call for each value would cost too much.

    Args:
        stream: where they go.

    Attributes:
        spans: least and largest values that were sent, with those of the bounds, by the plots.
    """

    def __init__(self, stream: RerunStream) -> None:
        self._stream = stream
        self._rows: dict[str, _Rows] = {}
        self._samples: dict[str, _Samples] = {}
        self._styled: set[str] = set()
        self.spans: dict[str, tuple[float, float]] = {}

    def add(
        self, entity: str, frame: int, stamp_ns: int, values: Sequence[float] | FloatArray
    ) -> None:
        """Add a row."""
        rows = self._rows.setdefault(entity, _Rows())
        rows.frames.append(frame)
        rows.stamps_ns.append(stamp_ns)
        rows.values.append(values)
        if len(rows.frames) >= (_ROWS_IN_FILES if self._stream.saves else _ROWS_AT_ONCE):
            self._send(entity)

    def add_samples(self, entity: str, frame: int, stamps_ns: IntArray, values: FloatArray) -> None:
        """Add rows (N, k) at times (N,) that belong to one frame."""
        kept = self._samples.setdefault(entity, _Samples())
        kept.frames.append(frame)
        kept.stamps_ns.append(stamps_ns)
        kept.values.append(values)
        if len(kept.frames) >= (_ROWS_IN_FILES if self._stream.saves else _ROWS_AT_ONCE):
            self._send_samples(entity)

    def flush(self) -> None:
        """Send all rows that are kept."""
        for entity in list(self._rows):
            self._send(entity)
        for entity in list(self._samples):
            self._send_samples(entity)

    def send(self, entity: str, frames: IntArray, stamps_ns: IntArray, values: FloatArray) -> None:
        """Send rows (N, k) at once."""
        if not len(values):
            return
        self._style(entity)
        rr = self._stream.rr
        values = np.ascontiguousarray(values, dtype=np.float64)
        columns = rr.Scalars.columns(scalars=values)
        self._stream.send_columns(entity, frames, stamps_ns, columns)
        finite = values[np.isfinite(values)]
        if len(finite):
            plot = entity.removesuffix("/bounds")
            low, high = self.spans.get(plot, (np.inf, -np.inf))
            self.spans[plot] = min(low, float(finite.min())), max(high, float(finite.max()))

    def _send(self, entity: str) -> None:
        rows = self._rows.pop(entity)
        width = max(len(row) for row in rows.values)
        values = np.full((len(rows.values), width), np.nan)
        for number, row in enumerate(rows.values):
            values[number, : len(row)] = row
        frames, stamps_ns = (np.array(x, np.int64) for x in (rows.frames, rows.stamps_ns))
        self.send(entity, frames, stamps_ns, values)

    def _send_samples(self, entity: str) -> None:
        kept = self._samples.pop(entity)
        frames = np.repeat(np.array(kept.frames, np.int64), [len(rows) for rows in kept.stamps_ns])
        self.send(entity, frames, np.concatenate(kept.stamps_ns), np.concatenate(kept.values))

    def _style(self, entity: str) -> None:
        """Name and colour the values of a plot, before its first row."""
        if entity in self._styled:
            return
        self._styled.add(entity)
        bounds = entity.endswith("/bounds")
        plot = PLOTS[entity.removesuffix("/bounds")]
        names, colours = (plot.bounds, plot.bound_colours) if bounds else (plot.names, plot.colours)
        lines = self._stream.rr.SeriesLines(
            names=names, colors=colours, widths=[0.7 if bounds else 1.6] * len(names)
        )
        self._stream.log(entity, lines, static=True)


def three_sigma(values: FloatArray, sigmas: FloatArray) -> FloatArray:
    """Rows (N, 6) of the bounds ±3σ around values (N, 3)."""
    return np.hstack([values + 3 * sigmas, values - 3 * sigmas])
