# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The alignment of the estimator's own world with that of absolute measurements.

Cameras and IMU know neither where they are nor in which direction north is; without an IMU not even
where down is. Fixes along a path tell it: the motion of the world, in position and yaw or in all
six degrees of freedom, that brings the path to the fixes. A few known orientations tell the
rotation without a path. Some fixes are wrong by far (multipath, ambiguous tags), so it is found by
graduated non-convexity with the loss of Geman and McClure (Yang, Antonante, Tzoumas & Carlone
2020).

The clock of the fixes may be off by a time that is known to some extent only. Then that time is one
more unknown: a fix that is late by τ is where the path was τ before, along its velocity. The same
holds for the place of the antenna in the body, which moves the fixes as the body turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend.aiding.fix_factors import Fix, OrientationFix, PositionFix
from slam_graph.backend.world_gauge import turned_axes
from slam_graph.errors import DataError
from slam_graph.geometry import Similarity

MIN_FIXES = 8
"""Fewer positions show no outliers among them."""
_MIN_ORIENTATIONS = 3
"""Fewer orientations do not; each of them tells the whole rotation."""
_LEAST_SHARE = 0.6
"""Part of the fixes that must fit."""
_SINGULAR = 1e12
"""Condition number from which the fixes tell no world, with every unknown in units of its own."""
_ROTATION_SIGMA_RAD = 0.03
"""Largest standard deviation of a rotation that counts as known: the engine is linear over it."""
_WIDTH = 3.4
"""Residuals (σ) beyond which a fix is an outlier: the 99 % sphere."""
_SHRINKING = 1.4
"""Factor by which the loss comes nearer to that of outliers from one step to the next."""
_STEPS = 4
"""Gauss-Newton steps at the end."""
_KEPT_SIGMA_M = 1e-3
"""Standard deviation of the position of a world that only orientations are known of: it stays."""


@dataclass(frozen=True, slots=True, eq=False)
class PathFix:
    """A fix and the estimate at its time.

    Attributes:
        fix: the measurement.
        pose: of the body then, in the estimator's own world.
        position_variance: of that pose, the sum of its axes, m².
        rotation_variance: the same of its orientation, rad².
        velocity: (3,) of the sensor there, m/s; zero if the time of the fix is known.
    """

    fix: Fix
    pose: gtsam.Pose3
    position_variance: float = 0.0
    rotation_variance: float = 0.0
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))

    def after_drift(self, position: float, rotation: float) -> PathFix:
        """The same with the noise that the drift since then adds.

        Args:
            position: variance of the position now, as above.
            rotation: the same of the orientation.
        """
        grown = position - self.position_variance
        if isinstance(self.fix, OrientationFix):
            grown = rotation - self.rotation_variance
        noise = self.fix.covariance + max(grown, 0.0) * np.eye(3)
        return replace(self, fix=replace(self.fix, covariance=noise))


@dataclass(frozen=True, slots=True, eq=False)
class WorldAlignment:
    """Where the estimator's world is in that of the fixes.

    Attributes:
        motion: fixes_T_own of the two worlds.
        covariance: of the gauge after the motion, (4, 4) or (6, 6), in the order of
            `world_gauge`: position (m), then yaw or rotation (rad).
        centre: (3,) the point about which the world turns, in the world of the fixes.
        fits: (N,) which fixes fit.
        offset_s: to be added to the times of fixes with a velocity.
        offset_sigma_s: its standard deviation; zero if it is known.
        arm_m: (3,) to be added to the lever arm of these fixes.
        joint_covariance: of position (m) and yaw or rotation (rad), then of the offset (s), then of
            the lever arm (m), as far as these are unknown.
    """

    motion: gtsam.Pose3
    covariance: FloatArray
    centre: FloatArray
    fits: BoolArray
    offset_s: float = 0.0
    offset_sigma_s: float = 0.0
    arm_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    joint_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))


def enough_fixes(fixes: Sequence[Fix]) -> bool:
    """Whether so many fixes may tell a world, with outliers among them."""
    orientations = sum(isinstance(fix, OrientationFix) for fix in fixes)
    return len(fixes) - orientations >= MIN_FIXES or orientations >= _MIN_ORIENTATIONS


def align_world(
    pairs: Sequence[PathFix],
    centre: FloatArray,
    level: bool,
    offset: tuple[float, float] = (0.0, 0.0),
    arm: tuple[FloatArray, float] | None = None,
) -> WorldAlignment | None:
    """The motion that brings a path to fixes of it; None as long as they do not tell it.

    Args:
        pairs: N fixes with the path; the covariances are those of their differences.
        centre: (3,) the point, in the world of the estimate, about which the world turns.
        level: whether gravity is measured, so that the motion is one in position and yaw.
        offset: mean and standard deviation of what is to be added to the times of fixes with a
            velocity, s; none is sought if the latter is zero.
        arm: mean (3,) and standard deviation of what is to be added to the lever arm of the same
            fixes, m; None if it is known.
    """
    if not enough_fixes([pair.fix for pair in pairs]):
        return None
    path = _Path.of(pairs, centre, level, _Unknowns.of(offset, arm))
    motion = path.start()
    if motion is None:
        return None
    extra = path.unknowns.expected
    distances = path.distances(motion, extra)
    scale = max(2.0 * float(distances.max() / _WIDTH) ** 2, 1.0)
    while scale > 1.0:  # the loss is nearly quadratic at first
        weights = (scale * _WIDTH**2 / (distances**2 + scale * _WIDTH**2)) ** 2
        motion, extra, _ = path.step(motion, extra, weights)
        distances = path.distances(motion, extra)
        scale /= _SHRINKING
    information = np.zeros((4, 4))
    for _ in range(_STEPS):
        fits = distances < _WIDTH
        if not path.supported(fits):
            return None
        motion, extra, information = path.step(motion, extra, fits.astype(np.float64))
        distances = path.distances(motion, extra)
    units = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(np.float64).tiny))
    if np.linalg.cond(information * np.outer(units, units)) > _SINGULAR:
        return None
    whole = np.asarray(np.linalg.inv(information), np.float64)
    gauge, timed = len(whole) - len(extra), offset[1] > 0.0
    covariance = whole[:gauge, :gauge]
    late = float(extra[0]) if timed else 0.0
    sigma_s = float(np.sqrt(whole[gauge, gauge])) if timed else 0.0
    if np.sqrt(np.diag(covariance)[3:].max()) > _ROTATION_SIGMA_RAD:
        return None
    fitting = np.zeros(len(fits), np.bool_)
    fitting[path.order] = fits
    there = _moved(motion, centre[None])[0]
    added = np.zeros(3) if arm is None else extra[-3:]
    return WorldAlignment(motion, covariance, there, fitting, late, sigma_s, added, whole)


@dataclass(frozen=True, slots=True, eq=False)
class _Unknowns:
    """What is not known of the sensor whose time may be estimated: its clock, its place, or both.

    Attributes:
        expected: (n,) time offset (s), then lever arm (m), beyond what pairs were made with.
        sigmas: (n,) standard deviations.
        timed: whether the time offset is one of them.
        placed: whether the lever arm is.
    """

    expected: FloatArray
    sigmas: FloatArray
    timed: bool
    placed: bool

    @staticmethod
    def of(offset: tuple[float, float], arm: tuple[FloatArray, float] | None) -> _Unknowns:
        """See `align_world`."""
        timed, placed = offset[1] > 0.0, arm is not None
        mean = [offset[0]] * timed + (list(arm[0]) if arm is not None else [])
        sigmas = [offset[1]] * timed + ([arm[1]] * 3 if arm is not None else [])
        return _Unknowns(np.array(mean, float), np.array(sigmas, float), timed, placed)

    def moving(self, pair: PathFix) -> FloatArray:
        """How (3, n) the sensor of a position moves with them, in the estimator's own world."""
        columns = np.zeros((3, len(self.expected)))
        if self.timed:
            columns[:, 0] = pair.velocity
        if self.placed and pair.fix.is_timed:
            columns[:, -3:] = pair.pose.rotation().matrix()
        return columns


@dataclass(frozen=True, slots=True, eq=False)
class _Path:
    """Residuals of N fixes, of which the first P are positions.

    Attributes:
        places, fixes: (P, 3) estimated and measured positions of the sensor.
        turns, orientations: (N - P, 3, 3) estimated and measured orientations of the body.
        roots: (N, 3, 3) whiten the residuals.
        order: (N,) numbers of the fixes as they were given.
        centre: (3,) the point about which the world turns, in the estimator's own world.
        level: whether the motion is one in position and yaw.
        moving: (P, 3, n) how the sensor moves with the unknowns.
        unknowns: n of them.
    """

    places: FloatArray
    fixes: FloatArray
    turns: FloatArray
    orientations: FloatArray
    roots: FloatArray
    order: list[int]
    centre: FloatArray
    level: bool
    moving: FloatArray
    unknowns: _Unknowns

    @staticmethod
    def of(pairs: Sequence[PathFix], centre: FloatArray, level: bool, unknowns: _Unknowns) -> _Path:
        """See `align_world`."""
        positions: list[tuple[FloatArray, FloatArray]] = []
        rotations: list[tuple[FloatArray, FloatArray]] = []
        noise: tuple[list[FloatArray], list[FloatArray]] = [], []
        order: tuple[list[int], list[int]] = [], []
        for number, pair in enumerate(pairs):
            fix = pair.fix
            if isinstance(fix, PositionFix):
                positions.append((fix.of(pair.pose), fix.position))
            else:
                estimated = pair.pose.rotation().matrix()
                rotations.append((estimated, fix.world_R_body.matrix()))
            kind = int(isinstance(fix, OrientationFix))
            noise[kind].append(fix.covariance)
            order[kind].append(number)
        places, fixes = np.array(positions).reshape(-1, 2, 3).transpose(1, 0, 2)
        turns, orientations = np.array(rotations).reshape(-1, 2, 3, 3).transpose(1, 0, 2, 3)
        covariances: FloatArray = np.array(noise[0] + noise[1])
        roots: FloatArray = np.linalg.inv(np.linalg.cholesky(covariances))
        given = order[0] + order[1]
        moving = np.zeros((len(order[0]), 3, len(unknowns.expected)))
        for row, n in enumerate(order[0]):
            moving[row] = unknowns.moving(pairs[n])
        return _Path(
            places, fixes, turns, orientations, roots, given, centre, level, moving, unknowns
        )

    def start(self) -> gtsam.Pose3 | None:
        """A motion to begin with; None if the fixes tell none."""
        if len(self.turns) < _MIN_ORIENTATIONS:
            try:
                found = Similarity.of_positions(
                    self.fixes, self.places, "yaw" if self.level else "se3", doubtful=True
                )
            except DataError:
                return None
            return gtsam.Pose3(gtsam.Rot3(found.rotation), found.translation)
        turns = Rotation.from_matrix(self.orientations @ self.turns.transpose(0, 2, 1))
        # the one nearest to the others: a mean would follow ambiguous ones
        apart = [float(np.median((turn.inv() * turns).magnitude())) for turn in turns]
        R = turns[int(np.argmin(apart))].as_matrix()
        if self.level:
            R = gtsam.Rot3.Yaw(gtsam.Rot3(R).yaw()).matrix()
        shift = self.centre - R @ self.centre
        if len(self.places):
            shift = np.median(self.fixes - self.places @ R.T, axis=0)
        return gtsam.Pose3(gtsam.Rot3(R), shift)

    def supported(self, fits: BoolArray) -> bool:
        """Whether enough fixes (N,) fit, of those that tell the rotation."""
        among = fits[: len(self.places)]
        least = MIN_FIXES
        if len(self.turns) >= _MIN_ORIENTATIONS:
            turned = fits[len(self.places) :]
            if np.count_nonzero(turned) < max(2, _LEAST_SHARE * len(turned)):
                return False
            least = min(2, len(among))
        return bool(np.count_nonzero(among) >= max(least, _LEAST_SHARE * len(among)))

    def residuals(self, motion: gtsam.Pose3, extra: FloatArray) -> FloatArray:
        """(N, 3) what was measured beyond the moved path, m or rad, not whitened.

        Args:
            motion: of the world.
            extra: (n,) the unknowns of the sensor.
        """
        turned = motion.rotation().matrix() @ self.turns
        off = Rotation.from_matrix(self.orientations @ turned.transpose(0, 2, 1)).as_rotvec()
        moved = _moved(motion, self.places + self.moving @ extra)
        return np.concatenate([self.fixes - moved, off.reshape(-1, 3)])

    def distances(self, motion: gtsam.Pose3, extra: FloatArray) -> FloatArray:
        """Residuals (N,) in σ."""
        white = np.einsum("nij,nj->ni", self.roots, self.residuals(motion, extra))
        return np.asarray(np.linalg.norm(white, axis=1))

    def step(
        self, motion: gtsam.Pose3, extra: FloatArray, weights: FloatArray
    ) -> tuple[gtsam.Pose3, FloatArray, FloatArray]:
        """One Gauss-Newton step, and the information on the gauge and the unknowns of the sensor.

        Args:
            motion: of the world.
            extra: (n,) these unknowns.
            weights: (N,) of the fixes.
        """
        moved, axes = _moved(motion, self.places + self.moving @ extra), turned_axes(self.level)
        middle, count, turned = _moved(motion, self.centre[None])[0], len(moved), 3 + len(axes)
        unknowns = self.unknowns
        J = np.zeros((len(weights), 3, turned + len(extra)))
        J[:count, :, :3] = np.eye(3)
        J[:count, :, 3:turned] = np.cross(axes, (moved - middle)[:, None]).transpose(0, 2, 1)
        J[count:, :, 3:turned] = axes.T
        J[:count, :, turned:] = motion.rotation().matrix() @ self.moving
        roots = np.sqrt(weights)[:, None, None] * self.roots
        white = (roots @ J).reshape(-1, J.shape[2])
        right = np.einsum("nij,nj->ni", roots, self.residuals(motion, extra)).reshape(-1)
        known, of_known = np.zeros((3 + len(extra), J.shape[2])), np.zeros(3 + len(extra))
        if not count:
            known[:3, :3] = np.eye(3) / _KEPT_SIGMA_M
        known[3:, turned:] = np.diag(1.0 / unknowns.sigmas)
        of_known[3:] = (unknowns.expected - extra) / unknowns.sigmas
        white, right = np.vstack([white, known]), np.concatenate([right, of_known])
        delta = np.linalg.lstsq(white, right, rcond=None)[0]
        turn = gtsam.Rot3.Expmap(axes.T @ delta[3:turned])
        # x -> turn (x - middle) + middle + shift
        shift = middle + delta[:3] - turn.rotate(middle)
        extra = extra + delta[turned:]
        return gtsam.Pose3(turn, shift).compose(motion), extra, white.T @ white


def _moved(motion: gtsam.Pose3, places: FloatArray) -> FloatArray:
    """Positions (N, 3) after a motion."""
    moved: FloatArray = places @ motion.rotation().matrix().T + motion.translation()
    return moved
