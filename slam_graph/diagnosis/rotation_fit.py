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
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, median, skew
from slam_graph.diagnosis.frame_pairs import FramePair
from slam_graph.diagnosis.gyroscope import Gyroscope
from slam_graph.diagnosis.kinematics import Kinematics
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
_DIRECTIONS = 4
"""How often a direction is found again without wrong matches."""
_BLOCK_S = 2.0
"""Errors within so long count as one."""
_BEYOND = 10.0
"""Epipolar distance of a feature beyond the edge of a wide lens, in units of the noise."""
_LEAST_PX = 0.05
"""No noise is smaller than this."""
_PIXEL_STEPS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
"""Pixels moved for the derivatives of bearings."""
_LEAST_VARIANCE = 0.01
"""Of t · n, as a part of the largest one: towards an epipole distances tell nothing."""


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
class _Turned:
    """Bearings of both frames of P pairs in the camera of the first one.

    Attributes:
        one, two: (P, N, 3) bearings f₁ and R f₂.
        by_one, by_two: (P, N, 3, 2) their derivatives by the pixels.
    """

    one: FloatArray
    two: FloatArray
    by_one: FloatArray
    by_two: FloatArray

    @cached_property
    def normals(self) -> FloatArray:
        """(P, N, 3) f₁ × R f₂ of the features."""
        return np.cross(self.one, self.two)

    @cached_property
    def noise(self) -> FloatArray:
        """(P, N, 3, 3) covariances of the normals for pixels with unit noise."""
        spread = skew(-self.two) @ self.by_one, skew(self.one) @ self.by_two
        return np.asarray(sum(part @ part.swapaxes(-1, -2) for part in spread))

    @cached_property
    def _squared_derivatives(self) -> FloatArray:
        """(P, N) squared derivatives of the bearings, summed."""
        parts = (self.by_one, self.by_two)
        return np.asarray(sum(np.einsum("pnij,pnij->pn", part, part) for part in parts))

    def distances(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Epipolar distances (P, N), pixels, and the deviations of t · n that they are units of."""
        along = skew(t)
        by_pixels = (
            np.einsum("pni,pnij->pnj", self.two @ along, self.by_one),
            np.einsum("pni,pnij->pnj", self.one @ along, self.by_two),
        )
        variance = sum(np.einsum("pnj,pnj->pn", part, part) for part in by_pixels)
        sigma = np.sqrt(np.maximum(variance, _LEAST_VARIANCE * self._squared_derivatives + 1e-12))
        return np.einsum("pni,pi->pn", self.normals, t) / sigma, sigma


class RotationProblem:
    """The pairs as arrays, padded to the same number of features."""

    def __init__(
        self, pairs: list[FramePair], gyroscopes: list[Gyroscope], camera: RigCamera
    ) -> None:
        """Take pairs of one or several parts."""
        self._mounted, self._gyroscopes = camera, gyroscopes
        most = max(len(pair.first) for pair in pairs)
        centre = np.array([camera.camera.cx, camera.camera.cy])
        self._pixels = np.tile(centre, (2, len(pairs), most, 1))
        self._there = np.zeros((len(pairs), most), bool)
        for p, pair in enumerate(pairs):
            self._pixels[0, p, : len(pair.first)] = pair.first
            self._pixels[1, p, : len(pair.first)] = pair.second
            self._there[p, : len(pair.first)] = True
        self._t = np.array([[pair.first_s for pair in pairs], [pair.second_s for pair in pairs]])
        self._part = np.array([pair.part for pair in pairs])
        blocks = [(pair.part, int(pair.first_s // _BLOCK_S)) for pair in pairs]
        self._block = np.unique(blocks, axis=0, return_inverse=True)[1].ravel()
        rows = self._pixels[..., 1] / camera.camera.height - 0.5
        self._row = np.where(self._there, rows, 0.0)
        self._bearings: dict[float, tuple[FloatArray, FloatArray, BoolArray]] = {}
        self._motions: dict[float, tuple[FloatArray, FloatArray, FloatArray]] = {}
        self._latest: tuple[Kinematics, _Turned] | None = None

    def bearings(self, focal: float) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Unit bearings (2, P, N, 3) with a factor on the focal lengths, and their derivatives.

        The derivatives (2, P, N, 3, 2) are by the pixels. Last, which features (P, N) have both in
        both frames: beyond the edge of a wide lens there is none.
        """
        if focal not in self._bearings:
            camera = self._mounted.camera
            scaled = replace(camera, fx=camera.fx * focal, fy=camera.fy * focal)
            moved = self._pixels[None] + _PIXEL_STEPS[:, None, None, None]
            points, visible = scaled.visible(moved.reshape(-1, 2))
            m = points.reshape(moved.shape)
            rays = np.concatenate([m, np.ones((*m.shape[:-1], 1))], axis=-1)
            rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
            known = self._there & np.all(visible.reshape(m.shape[:-1]), axis=(0, 1))
            slopes = np.stack([rays[1] - rays[0], rays[2] - rays[0]], axis=-1)
            if len(self._bearings) > 4:
                self._bearings.clear()
            self._bearings[focal] = rays[0], slopes, known
        return self._bearings[focal]

    def _motion(self, offset_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Turns (P, 3, 3) of the body, half of each as a vector (P, 3), and rates (2, P, 3)."""
        if offset_s not in self._motions:
            R, rates = np.empty((2, len(self._part), 3, 3)), np.empty((2, len(self._part), 3))
            for number, gyroscope in enumerate(self._gyroscopes):
                of = self._part == number
                for k, t in enumerate(self._t + offset_s):
                    R[k, of] = gyroscope.orientation(t[of])
                    rates[k, of] = gyroscope.rate_at(t[of])
            body = R[0].transpose(0, 2, 1) @ R[1]
            if len(self._motions) > 4:
                self._motions.clear()
            self._motions[offset_s] = body, Rotation.from_matrix(body).as_rotvec() * 0.5, rates
        return self._motions[offset_s]

    def _turned(self, at: Kinematics) -> _Turned:
        """Bearings of both frames, turned into the camera of the first one.

        The last ones are kept: a step asks for those at the same values several times.
        """
        if self._latest is None or self._latest[0] is not at:
            self._latest = at, self._turned_at(at)
        return self._latest[1]

    def _turned_at(self, at: Kinematics) -> _Turned:
        """`_turned` computed anew."""
        f, slopes, _ = self.bearings(at.focal)
        C, t = at.body_R_camera, self._t + at.offset_s
        body, half, rates = self._motion(at.offset_s)
        if at.readout_s != 0.0:
            seconds, rates = self._row * at.readout_s, (rates - at.bias) / at.scale
            f = f + np.cross((rates @ C)[:, :, None, :] * seconds[..., None], f)
        by_bias = (at.bias * (t[1] - t[0])[:, None])[..., None]
        drift = Rotation.from_rotvec(-half).as_matrix() @ by_bias
        body = body @ Rotation.from_rotvec(-drift[..., 0]).as_matrix()
        if at.scale != 1.0:
            body = Rotation.from_rotvec(Rotation.from_matrix(body).as_rotvec() / at.scale)
            body = body.as_matrix()
        camera = C.T @ body @ C
        two = f[1] @ camera.transpose(0, 2, 1)
        return _Turned(f[0], two, slopes[0], camera[:, None] @ slopes[1])

    def directions(self, at: Kinematics, noise: float) -> FloatArray:
        """Directions (P, 3) of the translations that fit best, robustly."""
        turned, known = self._turned(at), self.bearings(at.focal)[2]
        weights = known / np.maximum(np.sum(turned.normals**2, axis=-1), 1e-6)
        t = _least(_scatter(turned.normals, weights))
        for _ in range(_DIRECTIONS):
            e, sigma = turned.distances(t)
            scale = np.maximum(_scales(np.abs(e), known), noise)[:, None]
            weights = known / (1.0 + (e / (_CAUCHY * scale)) ** 2) / sigma**2
            by_noise = np.einsum("pn,pnij->pij", weights * e**2, turned.noise)
            t = _least(_scatter(turned.normals, weights) - by_noise)
        return t

    def distances(self, at: Kinematics, t: FloatArray) -> FloatArray:
        """Epipolar distances (P, N), pixels."""
        return self._turned(at).distances(t)[0]

    def residuals(self, at: Kinematics, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Epipolar distances (P, N), pixels, and their derivatives (P, N, 2) by the directions."""
        turned, tangents = self._turned(at), _tangents(t)
        e, sigma = turned.distances(t)
        by_sigma = np.einsum("pnij,pj->pni", turned.noise, t) @ tangents
        by_t = (turned.normals @ tangents) / sigma[..., None]
        return e, by_t - by_sigma * (e / sigma**2)[..., None]

    def noise_px(self, at: Kinematics) -> float:
        """Robust standard deviation of the epipolar distances, the directions fitted."""
        e = self._distances_of_all(at, self.directions(at, _LEAST_PX), np.inf)
        return _noise(e) if len(e) else np.inf

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
        known = self.bearings(at.focal)[2]
        return np.asarray(np.where(known, self.distances(at, t), beyond_px)[self._there])

    def solve(
        self,
        start: Kinematics,
        free: tuple[str, ...] = UNKNOWNS,
        precision: float = _PRECISION,
    ) -> RotationFit:
        """Gauss-Newton from a start.

        Args:
            start: values of the unknowns.
            free: which of them are estimated; the others stay as they are.
            precision: steps end where no unknown changes by more than this part of the largest
                change that it may have.
        """
        columns = [k for k, name in enumerate(WITH_SCALE) if name in free]
        at, noise = start, self.noise_px(start)
        weight = 1.0 / _PRIOR[columns] ** 2
        information, scores = np.zeros((1, len(weight), len(weight))), np.zeros((1, len(weight)))
        for _ in range(_MOST_STEPS):
            information, scores = self._normal_equations(at, noise, columns)
            prior = np.zeros(len(WITH_SCALE))
            prior[0], prior[6:9] = at.offset_s - start.offset_s, at.bias
            prior[1] = np.log(at.focal / start.focal)
            prior[2] = at.readout_s - start.readout_s
            prior[9] = np.log(at.scale / start.scale)
            gradient = scores.sum(axis=0) + weight * prior[columns]
            step = -np.linalg.solve(information.sum(axis=0) + np.diag(weight), gradient)
            step *= min(1.0, float(np.min(_LARGEST[columns] / np.maximum(np.abs(step), 1e-12))))
            change = np.zeros(len(WITH_SCALE))
            change[columns] = step
            tried = at.moved(change)
            lower = self.noise_px(tried)
            if lower > 1.5 * noise:
                change *= 0.3
                tried = at.moved(change)
                lower = self.noise_px(tried)
            at, noise = tried, lower
            if np.all(np.abs(change) < precision * _LARGEST):
                break
        covariance = np.diag(np.full(len(WITH_SCALE), np.inf))
        covariance[np.ix_(columns, columns)] = _covariance(information, scores, np.diag(weight))
        return RotationFit(at, covariance, noise, free)

    def _normal_equations(
        self, at: Kinematics, noise: float, columns: list[int]
    ) -> tuple[FloatArray, FloatArray]:
        """Information (B, n, n) without the directions, and gradients (B, n), of blocks of time."""
        t = self.directions(at, noise)
        e, by_t = self.residuals(at, t)
        J, known = np.empty((*e.shape, len(columns))), self.bearings(at.focal)[2]
        for c, k in enumerate(columns):
            change = np.zeros(len(WITH_SCALE))
            change[k] = _STEP[k]
            moved = at.moved(change)
            J[..., c] = (self.distances(moved, t) - e) / _STEP[k]
            known = known & self.bearings(moved.focal)[2]
        root = np.sqrt(known / (1.0 + (e / (_CAUCHY * noise)) ** 2)) / noise
        e, J, by_t = e * root, J * root[..., None], by_t * root[..., None]
        inner = by_t.transpose(0, 2, 1) @ by_t + 1e-9 * np.eye(2)
        gradients = np.einsum("pni,pn->pi", J, e)  # the directions are at their best: none by them
        J = J - by_t @ np.linalg.solve(inner, by_t.transpose(0, 2, 1) @ J)
        blocks, n = int(self._block.max()) + 1, len(columns)
        information, scores = np.zeros((blocks, n, n)), np.zeros((blocks, n))
        np.add.at(information, self._block, J.transpose(0, 2, 1) @ J)
        np.add.at(scores, self._block, gradients)
        return information, scores


def _scatter(normals: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted second moments (P, 3, 3) of normals (P, N, 3)."""
    return np.asarray((normals * weights[..., None]).transpose(0, 2, 1) @ normals)


def _least(moments: FloatArray) -> FloatArray:
    """Directions (P, 3) along which second moments (P, 3, 3) are least."""
    return np.asarray(np.linalg.eigh(moments)[1][:, :, 0])


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


def _covariance(information: FloatArray, scores: FloatArray, prior: FloatArray) -> FloatArray:
    """Covariance (n, n) of the solution by the jackknife: without one block of time after another.

    A block that says most of what is known moves the solution much when it is left out, so that few
    such blocks do not make it look certain. Not below that of independent errors.

    Args:
        information: (B, n, n) of the blocks.
        scores: (B, n) gradients of the blocks at the solution.
        prior: (n, n) information beside them.
    """
    total = information.sum(axis=0) + prior
    moved = np.linalg.solve(total - information, scores[..., None])[..., 0]
    count = len(scores)
    jackknife = moved.T @ moved * (count - 1) / count
    return _not_below(jackknife, np.asarray(np.linalg.inv(total)))


def _not_below(covariance: FloatArray, least: FloatArray) -> FloatArray:
    """The covariance (n, n) enlarged where it is below another one."""
    root = np.linalg.cholesky(least)
    white = np.linalg.solve(root, np.linalg.solve(root, covariance).T)
    values, axes = np.linalg.eigh(0.5 * (white + white.T))
    stretched = root @ axes * np.sqrt(np.maximum(values, 1.0))
    return np.asarray(stretched @ stretched.T, dtype=np.float64)


def _noise(e: FloatArray) -> float:
    return max(_SIGMA_OF_MEDIAN * float(median(np.abs(e))), _LEAST_PX)


def _tangents(t: FloatArray) -> FloatArray:
    """Two unit vectors (P, 3, 2) orthogonal to each direction (P, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(t), axis=1)]
    u = np.cross(t, axis)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([u, np.cross(t, u)], axis=-1)
