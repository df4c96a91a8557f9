# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of the IMU: samples that are missing, repeated, late, or wrong."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from slam_graph.datasets.faults.fault import FAULTS, Fault, Surroundings
from slam_graph.sensors import ImuData

if TYPE_CHECKING:
    from slam_graph.arrays import BoolArray

WHOLE_S = 1e6
"""A duration that reaches to the end of any recording."""


class ImuFault(Fault):
    """A fault that changes samples block by block."""

    def imu(self, blocks: Iterator[ImuData], around: Surroundings) -> Iterator[ImuData]:
        """The blocks, each with the fault in the samples that it covers."""
        rng = self.rng()
        for block in blocks:
            inside = self.covers(block.stamps_ns, around)
            yield self.changed(block, inside, rng) if inside.any() else block

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """A block with the fault.

        Args:
            block: N samples.
            inside: (N,) which of them the fault covers, at least one.
            rng: of what is random.
        """
        raise NotImplementedError


def _rows(block: ImuData, rows: BoolArray | NDArray[np.intp]) -> ImuData:
    return ImuData(block.stamps_ns[rows], block.gyro[rows], block.accel[rows])


def _overwritten(block: ImuData, where: BoolArray, gyro: ArrayLike, accel: ArrayLike) -> ImuData:
    """The block with other values in some rows (N,)."""
    row = where[:, None]
    return ImuData(
        block.stamps_ns, np.where(row, gyro, block.gyro), np.where(row, accel, block.accel)
    )


@FAULTS.register("imu_missing")
class ImuMissing(ImuFault):
    """There are no samples."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples outside."""
        return _rows(block, ~inside)


class _SomeSamples(ImuFault):
    """A fault that strikes samples at random."""

    duration_s: float = Field(WHOLE_S, gt=0.0)
    """How long it lasts: to the end."""

    share: float = Field(0.05, gt=0.0, le=1.0)
    """Share of the samples that it strikes."""

    def struck(self, inside: BoolArray, rng: np.random.Generator) -> BoolArray:
        """Which samples it strikes."""
        hit: BoolArray = inside & (rng.random(len(inside)) < self.share)
        return hit


@FAULTS.register("imu_dropped")
class ImuDropped(_SomeSamples):
    """Single samples are lost."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples that are left."""
        return _rows(block, ~self.struck(inside, rng))


@FAULTS.register("imu_duplicated")
class ImuDuplicated(_SomeSamples):
    """Single samples come twice."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples, with those that come twice."""
        return _rows(block, np.repeat(np.arange(len(block)), 1 + self.struck(inside, rng)))


@FAULTS.register("imu_out_of_order")
class ImuOutOfOrder(_SomeSamples):
    """Single samples come after the one that follows them."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples in the order in which they come."""
        order = np.arange(len(block), dtype=float)
        order[self.struck(inside, rng)] += 1.5
        return _rows(block, np.argsort(order, kind="stable"))


@FAULTS.register("imu_nan")
class ImuNan(_SomeSamples):
    """Single samples are not numbers."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples, with those that are not numbers."""
        return _overwritten(block, self.struck(inside, rng), np.nan, np.nan)


@FAULTS.register("accel_spikes")
class AccelSpikes(_SomeSamples):
    """Single samples of the accelerometer are far off in one direction."""

    share: float = Field(0.01, gt=0.0, le=1.0)
    """Share of the samples that it strikes."""

    size: float = 80.0
    """How far they are off, in m/s²."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples, with those that are off."""
        directions = rng.normal(size=(len(block), 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        off = self.struck(inside, rng)[:, None] * self.size * directions
        return ImuData(block.stamps_ns, block.gyro, block.accel + off)


@FAULTS.register("imu_late")
class ImuLate(ImuFault):
    """Samples have stamps that are too late."""

    duration_s: float = Field(WHOLE_S, gt=0.0)
    """How long it lasts: to the end."""

    by_s: float = Field(0.03, ge=-1e5, le=1e5)
    """How much too late."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples with their new stamps."""
        stamps = block.stamps_ns + inside * round(self.by_s * 1e9)
        return ImuData(stamps, block.gyro, block.accel)


class _OneSample(ImuFault):
    """The first sample from the beginning on has another value."""

    def imu(self, blocks: Iterator[ImuData], around: Surroundings) -> Iterator[ImuData]:
        """The blocks, one of them changed."""
        begin = self.begin_ns(around)
        done = False
        for block in blocks:
            first = int(np.searchsorted(block.stamps_ns, begin))
            if done or first == len(block):
                yield block
                continue
            done = True
            row = np.zeros(len(block), bool)
            row[first] = True
            yield self.changed(block, row, self.rng())


@FAULTS.register("imu_outlier")
class ImuOutlier(_OneSample):
    """One sample is absurd in all axes."""

    value: float = 1e6
    """What it says, in m/s² and rad/s."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples, with the absurd one."""
        return _overwritten(block, inside, self.value, self.value)


@FAULTS.register("gyro_outlier")
class GyroOutlier(_OneSample):
    """One sample of the gyroscope is far off in its x axis."""

    value: float = 50.0
    """What it says, in rad/s."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples, with the wrong one."""
        gyro = block.gyro.copy()
        gyro[inside, 0] = self.value
        return ImuData(block.stamps_ns, gyro, block.accel)


@FAULTS.register("imu_saturated")
class ImuSaturated(ImuFault):
    """All axes are at the end of their range, on the side where they are."""

    duration_s: float = Field(0.5, gt=0.0)
    """How long it lasts."""

    gyro_range: float = 8.7
    """Range of the gyroscope in rad/s (500 °/s)."""

    accel_range: float = 78.0
    """Range of the accelerometer in m/s² (8 g)."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples, with those at the end of the range."""
        gyro, accel = np.sign(block.gyro) * self.gyro_range, np.sign(block.accel) * self.accel_range
        return _overwritten(block, inside, gyro, accel)


@FAULTS.register("imu_zeros")
class ImuZeros(ImuFault):
    """All axes say zero."""

    def changed(self, block: ImuData, inside: BoolArray, rng: np.random.Generator) -> ImuData:
        """The samples, with those that say zero."""
        return _overwritten(block, inside, 0.0, 0.0)


@FAULTS.register("imu_frozen")
class ImuFrozen(ImuFault):
    """Samples repeat the values of the first one."""

    duration_s: float = Field(3.0, gt=0.0)
    """How long it lasts."""

    def imu(self, blocks: Iterator[ImuData], around: Surroundings) -> Iterator[ImuData]:
        """The blocks; what is repeated may be in an earlier one."""
        held: ImuData | None = None
        for block in blocks:
            inside = self.covers(block.stamps_ns, around)
            if not inside.any():
                yield block
                continue
            first = int(np.argmax(inside))
            held = held or block[first : first + 1]
            yield _overwritten(block, inside, held.gyro, held.accel)
