# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Zero-velocity updates: standstill detection, and the factors that hold the platform in place.

While a platform stands still a monocular system observes neither scale nor accelerometer bias, and
tracking errors would make the estimate drift. Images and IMU must agree that nothing moves: the
images alone cannot tell standstill from slow motion before a distant scene, and the IMU alone
cannot tell it from slow even motion. Images are compared over the whole window, which tells a
hovering platform (it drifts) from one on the ground. Running motors may shake the IMU.

Features that do not move still differ between two frames by their noise: with a standard deviation
of σ per coordinate, the length of the difference has a Rayleigh distribution of scale √2 σ. So σ is
measured on the tracks, and the limit on the motion is a limit on what the noise does not explain.
"""

from __future__ import annotations

import math
from collections import deque

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V, X

from slam_graph.arrays import BoolArray, FloatArray, IntArray, ascending_union, median
from slam_graph.backend.backend_config import ZeroVelocityConfig
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.cost.robust_loss import MEDIAN_1D
from slam_graph.sensors import FeatureFrame, FeatureObservations, ImuBuffer, ImuData

_DYNAMIC_RATIO = 3.0
"""Disparity over the standstill limit above which a feature is dynamic while the platform is
static; and by which the static features must be below the limit if most features are dynamic."""

_STATIC_SHARE = 1.0 / 3.0
"""Smallest share of the features that must be static; the others may be on moving objects."""

VELOCITY_SIGMA = 0.01
"""Standard deviation of the velocity at a standstill, m/s, where the IMU shows no motion."""
POSITION_SIGMA = 1e-3
"""Standard deviation of the motion between two frames at a standstill, m."""
ROTATION_SIGMA = 1e-3
"""Standard deviation of the rotation between two frames at a standstill, rad."""

_SAMPLING_SIGMAS = 3.0
"""The limits are above what noise alone gives by this many standard deviations of a quantile."""

_NO_NOISE = 1e-6
"""Probability that noise alone moves a feature as far as one that counts as dynamic."""

_GAINED_SPEED = 0.02
"""Change of velocity, beyond what the noise of the IMU gives, that ends a standstill, m/s. It sees
a take-off that noisy images do not see yet."""

_TAKE_OFF_SIGMAS = 10.0
"""Standard deviation of the velocity at a standstill, in units of the speed that was gained within
that limit. In a take-off the velocity of all frames has the direction of the gained speed, while
each factor is taken for a measurement of its own."""

_BRIDGE = 2.0
"""Largest value of a Brownian bridge of unit variance: exceeded with a probability of 7e-4."""

_MAX_GAP = 0.25
"""Longest part of the window without samples of the IMU: held ones would be those of rest."""

_MAX_NOISE_PX = 3.0
"""Noisier tracks are wrong matches, and tell nothing."""

MIN_FEATURES = 5
"""Fewer common features than this do not show whether the image moves."""


class StandstillDetector:
    """Decides for each frame whether the platform has stood still for a while.

    Attributes:
        since_ns: stamp of the first frame of the current standstill, None while moving.
        dynamic: ids (N,) of dynamic features, ascending: those that moved while the platform did
            not, or that were reported by `add_dynamic`. A feature stays dynamic while it is tracked
            by the first camera.
        noise_px: standard deviation of a coordinate of a feature over the window; 0 if not known,
            and where the detector is not enabled.
    """

    def __init__(
        self,
        config: ZeroVelocityConfig,
        max_disparity_px: float | None = None,
        enabled: bool | None = None,
    ) -> None:
        """Start with an empty window.

        Args:
            config: limits on images and IMU.
            max_disparity_px: replaces that of `config`.
            enabled: replaces that of `config`.
        """
        self._config = config
        self._max_disparity_px = max_disparity_px or config.max_disparity_px
        self._enabled = config.enabled if enabled is None else enabled
        self.since_ns: int | None = None
        self.dynamic = np.zeros(0, np.int64)
        self._recent: deque[tuple[int, FeatureObservations]] = deque()
        self.noise_px = 0.0
        self._noises_px: deque[tuple[int, float]] = deque()

    def add_frame(self, imu: ImuBuffer, stamp_ns: int, frame: FeatureFrame) -> float | None:
        """Decide whether images and IMU agree that nothing has moved over the window.

        Args:
            imu: samples up to the frame at least.
            stamp_ns: time of the frame on the clock of the IMU.
            frame: compared by the features of its first camera.

        Returns:
            How far from zero the velocity may be now, as a standard deviation in m/s; None if the
            platform moves.
        """
        start_ns = stamp_ns - round(self._config.window_s * 1e9)
        self._recent.append((stamp_ns, _by_id(frame.cameras[0])))
        while len(self._recent) > 1 and self._recent[1][0] <= start_ns:
            self._recent.popleft()
        if self._enabled:
            self._measure_noise(start_ns)
        velocity_sigma = None
        if self._enabled and self._recent[0][0] <= start_ns and self._images_are_still():
            velocity_sigma = self._sigma_by_imu(imu, start_ns, stamp_ns)
        still = velocity_sigma is not None
        self.dynamic = self.dynamic[is_in(self.dynamic, self._recent[-1][1].ids)]
        if still:
            self._find_dynamic()
        if not still:
            self.since_ns = None
        elif self.since_ns is None:
            self.since_ns = self._recent[0][0]
        return velocity_sigma

    def may_stand(
        self, stamps_ns: IntArray, frames: IntArray, ids: IntArray, pixels: FloatArray
    ) -> BoolArray:
        """Which frames (F,) may be found to stand still, as long as no feature is dynamic.

        If less than a third of the features are where they were at the beginning of the window, it
        does not, whatever the noise of the tracks. That rules nearly all frames of a flight out.

        Args:
            stamps_ns: (F,) times of all frames, ascending.
            frames: (N,) the frame of each observation of the first camera, ascending.
            ids: (N,) its feature.
            pixels: (N, 2) where it is.
        """
        count, start_ns = len(stamps_ns), stamps_ns - round(self._config.window_s * 1e9)
        first = stamps_ns.searchsorted(start_ns, side="right") - 1
        order = np.argsort(ids, kind="stable")
        frames, ids = frames[order], ids[order]
        tracks = np.cumsum(np.diff(ids, prepend=ids[:1]) != 0)
        keys = tracks * count + frames  # ascending
        wanted = tracks * count + first[frames]
        there = np.minimum(keys.searchsorted(wanted), len(keys) - 1)
        common = np.flatnonzero((keys[there] == wanted) & (first[frames] >= 0))
        frames, now, before = frames[common], order[common], order[there[common]]
        motion = pixels[now] - pixels[before]
        noisiest = StandstillDetector(self._config, self._max_disparity_px)
        noisiest.noise_px, motion_px = _MAX_NOISE_PX, self._max_disparity_px
        limit_px = max(
            noisiest._limit_px(motion_px, 0.5, MIN_FEATURES),
            noisiest._limit_px(motion_px / _DYNAMIC_RATIO, _STATIC_SHARE, MIN_FEATURES),
        )
        static = np.hypot(motion[:, 0], motion[:, 1]) < limit_px
        seen, near = (np.bincount(rows, minlength=count) for rows in (frames, frames[static]))
        return (seen >= MIN_FEATURES) & (near >= _STATIC_SHARE * (seen - 1))

    def add_dynamic(self, ids: IntArray) -> None:
        """Add features (N,) that were found to be dynamic in another way."""
        self.dynamic = ascending_union(self.dynamic, ids)

    def _measure_noise(self, start_ns: int) -> None:
        """Measure the noise of the tracks over the window."""
        while self._noises_px and self._noises_px[0][0] < start_ns:
            self._noises_px.popleft()
        sigma = self._noise_of_last_frames() if len(self._recent) > 2 else None
        if sigma is not None:
            self._noises_px.append((self._recent[-1][0], sigma))
        noises_px = [px for _, px in self._noises_px]
        self.noise_px = float(median(np.array(noises_px))) if noises_px else 0.0

    def _noise_of_last_frames(self) -> float | None:
        """The noise by the second differences of the last three frames, with enough features.

        Even motion cancels in them, and their median is that of motion that all features share.
        """
        first, second, third = (self._recent[k][1] for k in (-3, -2, -1))
        if min(len(first), len(second), len(third)) < MIN_FEATURES:
            return None
        ids, common = first.ids, ~is_in(first.ids, self.dynamic)
        places = [f.ids.searchsorted(ids) for f in (second, third)]
        for frame, rows in zip((second, third), places, strict=True):
            common &= frame.ids.take(rows, mode="clip") == ids
        here = common.nonzero()[0]
        if len(here) < MIN_FEATURES:
            return None
        change = third.pixels.take(places[1][here], axis=0) + first.pixels.take(here, axis=0)
        change -= 2.0 * second.pixels.take(places[0][here], axis=0)
        change -= median(change)
        # a second difference of independent errors has the variance (1 + 4 + 1) σ²
        return float(median(np.abs(change).ravel())) / (MEDIAN_1D * math.sqrt(6.0))

    def _limit_px(self, motion_px: float, share: float, features: int) -> float:
        """Limit on a quantile of N differences, for a limit on what is motion in them."""
        quantile = _rayleigh(share)
        density = quantile * (1.0 - share)
        spread = math.sqrt(share * (1.0 - share) / features) / density
        scale_px = math.sqrt(2.0) * self.noise_px
        return math.hypot(motion_px, (quantile + _SAMPLING_SIGMAS * spread) * scale_px)

    def _images_are_still(self) -> bool:
        """Whether the last frame shows what the first and the last but one of the window show."""
        now = self._recent[-1][1]
        references = (self._recent[0][1], self._recent[-2][1])
        if len(self.dynamic):
            now = now.select(~is_in(now.ids, self.dynamic))
        return all(self._is_still_between(before, now) for before in references)

    def _is_still_between(self, before: FeatureObservations, now: FeatureObservations) -> bool:
        """Whether most features are static, or a third of them clearly while the others move.

        The second limit is lower: when the platform moves slowly, the features that move least
        move nearly as much as the median. Where the noise exceeds it, it tells nothing.
        """
        ids, motion = _common_motion_px(before, now)
        if len(ids) < MIN_FEATURES or self.noise_px > _MAX_NOISE_PX:
            return False
        lengths = np.hypot(motion[:, 0], motion[:, 1])
        motion_px = self._max_disparity_px
        if median(lengths) < self._limit_px(motion_px, 0.5, len(ids)):
            # the median of N normal differences has a standard deviation of sqrt(π / 2N) of theirs
            spread = math.sqrt(math.pi / len(ids)) * self.noise_px
            common = float(np.linalg.norm(median(motion)))
            return bool(common < motion_px + _SAMPLING_SIGMAS * spread)
        limit_px = self._limit_px(motion_px / _DYNAMIC_RATIO, _STATIC_SHARE, len(ids))
        if np.count_nonzero(lengths < limit_px) < _STATIC_SHARE * (len(ids) - 1):
            return False  # which spares most frames of a flight the quantile
        return bool(np.quantile(lengths, _STATIC_SHARE) < limit_px < motion_px)

    def _find_dynamic(self) -> None:
        """Add the features that move although the platform stands still."""
        now = self._recent[-1][1]
        noise_px = _rayleigh(1.0 - _NO_NOISE) * np.sqrt(2.0) * self.noise_px
        limit_px = np.hypot(_DYNAMIC_RATIO * self._max_disparity_px, noise_px)
        for _, before in (self._recent[0], self._recent[len(self._recent) // 2], self._recent[-2]):
            ids, motion = _common_motion_px(before, now)
            disparity_px = np.linalg.norm(motion, axis=1)
            self.dynamic = ascending_union(self.dynamic, ids[disparity_px > limit_px])

    def _sigma_by_imu(self, imu: ImuBuffer, start_ns: int, stamp_ns: int) -> float | None:
        """Standard deviation of the velocity, m/s, if rate and force are constant but for noise.

        In the first frames of a take-off the change of the force is still within its limit, and
        the velocity that it gives is not zero.
        """
        if not imu.covers(start_ns):
            return None
        if imu.largest_gap_s(start_ns, stamp_ns) > _MAX_GAP * self._config.window_s:
            return None
        recent = imu.between(start_ns, stamp_ns)
        if np.max(np.std(recent.gyro, axis=0)) >= self._config.max_gyro_std:
            return None
        if np.max(np.std(recent.accel, axis=0)) >= self._config.max_accel_std:
            return None
        gained = _gained_speed(recent)
        if gained >= _GAINED_SPEED:
            return None
        return math.hypot(VELOCITY_SIGMA, _TAKE_OFF_SIGMAS * max(gained, 0.0))


def _gained_speed(imu: ImuData) -> float:
    """Largest change of velocity within some samples that noise does not explain, m/s.

    At a standstill the specific force is constant but for noise. So the cumulative sum of its
    deviations from the mean is a Brownian bridge, of the size that the noise of the samples gives
    it (CUSUM; Page 1954). The noise is that of their differences, which hardly know slow changes.
    """
    if len(imu) < 3:
        return 0.0
    durations_s = np.diff(imu.stamps_ns)[:, None] * 1e-9
    force = 0.5 * (imu.accel[1:] + imu.accel[:-1])
    mean = np.sum(force * durations_s, axis=0) / np.sum(durations_s)
    gained = np.max(np.abs(np.cumsum((force - mean) * durations_s, axis=0)), axis=0)
    noise = np.std(np.diff(imu.accel, axis=0), axis=0) / np.sqrt(2.0)
    explained = _BRIDGE * noise * np.sqrt(np.sum(durations_s**2))
    return float(np.max(gained - explained))


def _rayleigh(share: float) -> float:
    """A quantile of the Rayleigh distribution of scale 1; its density there is q (1 - share)."""
    return math.sqrt(-2.0 * math.log(1.0 - share))


def _by_id(seen: FeatureObservations) -> FeatureObservations:
    """The same observations in ascending order of their ids."""
    if (seen.ids[1:] > seen.ids[:-1]).all():
        return FeatureObservations(seen.ids, seen.pixels, seen.normalized)
    order = np.argsort(seen.ids)
    return FeatureObservations(seen.ids[order], seen.pixels[order], seen.normalized[order])


def _common_motion_px(
    before: FeatureObservations, after: FeatureObservations
) -> tuple[IntArray, FloatArray]:
    """Ids (N,) of common features, and how they moved in the image (N, 2).

    Both are in ascending order of ids.
    """
    common = is_in(after.ids, before.ids).nonzero()[0]
    ids = after.ids[common]
    there = before.ids.searchsorted(ids)
    return ids, after.pixels.take(common, axis=0) - before.pixels.take(there, axis=0)


def zero_velocity_factors(i: int, j: int, velocity_sigma: float) -> list[gtsam.NonlinearFactor]:
    """The pose of frame j equals that of frame i, and its velocity is zero to some m/s."""
    between = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([ROTATION_SIGMA, POSITION_SIGMA], 3))
    still = gtsam.noiseModel.Isotropic.Sigma(3, velocity_sigma)
    return [
        gtsam.BetweenFactorPose3(X(i), X(j), gtsam.Pose3(), between),
        gtsam.PriorFactorVector(V(j), np.zeros(3), still),
    ]
