# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The time series of a run in Rerun that only the run itself knows: state, IMU, cost, counts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend import Estimator
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, Packet, Rig
from slam_graph.visualization.rerun_series import SeriesLog, three_sigma

if TYPE_CHECKING:
    from slam_graph.backend import ObjectFrame


class ShownFrame(Protocol):
    """A frame, and what was made of it: `EstimatedFrame` of the pipeline says what each part is."""

    @property
    def packet(self) -> Packet:
        """As it was read."""
        ...

    @property
    def features(self) -> FeatureFrame:
        """What the front end found."""
        ...

    @property
    def state(self) -> NavState | None:
        """The causal estimate."""
        ...

    @property
    def landmark_ids(self) -> IntArray:
        """Of the estimated features (N,)."""
        ...

    @property
    def landmarks(self) -> FloatArray:
        """Their positions (N, 3), m."""
        ...

    @property
    def rejected(self) -> IntArray:
        """Ids that the gate rejected."""
        ...

    @property
    def corrected_rig(self) -> Rig | None:
        """The calibration, if corrected."""
        ...

    @property
    def restarted(self) -> bool:
        """Whether the estimator began anew."""
        ...

    @property
    def georeferenced(self) -> bool:
        """Whether the world is that of position fixes."""
        ...

    @property
    def objects(self) -> ObjectFrame | None:
        """What moves."""
        ...

    @property
    def waits(self) -> bool:
        """Whether the state is of an earlier frame."""
        ...

    @property
    def milliseconds(self) -> Mapping[str, float]:
        """Of each stage."""
        ...

    @property
    def counts(self) -> Mapping[str, float]:
        """Of the front end."""
        ...


class StepSeries:
    """Adds the rows of each frame.

    Args:
        series: where they go.
    """

    PLOTS: ClassVar[frozenset[str]] = frozenset(
        f"{group}/{name}"
        for group, names in {
            "state": ("velocity", "gyro_bias", "accel_bias"),
            "imu": ("gyro", "accel"),
            "consistency": ("nis",),
            "backend": ("milliseconds", "stages", "counts", "rejected", "cost"),
        }.items()
        for name in names
    )

    def __init__(self, series: SeriesLog) -> None:
        self._series = series

    def add(self, number: int, stamp_ns: int, frame: ShownFrame, estimator: Estimator) -> None:
        """Add the rows of a frame, at the time of its state."""
        add_imu(self._series, number, frame.packet)
        add = self._series.add
        ms, counts = frame.milliseconds, frame.counts
        nan = float("nan")
        stages = [ms.get(stage, nan) for stage in ("read", "frontend", "backend")]
        add("backend/milliseconds", number, stamp_ns, stages)
        parts = ("propagation", "cost", "gauss_newton", "marginalization")
        add("backend/stages", number, stamp_ns, [ms.get(f"backend.{p}", nan) for p in parts])
        seen = [len(camera) for camera in frame.features.cameras]
        past = 0 if estimator.window is None else len(estimator.window.past)
        numbers = [seen[0], sum(seen[1:]), len(frame.landmark_ids), past]
        add("backend/counts", number, stamp_ns, np.array(numbers, np.float64))
        innovations = estimator.report.innovations
        rejected = [counts.get("rejected_ransac", 0.0), float(innovations.rejected)]
        add("backend/rejected", number, stamp_ns, [*rejected, counts.get("rejected_stereo", 0.0)])
        if estimator.report.costs:
            add("backend/cost", number, stamp_ns, estimator.report.costs[:8])
        if innovations.passed_dof:
            self._add_nis(number, stamp_ns, estimator)
        if frame.state is not None:
            self._add_state(number, stamp_ns, frame.state)

    def _add_nis(self, number: int, stamp_ns: int, estimator: Estimator) -> None:
        """Squared innovations over their degrees of freedom, with what is expected of them."""
        innovations = estimator.report.innovations
        sums = (innovations.passed_distance, innovations.passed_dof, innovations.expected)
        values, bounds = nis_rows(*(np.array([float(value)]) for value in sums))
        self._series.add("consistency/nis", number, stamp_ns, values[0])
        self._series.add("consistency/nis/bounds", number, stamp_ns, bounds[0])

    def _add_state(self, number: int, stamp_ns: int, state: NavState) -> None:
        """Velocity, and biases with their bounds."""
        add = self._series.add
        add("state/velocity", number, stamp_ns, state.velocity)
        add("state/gyro_bias", number, stamp_ns, state.gyro_bias)
        add("state/accel_bias", number, stamp_ns, state.accel_bias)
        if state.covariance is None:
            return
        sigmas = np.sqrt(np.maximum(np.diag(state.covariance), 0.0))
        gyro = three_sigma(state.gyro_bias[None], sigmas[None, 12:15])[0]
        accel = three_sigma(state.accel_bias[None], sigmas[None, 9:12])[0]
        add("state/gyro_bias/bounds", number, stamp_ns, gyro)
        add("state/accel_bias/bounds", number, stamp_ns, accel)


def add_imu(series: SeriesLog, number: int, packet: Packet) -> None:
    """Add the IMU samples since the frame before, as they were read."""
    imu = packet.imu
    series.add_samples("imu/gyro", number, imu.stamps_ns, imu.gyro)
    series.add_samples("imu/accel", number, imu.stamps_ns, imu.accel)


def nis_rows(
    distance: FloatArray, dof: FloatArray, expected: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """NIS of N frames over its degrees of freedom (N, 1), with what is expected of it (N, 3).

    Args:
        distance: (N,) sums of squared Mahalanobis distances of what passed the gate.
        dof: (N,) their degrees of freedom, above zero.
        expected: (N,) their expected sums.
    """
    mean = expected / dof
    # a χ² variable over its many degrees of freedom has the variance 2 / dof
    margin = 1.96 * mean * np.sqrt(2.0 / dof)
    bounds = np.column_stack([mean, mean + margin, np.maximum(mean - margin, 0.0)])
    return (distance / dof)[:, None], bounds
