# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A path and fixes of it: how far they are apart in a moved world, and the steps to the least.

The world is moved as a body, and the path of a camera that does not know its unit of length is
scaled before that. See `world_alignment.py`.
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
from slam_graph.geometry import AlignmentMode, Similarity

MIN_FIXES = 8
"""Fewer positions show no outliers among them."""
MIN_ORIENTATIONS = 3
"""Fewer orientations do not; each of them tells the whole rotation."""
_LEAST_SHARE = 0.6
"""Part of the fixes that must fit."""
_KEPT_SIGMA_M = 1e-3
"""Standard deviation of the position of a world that only orientations are known of: it stays."""


@dataclass(frozen=True, slots=True, eq=False)
class PathFix:
    """A fix and the estimate at its time.

    Lengths of the pose, its variances and its velocity are in the unit of the estimator's own
    world.

    Attributes:
        fix: the measurement.
        pose: of the body then, in the estimator's own world.
        position_variance: of that pose, the sum of its axes, m².
        rotation_variance: the same of its orientation, rad².
        velocity: (3,) of the sensor there, m/s; zero if the time of the fix is known.
        drift: variance that the pose has gained since, m² or rad², the sum of its axes, which is
            taken for each of them.
    """

    fix: Fix
    pose: gtsam.Pose3
    position_variance: float = 0.0
    rotation_variance: float = 0.0
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))
    drift: float = 0.0

    def after_drift(self, position: float, rotation: float) -> PathFix:
        """The same with the noise that the drift since then adds.

        Args:
            position: variance of the position now, as above.
            rotation: the same of the orientation.
        """
        grown = position - self.position_variance
        if isinstance(self.fix, OrientationFix):
            grown = rotation - self.rotation_variance
        return replace(self, drift=max(grown, 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class WorldGuess:
    """Where the world may be.

    Attributes:
        motion: fixes_T_own of the two worlds, after the scaling.
        scale: of the path of the camera.
        extra: (n,) the unknowns of the sensor.
    """

    motion: gtsam.Pose3
    scale: float
    extra: FloatArray

    def moved(self, places: FloatArray, scaled: FloatArray) -> FloatArray:
        """Positions (N, 3) after scaling and motion.

        Args:
            places: (N, 3).
            scaled: (N, 3) the part of them that is scaled; the rest is in metres.
        """
        R = self.motion.rotation().matrix()
        moved: FloatArray = (places + (self.scale - 1.0) * scaled) @ R.T
        return moved + self.motion.translation()

    def changed(self, delta: FloatArray, middle: FloatArray, axes: FloatArray) -> WorldGuess:
        """After an increment of the gauge about a point, and of the unknowns of the sensor.

        Args:
            delta: shift (m), turn (rad), logarithm of the scale where it is sought, unknowns.
            middle: (3,) the point.
            axes: (a, 3) of the turn.
        """
        turned = 3 + len(axes)
        metric = len(delta) == turned + len(self.extra)
        growth = 0.0 if metric else float(np.expm1(delta[turned]))
        turn = gtsam.Rot3.Expmap(axes.T @ delta[3:turned])
        # x -> turn (x - middle) + middle + shift
        shift = middle + delta[:3] - turn.rotate(middle)
        t = self.motion.translation()
        grown = gtsam.Pose3(self.motion.rotation(), t + growth * (t - middle))
        extra = self.extra + delta[len(delta) - len(self.extra) :]
        motion = gtsam.Pose3(turn, shift).compose(grown)
        return WorldGuess(motion, self.scale + growth * self.scale, extra)


@dataclass(frozen=True, slots=True, eq=False)
class SensorUnknowns:
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
    def of(offset: tuple[float, float], arm: tuple[FloatArray, float] | None) -> SensorUnknowns:
        """See `align_world`."""
        timed, placed = offset[1] > 0.0, arm is not None
        mean = [offset[0]] * timed + (list(arm[0]) if arm is not None else [])
        sigmas = [offset[1]] * timed + ([arm[1]] * 3 if arm is not None else [])
        return SensorUnknowns(np.array(mean, float), np.array(sigmas, float), timed, placed)

    def moving(self, pair: PathFix) -> FloatArray:
        """How (3, n) the sensor of a position moves with them, in the estimator's own world."""
        columns = np.zeros((3, len(self.expected)))
        if self.timed:
            columns[:, 0] = pair.velocity
        if self.placed and pair.fix.is_timed:
            columns[:, -3:] = pair.pose.rotation().matrix()
        return columns

    def units(self, scale: float) -> FloatArray:
        """Metres (n,) per unit of what `moving` says; a velocity is that of the path."""
        units = np.ones(len(self.expected))
        if self.timed:
            units[0] = scale
        return units


@dataclass(frozen=True, slots=True, eq=False)
class PathOfFixes:
    """Residuals of N fixes, of which the first P are positions.

    Attributes:
        places, fixes: (P, 3) estimated and measured positions of the sensor.
        scaled: (P, 3) what of the estimated ones is scaled: where the camera was; zero for metres.
        turns, orientations: (N - P, 3, 3) estimated and measured orientations of the body.
        noise: (N, 3, 3) covariances of the fixes.
        drifts: (N,) variances that the path has gained since.
        roots: (N, 3, 3) whiten the residuals.
        order: (N,) numbers of the fixes as they were given.
        centre: (3,) the point about which the world turns, in the estimator's own world.
        level: whether the motion is one in position and yaw.
        has_scale: whether the path is in metres.
        moving: (P, 3, n) how the sensor moves with the unknowns.
        unknowns: n of them.
    """

    places: FloatArray
    fixes: FloatArray
    scaled: FloatArray
    turns: FloatArray
    orientations: FloatArray
    noise: FloatArray
    drifts: FloatArray
    roots: FloatArray
    order: list[int]
    centre: FloatArray
    level: bool
    has_scale: bool
    moving: FloatArray
    unknowns: SensorUnknowns

    @staticmethod
    def of(
        pairs: Sequence[PathFix],
        centre: FloatArray,
        level: bool,
        unknowns: SensorUnknowns,
        scaled_camera: gtsam.Pose3 | None,
    ) -> PathOfFixes:
        """See `align_world`."""
        located = [isinstance(pair.fix, PositionFix) for pair in pairs]
        order = np.argsort(np.logical_not(located), kind="stable").tolist()
        places: list[FloatArray] = []
        scaled: list[FloatArray] = []
        turns: list[FloatArray] = []
        measured: tuple[list[FloatArray], list[FloatArray]] = [], []
        for pair in pairs:
            fix, pose = pair.fix, pair.pose
            if isinstance(fix, PositionFix):
                places.append(fix.of(pose))
                measured[0].append(fix.position)
                at = None if scaled_camera is None else scaled_camera.translation()
                scaled.append(np.zeros(3) if at is None else pose.transformFrom(at))
            else:
                turns.append(pose.rotation().matrix())
                measured[1].append(fix.world_R_body.matrix())
        return PathOfFixes(
            places=np.reshape(places, (-1, 3)),
            fixes=np.reshape(measured[0], (-1, 3)),
            scaled=np.reshape(scaled, (-1, 3)),
            turns=np.reshape(turns, (-1, 3, 3)),
            orientations=np.reshape(measured[1], (-1, 3, 3)),
            noise=np.array([pairs[n].fix.covariance for n in order]),
            drifts=np.array([pairs[n].drift for n in order]),
            roots=np.zeros((0, 3, 3)),
            order=order,
            centre=centre,
            level=level,
            has_scale=scaled_camera is None,
            moving=np.array([unknowns.moving(pairs[n]) for n in order[: len(places)]]).reshape(
                len(places), 3, len(unknowns.expected)
            ),
            unknowns=unknowns,
        )

    def in_unit(self, scale: float) -> PathOfFixes:
        """With the noise that the drift of the path adds in metres.

        Args:
            scale: metres per unit of length of the path.
        """
        drifts = self.drifts.copy()
        drifts[: len(self.places)] *= scale**2
        covariances = self.noise + drifts[:, None, None] * np.eye(3)
        return replace(self, roots=np.linalg.inv(np.linalg.cholesky(covariances)))

    def start(self) -> WorldGuess | None:
        """Where to begin; None if the fixes tell nothing."""
        if len(self.turns) < MIN_ORIENTATIONS:
            mode: AlignmentMode = "yaw" if self.level else "se3" if self.has_scale else "sim3"
            places = self.places if self.has_scale else self.scaled
            try:
                found = Similarity.of_positions(self.fixes, places, mode, doubtful=True)
            except DataError:
                return None
            motion = gtsam.Pose3(gtsam.Rot3(found.rotation), found.translation)
            return WorldGuess(motion, found.scale, self.unknowns.expected)
        turns = Rotation.from_matrix(self.orientations @ self.turns.transpose(0, 2, 1))
        # the one nearest to the others: a mean would follow ambiguous ones
        apart = [float(np.median((turn.inv() * turns).magnitude())) for turn in turns]
        R = turns[int(np.argmin(apart))].as_matrix()
        if self.level:
            R = gtsam.Rot3.Yaw(gtsam.Rot3(R).yaw()).matrix()
        scale = 1.0 if self.has_scale else self._scale_under(R)
        if scale <= 0.0:
            return None
        shift = self.centre - R @ self.centre
        if len(self.places):
            places = self.places + (scale - 1.0) * self.scaled
            shift = np.median(self.fixes - places @ R.T, axis=0)
        return WorldGuess(gtsam.Pose3(gtsam.Rot3(R), shift), scale, self.unknowns.expected)

    def _scale_under(self, R: FloatArray) -> float:
        """The scale of the path after a rotation (3, 3), a weighted median; 0 for none."""
        if len(self.places) < MIN_FIXES:
            return 0.0
        way = self.scaled @ R.T
        there = self.fixes - (self.places - self.scaled) @ R.T
        way, there = (points - np.median(points, axis=0) for points in (way, there))
        weights = np.maximum(np.sum(way**2, axis=1), np.finfo(np.float64).tiny)
        ratios = np.sum(way * there, axis=1) / weights
        order = np.argsort(ratios)
        share = np.cumsum(weights[order]) / weights.sum()
        return float(ratios[order[int(np.searchsorted(share, 0.5))]])

    def supported(self, fits: BoolArray) -> bool:
        """Whether enough fixes (N,) fit, of those that tell the rotation."""
        among = fits[: len(self.places)]
        least = MIN_FIXES
        if len(self.turns) >= MIN_ORIENTATIONS:
            turned = fits[len(self.places) :]
            if np.count_nonzero(turned) < max(2, _LEAST_SHARE * len(turned)):
                return False
            least = min(2, len(among))
        return bool(np.count_nonzero(among) >= max(least, _LEAST_SHARE * len(among)))

    def residuals(self, guess: WorldGuess) -> FloatArray:
        """(N, 3) what was measured beyond the moved path, m or rad, not whitened."""
        turned = guess.motion.rotation().matrix() @ self.turns
        off = Rotation.from_matrix(self.orientations @ turned.transpose(0, 2, 1)).as_rotvec()
        return np.concatenate([self.fixes - self._moved(guess), off.reshape(-1, 3)])

    def _moved(self, guess: WorldGuess) -> FloatArray:
        """Positions (P, 3) of the sensor."""
        return guess.moved(self.places + self._moving(guess) @ guess.extra, self.scaled)

    def _moving(self, guess: WorldGuess) -> FloatArray:
        """(P, 3, n) how the sensor moves with its unknowns, in metres."""
        return self.moving * self.unknowns.units(guess.scale)

    def distances(self, guess: WorldGuess) -> FloatArray:
        """Residuals (N,) in σ."""
        white = np.einsum("nij,nj->ni", self.roots, self.residuals(guess))
        return np.asarray(np.linalg.norm(white, axis=1))

    def step(self, guess: WorldGuess, weights: FloatArray) -> tuple[WorldGuess, FloatArray]:
        """One Gauss-Newton step, and the information on the gauge and the unknowns of the sensor.

        Args:
            guess: where to begin.
            weights: (N,) of the fixes.
        """
        moved, axes, unknowns = self._moved(guess), turned_axes(self.level), self.unknowns
        middle, count, turned = guess.moved(*[self.centre[None]] * 2)[0], len(moved), 3 + len(axes)
        gauge = turned + (not self.has_scale)
        J = np.zeros((len(weights), 3, gauge + len(guess.extra)))
        J[:count, :, :3] = np.eye(3)
        J[:count, :, 3:turned] = np.cross(axes, (moved - middle)[:, None]).transpose(0, 2, 1)
        J[count:, :, 3:turned] = axes.T
        if not self.has_scale:
            J[:count, :, turned] = guess.moved(self.scaled, self.scaled) - middle
        J[:count, :, gauge:] = guess.motion.rotation().matrix() @ self._moving(guess)
        roots = np.sqrt(weights)[:, None, None] * self.roots
        white = (roots @ J).reshape(-1, J.shape[2])
        right = np.einsum("nij,nj->ni", roots, self.residuals(guess)).reshape(-1)
        sensor = len(guess.extra)
        known, of_known = np.zeros((3 + sensor, J.shape[2])), np.zeros(3 + sensor)
        if not count:
            known[:3, :3] = np.eye(3) / _KEPT_SIGMA_M
        known[3:, gauge:] = np.diag(1.0 / unknowns.sigmas)
        of_known[3:] = (unknowns.expected - guess.extra) / unknowns.sigmas
        white, right = np.vstack([white, known]), np.concatenate([right, of_known])
        delta = np.linalg.lstsq(white, right, rcond=None)[0]
        return guess.changed(delta, middle, axes), white.T @ white
