# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements: IMU samples, camera frames, and the feature frames of a front end.

Time is an integer in nanoseconds (`stamp_ns`) on the clock of the IMU.
"""

from __future__ import annotations

import math
from collections.abc import Sequence as PySequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray, ascending_union
from slam_graph.sensors.aiding import AidingData

_LONGEST_STEP_S = 0.02
"""A longer time between two samples is integrated in several steps. The noise of a single one is
that of a constant acceleration: it ties the position to the velocities at both ends, as if it were
known to be half their sum times the duration."""
_MOST_STEPS = 500
"""Of a gap, however long it is."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuSteps:
    """Short times in which angular rate and specific force are taken for constant.

    Attributes:
        durations_s: (N,) in s.
        gyro: (N, 3) angular rates, rad/s.
        accel: (N, 3) specific forces, m/s².
    """

    durations_s: FloatArray
    gyro: FloatArray
    accel: FloatArray

    def preintegrated(
        self, bias: gtsam.imuBias.ConstantBias, params: gtsam.PreintegrationCombinedParams
    ) -> gtsam.PreintegratedCombinedMeasurements:
        """As `ImuData.preintegrated`."""
        pim = gtsam.PreintegratedCombinedMeasurements(params, bias)
        # GTSAM turns the specific force by the attitude at the start of a step; this is half a
        # step on
        half_turn = 0.5 * self.durations_s[:, None] * (self.gyro - bias.gyroscope())
        accel = self.accel + _cross(half_turn, self.accel - bias.accelerometer())
        for a, w, dt in zip(accel, self.gyro, self.durations_s.tolist(), strict=True):
            pim.integrateMeasurement(a, w, dt)
        return pim


@dataclass(frozen=True, slots=True, eq=False)
class ImuData:
    """A block of consecutive IMU samples, in the body frame, and their integration.

    For the integration samples are instantaneous values of a signal that is linear between them:
    from one sample to the next the mean of the two is integrated.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing.
        gyro: (N, 3) angular rate in rad/s.
        accel: (N, 3) specific force in m/s² (at rest it points up: +9.81 along world z).
    """

    stamps_ns: IntArray
    gyro: FloatArray
    accel: FloatArray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @staticmethod
    def empty() -> ImuData:
        """A block without samples."""
        return ImuData(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))

    @staticmethod
    def concatenate(blocks: PySequence[ImuData]) -> ImuData:
        """Join blocks that follow one another in time."""
        if not blocks:
            return ImuData.empty()
        return ImuData(
            np.concatenate([b.stamps_ns for b in blocks]),
            np.concatenate([b.gyro for b in blocks]),
            np.concatenate([b.accel for b in blocks]),
        )

    def __getitem__(self, index: slice) -> ImuData:
        return ImuData(self.stamps_ns[index], self.gyro[index], self.accel[index])

    def rotation(self, gyro_bias: FloatArray) -> gtsam.Rot3:
        """Rotation start_R_end of the body from the first to the last sample, at least one.

        Args:
            gyro_bias: (3,) rad/s.
        """
        gyro = 0.5 * (self.gyro[1:] + self.gyro[:-1])
        start_R_end = gtsam.Rot3()
        for turn in (gyro - gyro_bias) * self._durations_s()[:, None]:
            start_R_end = start_R_end * gtsam.Rot3.Expmap(turn)
        return start_R_end

    @staticmethod
    def chained(turns: FloatArray) -> FloatArray:
        """Rotations start_R_body (N + 1, 3, 3) at samples from those (N, 3, 3) between them."""
        from slam_graph.kernels.chained_turns import chain_turns  # which loads kernels

        rotations = np.empty((len(turns) + 1, 3, 3))
        chain_turns(np.ascontiguousarray(turns), rotations)
        return rotations

    def preintegrated(
        self, bias: gtsam.imuBias.ConstantBias, params: gtsam.PreintegrationCombinedParams
    ) -> gtsam.PreintegratedCombinedMeasurements:
        """Preintegration from the first to the last of at least two samples (Forster et al. 2017).

        Args:
            bias: at which the integration is linearised.
            params: noise of the IMU (`ImuNoise.preintegration_params`).
        """
        return self.short_steps().preintegrated(bias, params)

    def short_steps(self) -> ImuSteps:
        """The steps between samples, none longer than what is integrated at once."""
        durations_s, gyro, accel = self.steps()
        if durations_s.max() > _LONGEST_STEP_S:
            pieces = self.pieces()
            durations_s, gyro, accel = (
                np.repeat(values, pieces, axis=0) for values in (durations_s / pieces, gyro, accel)
            )
        return ImuSteps(durations_s, gyro, accel)

    def steps(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Durations (N - 1,) in s between samples, mean rates and specific forces (N - 1, 3)."""
        gyro = 0.5 * (self.gyro[1:] + self.gyro[:-1])
        accel = 0.5 * (self.accel[1:] + self.accel[:-1])
        return self._durations_s(), gyro, accel

    def pieces(self) -> IntArray:
        """In how many steps each time (N - 1,) between samples is integrated."""
        pieces = np.ceil(self._durations_s() / _LONGEST_STEP_S - 1e-6)
        return np.clip(pieces, 1, _MOST_STEPS).astype(np.int64)

    def _durations_s(self) -> FloatArray:
        """Durations (N - 1,) in s between samples."""
        return np.asarray((self.stamps_ns[1:] - self.stamps_ns[:-1]) * 1e-9, dtype=np.float64)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (N, 3); NumPy's own takes twice as long for so few rows."""
    (a0, a1, a2), (b0, b1, b2), product = a.T, b.T, np.empty_like(a)
    product[:, 0] = a1 * b2 - a2 * b1
    product[:, 1] = a2 * b0 - a0 * b2
    product[:, 2] = a0 * b1 - a1 * b0
    return product


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrame:
    """The images that all cameras of a rig took at one time.

    Attributes:
        stamp_ns: time of the exposure of the first camera that has an image.
        images: one (height, width) uint8 grey image per camera; None where that camera has none.
        depth: (height, width) float32 depth, along the optical axis, of what the camera
            `Rig.depth.camera` sees, in m, NaN where it has none; None without a depth image.
        depth_ns: time at which the depth was measured; None if at `stamp_ns`. It differs where the
            sensor is not synchronised with the camera.
    """

    stamp_ns: int
    images: tuple[NDArray[np.uint8] | None, ...]
    depth: NDArray[np.float32] | None = None
    depth_ns: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FeatureObservations:
    """The features that one camera sees in one frame.

    Attributes:
        ids: (N,) int64, unique within the camera; the same id in another frame or camera is the
            same point of the world.
        pixels: (N, 2) raw (distorted) pixel coordinates (u, v).
        normalized: (N, 2) undistorted coordinates on the plane z = 1 of the camera frame.
        descriptors: (N, B) binary descriptors of B bytes, compared by their Hamming distance; None
            where there are none.
        depth_m: (N,) measured depths along the optical axis in m, NaN where a feature has none;
            None where the camera has no depth.
        depth_sigma_m: (N,) their standard deviations in m, NaN where `depth_m` is; None together
            with it.
        labels: (N,) label of the mask that each is in, 0 outside of all; None without masks.
    """

    ids: IntArray
    pixels: FloatArray
    normalized: FloatArray
    descriptors: NDArray[np.uint8] | None = None
    depth_m: FloatArray | None = None
    depth_sigma_m: FloatArray | None = None
    labels: IntArray | None = None

    def __len__(self) -> int:
        return len(self.ids)

    @staticmethod
    def empty() -> FeatureObservations:
        """No features."""
        return FeatureObservations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))

    def joined(self, other: FeatureObservations) -> FeatureObservations:
        """These and others of the same image, without descriptors.

        Where only one of the two has depths, those of the other are NaN. Labels are those of both,
        if both have them.
        """
        parts = (self, other)
        labels = [seen.labels for seen in parts if seen.labels is not None]
        depth_m = depth_sigma_m = None
        if any(seen.depth_m is not None for seen in parts):
            depth_m = np.concatenate([_or_unknown(p.depth_m, len(p)) for p in parts])
            depth_sigma_m = np.concatenate([_or_unknown(p.depth_sigma_m, len(p)) for p in parts])
        return FeatureObservations(
            np.concatenate([seen.ids for seen in parts]),
            np.concatenate([seen.pixels for seen in parts]),
            np.concatenate([seen.normalized for seen in parts]),
            None,
            depth_m,
            depth_sigma_m,
            np.concatenate(labels) if len(labels) == 2 else None,
        )

    def select(self, rows: BoolArray) -> FeatureObservations:
        """Those where `rows` (N,) holds."""
        return FeatureObservations(
            self.ids[rows],
            self.pixels[rows],
            self.normalized[rows],
            None if self.descriptors is None else self.descriptors[rows],
            None if self.depth_m is None else self.depth_m[rows],
            None if self.depth_sigma_m is None else self.depth_sigma_m[rows],
            None if self.labels is None else self.labels[rows],
        )

    def left_out(self, rows: BoolArray) -> FeatureObservations:
        """Those where `rows` (N,) does not hold; these themselves where it does nowhere."""
        return self.select(~rows) if np.count_nonzero(rows) else self


def _or_unknown(depths: FloatArray | None, count: int) -> FloatArray:
    """Depths (N,), or NaN where there are none."""
    return np.full(count, np.nan) if depths is None else depths


@dataclass(frozen=True, slots=True, eq=False)
class FeatureFrame:
    """The features of the images taken at one time: all that the back end uses of them.

    Attributes:
        stamp_ns: time of the frame.
        cameras: the observations of each camera of the rig, in the rig's order; empty where a
            camera has no image.
        outliers: for those who watch, where each camera saw the features that the front end has
            just rejected; empty where it does not say. They are no observations.
        moving: the observations of each camera of features that move by themselves; empty where
            these are not followed. They are not among those of `cameras`.
    """

    stamp_ns: int
    cameras: tuple[FeatureObservations, ...]
    outliers: tuple[FeatureObservations, ...] = ()
    moving: tuple[FeatureObservations, ...] = ()
    _ids: IntArray | None = field(default=None, init=False, repr=False)

    @property
    def features(self) -> int:
        """The number of features in the camera that sees most of them."""
        return max((len(camera.ids) for camera in self.cameras), default=0)

    @property
    def ids(self) -> IntArray:
        """The features (N,) that any camera sees, ascending. All callers share the array."""
        if self._ids is None:  # several parts of the back end ask for them
            ids = ascending_union(*(camera.ids for camera in self.cameras))
            object.__setattr__(self, "_ids", ids)
        assert self._ids is not None
        return self._ids

    @property
    def whole(self) -> FeatureFrame:
        """The frame with the features that move by themselves among the others."""
        if not self.moving:
            return self
        pairs = zip(self.cameras, self.moving, strict=True)
        return FeatureFrame(self.stamp_ns, tuple(static.joined(moving) for static, moving in pairs))

    def only(self, ids: IntArray) -> FeatureFrame:
        """The frame with these features only."""
        ascending = np.sort(ids)
        cameras = (c.select(_one_of_ascending(c.ids, ascending)) for c in self.cameras)
        return FeatureFrame(self.stamp_ns, tuple(cameras))

    def usable(self, cameras: int) -> tuple[FeatureFrame, int]:
        """The frame with as many cameras, without observations that are not finite.

        Args:
            cameras: of the rig; those that are missing have no observations.

        Returns:
            The frame, and how many observations were left out.
        """
        missing = (FeatureObservations.empty(),) * (cameras - len(self.cameras))
        seen = self.cameras + missing
        with np.errstate(invalid="ignore", over="ignore"):  # ∞ - ∞, a sum past all numbers
            finite = all(math.isfinite(c.pixels.sum() + c.normalized.sum()) for c in seen)
        if finite:
            return (FeatureFrame(self.stamp_ns, seen) if missing else self), 0
        good = [np.all(np.isfinite(np.hstack([c.pixels, c.normalized])), axis=1) for c in seen]
        bad = sum(int(np.sum(~rows)) for rows in good)
        if not bad:
            return (FeatureFrame(self.stamp_ns, seen) if missing else self), 0
        usable = (c.select(rows) for c, rows in zip(seen, good, strict=True))
        return FeatureFrame(self.stamp_ns, tuple(usable)), bad

    def without(self, ids: IntArray) -> FeatureFrame:
        """The frame without these features."""
        if len(ids) == 0:
            return self
        ascending = np.sort(ids)
        cameras = (c.left_out(_one_of_ascending(c.ids, ascending)) for c in self.cameras)
        return FeatureFrame(self.stamp_ns, tuple(cameras))


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """An element of a sequence: a frame and the IMU samples up to it.

    Attributes:
        imu: the samples after those of the previous packet, up to and including the first one at
            or after `frame.stamp_ns` (if there is one). So consecutive packets partition the IMU
            stream, and the IMU can be interpolated at the time of the frame.
        frame: images, or features that were found in them before.
        aiding: fixes and odometry after the frame before, up to and including the first sample of
            the odometry at or after this one; None where there are none.
    """

    imu: ImuData
    frame: CameraFrame | FeatureFrame
    aiding: AidingData | None = None


def _one_of_ascending(values: IntArray, ascending: IntArray) -> BoolArray:
    """Which values (N,) are among some ascending ones (M,); NumPy's `isin` takes far longer.

    `kernels.ascending.are_among` is faster, but has to load Numba.
    """
    if len(ascending) == 0:
        return np.zeros(len(values), np.bool_)
    places = np.minimum(ascending.searchsorted(values), len(ascending) - 1)
    return np.asarray(ascending[places] == values)
