# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What camera and gyroscope together say of clock, mounting, focal length and shutter.

The rotation between two frames follows from the gyroscope. Under it, bearings f₁, f₂ of a point at
rest and the direction of the translation t lie in one plane, t · (f₁ × R f₂) = 0. All pairs
together give the time offset, the mounting, a factor on the focal lengths, the readout time and the
gyroscope bias in one robust least-squares problem, the directions eliminated. So a fault in one of
them is not taken for one in another. Distances are in units of the deviation that the noise of the
pixels gives them, and directions the eigenvectors that take that deviation into account (Chojnacki
et al. 2000): by squares alone the noise of slow motion would look like a wrong focal length.
Covariances are by the jackknife over blocks of time, because errors of tracks are alike in
neighbouring pairs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, median, skew
from slam_graph.diagnosis.anderson import AndersonSteps
from slam_graph.diagnosis.frame_pairs import FramePair
from slam_graph.diagnosis.gyroscope import Gyroscope
from slam_graph.diagnosis.jackknife import jackknife_covariance
from slam_graph.diagnosis.kinematics import Kinematics
from slam_graph.diagnosis.pair_geometry import rays_of, tangents
from slam_graph.kernels.epipolar_pairs import epipolar_distances, epipolar_moments
from slam_graph.sensors import RigCamera

UNKNOWNS = ("offset", "focal", "readout", "rx", "ry", "rz", "bx", "by", "bz")
"""Those that are estimated unless others are asked for."""
WITH_SCALE = (*UNKNOWNS, "scale")
"""All of them: the scale of the gyroscope looks much like the focal length."""
_PRIOR = np.array([0.2, 0.5, 0.05, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.5])
"""Prior standard deviations: s, logarithm, s, rad, rad/s, logarithm."""
_STEP = np.array([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-4])
"""Steps of the numerical derivatives."""
_LARGEST = np.array([0.03, 0.1, 0.02, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0.1])
"""Largest change of an unknown in one step."""
_CAUCHY = 2.4
"""Residual with half the weight, in units of the noise."""
_SIGMA_OF_MEDIAN = 1.4826
_MOST_STEPS, _PRECISION = 15, 1e-3
_NEAR, _SHORT = 0.1, 0.1
"""Steps are accelerated once all are below this part of the largest; one of so many standard
deviations, of errors that are independent, is the last."""
_DIRECTIONS = 4
"""How often a direction is found again without wrong matches."""
_BLOCK_S = 2.0
"""Errors within so long count as one."""
_BEYOND = 10.0
"""Epipolar distance of a feature beyond the edge of a wide lens, in units of the noise."""
_LEAST_PX = 0.05
"""No noise is smaller than this."""
_LEAST_VARIANCE, _POSITIVE = 0.01, 1e-12
"""Of t · n, as a part of the largest one: towards an epipole distances tell nothing. And what is
added to it."""


@dataclass(frozen=True, eq=False)
class RotationFit:
    """The solution.

    Attributes:
        values: of the unknowns.
        covariance: (10, 10) in the order of `WITH_SCALE`; infinite variances where one is not free.
        noise_px: robust standard deviation of the epipolar distances.
        free: which unknowns were estimated.
    """

    values: Kinematics
    covariance: FloatArray
    noise_px: float
    free: tuple[str, ...]

    @property
    def sigmas(self) -> FloatArray:
        """(10,) standard deviations in the order of `WITH_SCALE`."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=np.float64)

    def turn_from(self, body_R_camera: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The turn (3,) of the camera from a mounting to the one that was found.

        Returns:
            A rotation vector in the frame of the camera, rad, and its covariance (3, 3).
        """
        turn = Rotation.from_matrix(body_R_camera.T @ self.values.body_R_camera).as_rotvec()
        return np.asarray(turn, dtype=np.float64), self.covariance[3:6, 3:6]


@dataclass(frozen=True, eq=False)
class _SeenPairs:
    """What P pairs of frames with N features see, and how the camera turns between them.

    Attributes:
        one, two: (P, N, 3) bearings f₁ and f₂, each in its own camera.
        by_one, by_two: (P, N, 2, 3) their derivatives by the pixels.
        R: (P, 3, 3) first_R_second of the camera.
        least: (P, N) variance of t · n that is assumed at least, for pixels with unit noise.
    """

    one: FloatArray
    two: FloatArray
    by_one: FloatArray
    by_two: FloatArray
    R: FloatArray
    least: FloatArray

    def direction(
        self, weights: FloatArray, by_noise: FloatArray, normalize: bool = False
    ) -> FloatArray:
        """Directions (P, 3) along which second moments of the normals are least.

        Arguments are those of `epipolar_moments`.
        """
        moments = np.empty(self.R.shape)
        seen = self.one, self.two, self.by_one, self.by_two, self.R
        epipolar_moments(*seen, weights, by_noise, normalize, moments)
        return np.asarray(np.linalg.eigh(moments)[1][:, :, 0])

    def distances(
        self, t: FloatArray, with_slopes: bool = False
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Epipolar distances (P, N), pixels, and the deviations of t · n that they are units of.

        Then their derivatives (P, N, 3) by the directions t (P, 3), if they are asked for.
        """
        e, sigma = np.empty(self.least.shape), np.empty(self.least.shape)
        slopes = np.empty(self.one.shape if with_slopes else (0, 0, 0))
        seen = self.one, self.two, self.by_one, self.by_two, self.R
        epipolar_distances(*seen, np.ascontiguousarray(t), self.least, e, sigma, slopes)
        return e, sigma, slopes


class RotationProblem:
    """The pairs as arrays, padded to the same number of features."""

    def __init__(
        self, pairs: list[FramePair], gyroscopes: list[Gyroscope], camera: RigCamera
    ) -> None:
        """Take pairs of one or several parts."""
        self._mounted, self._gyroscopes = camera, gyroscopes
        most = max(len(pair.first) for pair in pairs)
        centre = np.array([camera.camera.cx, camera.camera.cy])
        pixels = np.tile(centre, (2, len(pairs), most, 1))
        self._there = np.zeros((len(pairs), most), bool)
        for p, pair in enumerate(pairs):
            pixels[0, p, : len(pair.first)] = pair.first
            pixels[1, p, : len(pair.first)] = pair.second
            self._there[p, : len(pair.first)] = True
        both = np.broadcast_to(self._there, pixels.shape[:3])
        self._pixels = np.vstack([centre, pixels[both]])  # the first: padding
        self._place = np.zeros(both.shape, int)
        self._place[both] = np.arange(1, len(self._pixels))
        self._t = np.array([[pair.first_s for pair in pairs], [pair.second_s for pair in pairs]])
        self._part = np.array([pair.part for pair in pairs])
        blocks = [(pair.part, int(pair.first_s // _BLOCK_S)) for pair in pairs]
        self._block = np.unique(blocks, axis=0, return_inverse=True)[1].ravel()
        rows = pixels[..., 1] / camera.camera.height - 0.5
        self._row = np.where(self._there, rows, 0.0)
        self._bearings: dict[float, tuple[FloatArray, FloatArray, FloatArray, BoolArray]] = {}
        self._turns: dict[float, tuple[FloatArray, FloatArray, FloatArray]] = {}
        self._latest: tuple[Kinematics, _SeenPairs] | None = None
        self._noises_px: dict[Kinematics, float] = {}

    def bearings(self, focal: float) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Unit bearings (2, P, N, 3) with a factor on the focal lengths, and their derivatives.

        The derivatives (2, P, N, 2, 3) are by the pixels. Then the least variance (P, N) of t · n,
        and which features (P, N) have both bearings: beyond the edge of a wide lens there is none.
        """
        if focal not in self._bearings:
            camera = self._mounted.camera
            scaled = replace(camera, fx=camera.fx * focal, fy=camera.fy * focal)
            points, visible = scaled.visible(self._pixels)
            rays, slopes = rays_of(points, scaled.distort(points)[1])
            slopes[~visible] = 0.0  # they are of no pixel
            squares = np.sum(slopes**2, axis=(1, 2)).take(self._place).sum(axis=0)
            if len(self._bearings) > 4:
                self._bearings.clear()
            self._bearings[focal] = (
                rays.take(self._place, axis=0),  # much faster than by an index
                slopes.take(self._place, axis=0),
                _LEAST_VARIANCE * squares + _POSITIVE,
                self._there & visible.take(self._place).all(axis=0),
            )
        return self._bearings[focal]

    def _seen(self, at: Kinematics) -> _SeenPairs:
        """Bearings of both frames, and the turn between them.

        The last ones are kept: a step asks for those at the same values several times.
        """
        if self._latest is None or self._latest[0] is not at:
            self._latest = at, self._seen_at(at)
        return self._latest[1]

    def _seen_at(self, at: Kinematics) -> _SeenPairs:
        """`_seen` computed anew."""
        f, slopes, least, _ = self.bearings(at.focal)
        C, (body, halfway, rates) = at.body_R_camera, self._gyroscope_turns(at.offset_s)
        if at.readout_s != 0.0:
            seconds, rates = self._row * at.readout_s, (rates - at.bias) / at.scale
            f = f - f @ skew(rates @ C) * seconds[..., None]
        by_bias = (at.bias * (self._t[1] - self._t[0])[:, None])[..., None]
        body = body @ Rotation.from_rotvec(-(halfway @ by_bias)[..., 0]).as_matrix()
        if at.scale != 1.0:
            body = Rotation.from_rotvec(Rotation.from_matrix(body).as_rotvec() / at.scale)
            body = body.as_matrix()
        return _SeenPairs(f[0], f[1], slopes[0], slopes[1], C.T @ body @ C, least)

    def _gyroscope_turns(self, offset_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rotations (P, 3, 3) from the second body of each pair to the first, by the gyroscope.

        With those from the first body to the one halfway, and rates (2, P, 3) in both frames.
        """
        if offset_s not in self._turns:
            t = self._t + offset_s
            R, rates = np.empty((*t.shape, 3, 3)), np.empty((*t.shape, 3))
            for number, gyroscope in enumerate(self._gyroscopes):
                of = self._part == number
                for k in range(2):
                    R[k, of] = gyroscope.orientation(t[k, of])
                    rates[k, of] = gyroscope.rate_at(t[k, of])
            body = R[0].transpose(0, 2, 1) @ R[1]
            half = Rotation.from_matrix(body).as_rotvec() * 0.5
            if len(self._turns) > 4:
                self._turns.clear()
            self._turns[offset_s] = body, Rotation.from_rotvec(-half).as_matrix(), rates
        return self._turns[offset_s]

    def directions(self, at: Kinematics, noise: float) -> FloatArray:
        """Directions (P, 3) of the translations that fit best, robustly."""
        seen, known = self._seen(at), self.bearings(at.focal)[3]
        weights = known.astype(np.float64)
        t = seen.direction(weights, np.zeros(known.shape), normalize=True)
        for _ in range(_DIRECTIONS):
            e, sigma, _ = seen.distances(t)
            scale = np.maximum(_scales(np.abs(e), known), noise)[:, None]
            weights = known / (1.0 + (e / (_CAUCHY * scale)) ** 2) / sigma**2
            t = seen.direction(weights, weights * e**2)
        return t

    def distances(self, at: Kinematics, t: FloatArray) -> FloatArray:
        """Epipolar distances (P, N), pixels."""
        return self._seen(at).distances(t)[0]

    def residuals(self, at: Kinematics, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Epipolar distances (P, N), pixels, and their derivatives (P, 2, N) by the directions."""
        e, _, slopes = self._seen(at).distances(t, with_slopes=True)
        return e, (slopes @ tangents(t)).transpose(0, 2, 1)

    def noise_px(self, at: Kinematics) -> float:
        """Robust standard deviation of the epipolar distances, the directions fitted.

        It is kept: that of a start is asked for several times.
        """
        if at not in self._noises_px:
            e = self._distances_of_all(at, self.directions(at, _LEAST_PX), np.inf)
            self._noises_px[at] = _noise(e) if len(e) else np.inf
        return self._noises_px[at]

    def misfit(self, at: Kinematics, noise: float) -> float:
        """How badly all features fit together: minus their robust logarithmic likelihood.

        Args:
            at: values of the unknowns.
            noise: standard deviation of the epipolar distances, pixels.
        """
        e = self._distances_of_all(at, self.directions(at, noise), _BEYOND * noise)
        squares = np.log1p((e / (_CAUCHY * noise)) ** 2)
        return 0.5 * _CAUCHY**2 * float(np.sum(squares))

    def _distances_of_all(self, at: Kinematics, t: FloatArray, beyond_px: float) -> FloatArray:
        """Epipolar distances (M,) of all features, pixels; `beyond_px` for those without a bearing.

        They must not count as if they fitted: a focal length that puts them beyond the edge of a
        wide lens would look better for each of them.
        """
        known = self.bearings(at.focal)[3]
        return np.asarray(np.where(known, self.distances(at, t), beyond_px)[self._there])

    def solve(
        self,
        start: Kinematics,
        free: tuple[str, ...] = UNKNOWNS,
        precision: float = _PRECISION,
    ) -> RotationFit:
        """Gauss-Newton from a start, accelerated near its end.

        The weights and the noise follow each step, so that it takes off but a part of the distance.

        Args:
            start: values of the unknowns.
            free: which of them are estimated; the others stay as they are.
            precision: steps end where no unknown changes by more than this part of the largest
                change that it may have, or than a small part of its standard deviation.
        """
        columns = [k for k, name in enumerate(WITH_SCALE) if name in free]
        at, noise = start, self.noise_px(start)
        weight = 1.0 / _PRIOR[columns] ** 2
        information = np.zeros((1, len(columns), len(columns)))
        scores = np.zeros((1, len(columns)))
        faster, largest = AndersonSteps(), _LARGEST[columns]
        for _ in range(_MOST_STEPS):
            information, scores = self._normal_equations(at, noise, columns)
            prior = np.zeros(len(WITH_SCALE))
            prior[0], prior[6:9] = at.offset_s - start.offset_s, at.bias
            prior[1] = np.log(at.focal / start.focal)
            prior[2] = at.readout_s - start.readout_s
            prior[9] = np.log(at.scale / start.scale)
            gradient = scores.sum(axis=0) + weight * prior[columns]
            total = information.sum(axis=0) + np.diag(weight)
            step = -np.linalg.solve(total, gradient)
            short = float(step @ total @ step) < _SHORT**2
            if np.all(np.abs(step) < _NEAR * largest):
                step = faster.change(step, total)
            else:
                faster.forget()
            step *= min(1.0, float(np.min(largest / np.maximum(np.abs(step), 1e-12))))
            change = np.zeros(len(WITH_SCALE))
            change[columns] = step
            tried = at.moved(change)
            lower = self.noise_px(tried)
            if lower > 1.5 * noise:
                change *= 0.3
                tried = at.moved(change)
                lower = self.noise_px(tried)
            at, noise = tried, lower
            faster.made(change[columns])
            if short or np.all(np.abs(change) < precision * _LARGEST):
                break
        covariance = np.diag(np.full(len(WITH_SCALE), np.inf))
        covariance[np.ix_(columns, columns)] = jackknife_covariance(
            information, scores, np.diag(weight)
        )
        return RotationFit(at, covariance, noise, free)

    def _normal_equations(
        self, at: Kinematics, noise: float, columns: list[int]
    ) -> tuple[FloatArray, FloatArray]:
        """Information (B, n, n) without the directions, and gradients (B, n), of blocks of time."""
        t = self.directions(at, noise)
        e, by_t = self.residuals(at, t)
        J, known = np.empty((len(e), len(columns), e.shape[1])), self.bearings(at.focal)[3]
        for c, k in enumerate(columns):
            change = np.zeros(len(WITH_SCALE))
            change[k] = _STEP[k]
            moved = at.moved(change)
            J[:, c] = (self.distances(moved, t) - e) / _STEP[k]
            known = known & self.bearings(moved.focal)[3]
        root = np.sqrt(known / (1.0 + (e / (_CAUCHY * noise)) ** 2)) / noise
        e, J, by_t = e * root, J * root[:, None], by_t * root[:, None]
        inner = by_t @ by_t.transpose(0, 2, 1) + 1e-9 * np.eye(2)
        gradients = (J @ e[..., None])[..., 0]  # the directions are at their best: none by them
        J = J - np.linalg.solve(inner, by_t @ J.transpose(0, 2, 1)).transpose(0, 2, 1) @ by_t
        blocks, n = int(self._block.max()) + 1, len(columns)
        information, scores = np.zeros((blocks, n, n)), np.zeros((blocks, n))
        np.add.at(information, self._block, J @ J.transpose(0, 2, 1))
        np.add.at(scores, self._block, gradients)
        return information, scores


def _scales(sizes: FloatArray, there: BoolArray) -> FloatArray:
    """Robust standard deviations (P,) of residuals (P, N); zero where there are none.

    `np.nanmedian` takes many times as long.
    """
    if sizes.shape[1] == 0:
        return np.zeros(len(sizes))
    there = there & np.isfinite(sizes)
    ordered = np.sort(np.where(there, sizes, np.inf), axis=1)
    count = np.sum(there, axis=1)
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2], axis=1)
    median = np.take_along_axis(ordered, np.minimum(middle, sizes.shape[1] - 1), axis=1)
    return np.where(count > 0, _SIGMA_OF_MEDIAN * np.mean(median, axis=1), 0.0)


def _noise(e: FloatArray) -> float:
    return max(_SIGMA_OF_MEDIAN * float(median(np.abs(e))), _LEAST_PX)
