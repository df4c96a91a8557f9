# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Wrong samples of an IMU: found by themselves and their neighbours, counted by cause, left out.

What is left out is a gap to the estimator, which bridges it with more noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.sensors import ImuData

_RANGE = np.repeat([40.0, 350.0], 3)
"""Beyond what inertial sensors measure: 2000 °/s are 35 rad/s, 32 g are 314 m/s²."""

_LARGE = np.repeat([4.0, 35.0], 3)
"""From here on (250 °/s are 4.4 rad/s, 4 g are 39 m/s²) a value may be the end of the range."""

_AT_THE_END = 3
"""So many samples in a row with the same large value in one axis are at the end of its range."""

_STUCK, _STUCK_S = 10, 0.05
"""So many samples in a row, and over so long, with the same values in all axes come from a sensor
that is stuck. Some drivers repeat each value of a slower sensor a few times."""

_AROUND = 5
"""A sample is compared with so many on either side."""

_SPIKE = np.repeat([3.0, 25.0], 3)
"""A single sample is wrong if it is so far from the median around it (rad/s, m/s²) …"""

_SPIKE_SIGMAS = 10.0
"""… and by so many standard deviations, which the median deviation estimates."""

_SIGMA_OF_MEDIAN_DEVIATION = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""

_WHY = {
    "imu_out_of_range": "beyond what sensors measure",
    "imu_saturated": "an axis is at the end of its range",
    "imu_stuck": "the sensor repeats its values",
    "imu_spike": "far from the samples on either side",
}
"""Causes in words."""

_CONTEXT = 128
"""Samples on either side that decide on one: more than any of the counts above."""


def without_outliers(blocks: Iterable[ImuData], diagnostics: Diagnostics) -> Iterator[ImuData]:
    """The samples that can be true.

    Counted kinds: `imu_out_of_range` (beyond what sensors measure), `imu_saturated` (an axis is at
    the end of its range), `imu_stuck` (values repeat), `imu_spike` (a single sample is far from
    those around it, Hampel 1974).

    Args:
        blocks: with increasing stamps and finite values.
        diagnostics: where faults are counted.
    """
    judge = _Judge(diagnostics)
    pending, decided = ImuData.empty(), 0
    for block in blocks:
        pending = ImuData.concatenate([pending, block])
        end = len(pending) - _CONTEXT
        if end > decided:
            yield from judge.true_samples(pending, decided, end)
            decided = min(end, _CONTEXT)
            pending = pending[end - decided :]
    yield from judge.true_samples(pending, decided, len(pending))


class _Judge:
    """Tells true samples from wrong ones.

    Attributes:
        noisy: whether the signal has shown noise so far.
    """

    def __init__(self, diagnostics: Diagnostics) -> None:
        self.noisy = False
        self._diagnostics = diagnostics

    def true_samples(self, data: ImuData, begin: int, end: int) -> Iterator[ImuData]:
        """Those of the samples from `begin` to `end` that can be true, if there are any."""
        wrong = np.zeros(len(data), bool)
        period_ns = max(float(np.median(np.diff(data.stamps_ns))), 1.0) if len(data) > 1 else 1e9
        stuck = min(max(_STUCK, round(_STUCK_S * 1e9 / period_ns)), _CONTEXT)
        for kind, found in self._judged(np.hstack([data.gyro, data.accel]), stuck):
            for k in (np.flatnonzero(found[begin:end] & ~wrong[begin:end]) + begin).tolist():
                sample = f"IMU sample at {data.stamps_ns[k]} left out, {_WHY[kind]}"
                self._diagnostics.warn(kind, f"{sample}: {_values(data, k)}")
            wrong |= found
        rows = np.flatnonzero(~wrong[begin:end]) + begin
        if len(rows):
            yield ImuData(data.stamps_ns[rows], data.gyro[rows], data.accel[rows])

    def _judged(self, values: FloatArray, stuck: int) -> Iterator[tuple[str, BoolArray]]:
        """Which samples are wrong, by cause.

        Args:
            values: (N, 6) angular rates in rad/s and specific forces in m/s².
            stuck: so many equal samples in a row come from a sensor that is stuck.
        """
        size = np.abs(values)
        yield "imu_out_of_range", _single(np.asarray(np.any(size > _RANGE, axis=1)))
        at_the_end = _in_runs(size[1:] == size[:-1], _AT_THE_END) & (size > _LARGE)
        yield "imu_saturated", np.asarray(np.any(at_the_end, axis=1))
        yield "imu_stuck", self._stuck(values, stuck)
        yield "imu_spike", _spikes(values)

    def _stuck(self, values: FloatArray, count: int) -> BoolArray:
        """Which samples (N,) are in a run of `count` equal ones or more, in a signal with noise.

        Of noise, third differences are three times as large as first ones; of a smooth signal they
        are far smaller. Simulated signals without noise repeat themselves when the platform stands.
        The first sample of a run may be true, but is not worth the doubt.
        """
        same = (values[1:] == values[:-1]).all(axis=1)
        moving = ~same[2:]
        if not self.noisy and np.sum(moving) >= _STUCK:
            with np.errstate(over="ignore", invalid="ignore"):  # of samples that are out of range
                first = np.median(np.abs(np.diff(values, axis=0))[2:][moving], axis=0)
                third = np.median(np.abs(np.diff(values, n=3, axis=0))[moving], axis=0)
            self.noisy = bool(np.any(third > first))
        if not self.noisy:
            return np.zeros(len(values), bool)
        return _in_runs(same[:, None], count)[:, 0]


def _values(data: ImuData, row: int) -> str:
    gyro, accel = (", ".join(f"{v:.3g}" for v in x[row]) for x in (data.gyro, data.accel))
    return f"gyroscope {gyro} rad/s, accelerometer {accel} m/s²"


def _single(found: BoolArray) -> BoolArray:
    """What was found, without runs as long as those of a wrong unit, which is not to be hidden."""
    both = found[1:] & found[:-1]
    return found & ~_in_runs(both[:, None], _STUCK)[:, 0]


def _in_runs(same: BoolArray, count: int) -> BoolArray:
    """Which of N values are in a run of `count` or more equal ones.

    Args:
        same: (N - 1, K) which values are as the one before, of K signals.
        count: at least two.
    """
    run = np.zeros((same.shape[0] + 1, same.shape[1]), bool)
    if len(run) < count:
        return run
    begins: BoolArray = np.all(sliding_window_view(same, count - 1, axis=0), axis=-1)
    for shift in range(count):
        run[shift : shift + len(begins)] |= begins
    return run


def _spikes(values: FloatArray) -> BoolArray:
    """Which samples (N,) stand out alone."""
    if len(values) < 2 * _AROUND + 1:
        return np.zeros(len(values), bool)
    around = sliding_window_view(values, 2 * _AROUND + 1, axis=0)
    around = np.concatenate([around[:1]] * _AROUND + [around] + [around[-1:]] * _AROUND)
    middle = np.median(around, axis=2)
    spread = _SIGMA_OF_MEDIAN_DEVIATION * np.median(np.abs(around - middle[..., None]), axis=2)
    off = np.abs(values - middle)
    limit = np.maximum(_SPIKE, _SPIKE_SIGMAS * spread)
    far, half = (off > limit).any(axis=1), (off > 0.5 * limit).any(axis=1)
    beside = np.zeros(len(values), bool)
    beside[1:] |= half[:-1]
    beside[:-1] |= half[1:]
    alone: BoolArray = far & ~beside
    return alone
