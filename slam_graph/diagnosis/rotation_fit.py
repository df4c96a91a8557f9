# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What camera and gyroscope together say of clock, mounting, focal length and shutter.

The rotation between two frames follows from the gyroscope. Under it, bearings f₁, f₂ of a point at
rest and the direction of the translation t lie in one plane, t · (f₁ × R f₂) = 0. All pairs
together give the time offset, the mounting, a factor on the focal lengths, the readout time and the
gyroscope bias in one robust least-squares problem, the directions eliminated. So a fault in one of
them is not taken for one in another. Standard deviations are those of a sandwich estimator over
blocks of time (Huber 1967), because errors of tracks are alike in neighbouring pairs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, median
from slam_graph.diagnosis.frame_pairs import FramePair
from slam_graph.diagnosis.gyroscope import Gyroscope
from slam_graph.sensors import RigCamera

UNKNOWNS = ("offset", "focal", "readout", "rx", "ry", "rz", "bx", "by", "bz")
_PRIOR = np.array([0.2, 0.5, 0.05, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
"""Prior standard deviations: s, logarithm, s, rad, rad/s."""
_STEP = np.array([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5])
"""Steps of the numerical derivatives."""
_LARGEST = np.array([0.03, 0.1, 0.02, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05])
"""Largest change of an unknown in one step."""
_JUMP = 0.6
"""No epipolar distance changes so much by the largest change of an unknown, in focal lengths."""
_CAUCHY = 2.4
"""Residual with half the weight, in units of the noise."""
_SIGMA_OF_MEDIAN = 1.4826
_MOST_STEPS = 15
_DIRECTIONS = 4
"""How often a direction is found again without wrong matches."""
_BLOCK_S = 2.0
"""Errors within so long count as one."""
_LEAST_PX = 0.05
"""No noise is smaller than this."""


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Values of the unknowns.

    Attributes:
        offset_s: t_imu = t_camera + offset, of the middle row.
        focal: factor on the calibrated focal lengths.
        readout_s: of the rows.
        body_R_camera: (3, 3).
        bias: (3,) of the gyroscope, rad/s.
    """

    offset_s: float
    focal: float
    readout_s: float
    body_R_camera: FloatArray
    bias: FloatArray

    def moved(self, by: FloatArray) -> Kinematics:
        """With a change (9,) in the order of `UNKNOWNS`; the mounting turns in the camera frame."""
        return Kinematics(
            self.offset_s + float(by[0]),
            self.focal * float(np.exp(by[1])),
            self.readout_s + float(by[2]),
            self.body_R_camera @ Rotation.from_rotvec(by[3:6]).as_matrix(),
            self.bias + by[6:9],
        )


@dataclass(frozen=True, eq=False)
class RotationFit:
    """The solution.

    Attributes:
        values: of the unknowns.
        sigmas: (9,) standard deviations in the order of `UNKNOWNS`.
        noise_px: robust standard deviation of the epipolar distances.
        free: which unknowns were estimated.
    """

    values: Kinematics
    sigmas: FloatArray
    noise_px: float
    free: tuple[str, ...]


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
        self._normalized: dict[float, FloatArray] = {}

    def bearings(self, focal: float) -> FloatArray:
        """Unit bearings (2, P, N, 3) with a factor on the focal lengths."""
        if focal not in self._normalized:
            camera = self._mounted.camera
            scaled = replace(camera, fx=camera.fx * focal, fy=camera.fy * focal)
            with np.errstate(all="ignore"):  # beyond the edge of a wide lens
                m = scaled.undistort(self._pixels.reshape(-1, 2)).reshape(self._pixels.shape)
                rays = np.concatenate([m, np.ones((*m.shape[:-1], 1))], axis=-1)
                rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
            if len(self._normalized) > 4:
                self._normalized.clear()
            self._normalized[focal] = np.where(np.isfinite(rays), rays, 0.0)
        return self._normalized[focal]

    def _turned(self, at: Kinematics) -> tuple[FloatArray, FloatArray]:
        """Bearings (P, N, 3) of both frames, turned into the camera of the first one."""
        f = self.bearings(at.focal)
        C, t = at.body_R_camera, self._t + at.offset_s
        R, rates = np.empty((2, len(self._part), 3, 3)), np.empty((2, len(self._part), 3))
        for number, gyroscope in enumerate(self._gyroscopes):
            of = self._part == number
            for k in range(2):
                R[k, of] = gyroscope.orientation(t[k, of])
                rates[k, of] = gyroscope.rate_at(t[k, of]) - at.bias
        if at.readout_s != 0.0:
            seconds = self._row * at.readout_s
            f = f + np.cross((rates @ C)[:, :, None, :] * seconds[..., None], f)
        body = R[0].transpose(0, 2, 1) @ R[1]
        half = Rotation.from_matrix(body).as_rotvec() * 0.5
        by_bias = (at.bias * (t[1] - t[0])[:, None])[..., None]
        drift = Rotation.from_rotvec(-half).as_matrix() @ by_bias
        body = body @ Rotation.from_rotvec(-drift[..., 0]).as_matrix()
        camera = C.T @ body @ C
        return f[0], f[1] @ camera.transpose(0, 2, 1)

    def directions(self, at: Kinematics, noise: float) -> FloatArray:
        """Directions (P, 3) of the translations that fit best, robustly."""
        one, two = self._turned(at)
        normals = np.cross(one, two)
        weights = self._there / np.maximum(np.sum(normals**2, axis=-1), 1e-6)
        t = _least(normals, weights)
        for _ in range(_DIRECTIONS):
            e, sigma = _residuals(one, two, normals, t)
            e = e / sigma * self._mounted.camera.fx * at.focal
            scale = np.maximum(_scales(np.abs(e), self._there), noise)[:, None]
            weights = self._there / (1.0 + (e / (_CAUCHY * scale)) ** 2) / sigma**2
            t = _least(normals, weights)
        return t

    def residuals(self, at: Kinematics, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Epipolar distances (P, N), pixels, and their derivatives (P, N, 2) by the directions."""
        one, two = self._turned(at)
        normals = np.cross(one, two)
        e, sigma = _residuals(one, two, normals, t)
        factor = self._mounted.camera.fx * at.focal / sigma
        return e * factor, (normals @ _tangents(t)) * factor[..., None]

    def noise_px(self, at: Kinematics) -> float:
        """Robust standard deviation of the epipolar distances, the directions fitted."""
        e, _ = self.residuals(at, self.directions(at, _LEAST_PX))
        return _noise(e[self._there])

    def solve(self, start: Kinematics, free: tuple[str, ...] = UNKNOWNS) -> RotationFit:
        """Gauss-Newton from a start; what is not free stays as it is."""
        columns = [k for k, name in enumerate(UNKNOWNS) if name in free]
        at, noise = start, self.noise_px(start)
        H = np.eye(len(columns))
        scores = np.zeros((1, len(columns)))
        for _ in range(_MOST_STEPS):
            H, scores = self._normal_equations(at, noise, columns)
            prior = np.zeros(9)
            prior[0], prior[6:] = at.offset_s - start.offset_s, at.bias
            prior[1] = np.log(at.focal / start.focal)
            prior[2] = at.readout_s - start.readout_s
            weight = 1.0 / _PRIOR[columns] ** 2
            gradient = scores.sum(axis=0) + weight * prior[columns]
            step = -np.linalg.solve(H + np.diag(weight), gradient)
            step *= min(1.0, float(np.min(_LARGEST[columns] / np.maximum(np.abs(step), 1e-12))))
            change = np.zeros(9)
            change[columns] = step
            tried = at.moved(change)
            lower = self.noise_px(tried)
            if lower > 1.5 * noise:
                change *= 0.3
                tried = at.moved(change)
                lower = self.noise_px(tried)
            at, noise = tried, lower
            if np.all(np.abs(change) < 0.1 * _LARGEST * 1e-2):
                break
        inverse = np.linalg.inv(H + np.diag(1.0 / _PRIOR[columns] ** 2))
        sandwich = inverse @ (scores.T @ scores) @ inverse
        sigmas = np.full(9, np.inf)
        diagonal = np.maximum(np.diag(sandwich), np.diag(inverse))
        sigmas[columns] = np.sqrt(diagonal)
        return RotationFit(at, sigmas, noise, free)

    def _normal_equations(
        self, at: Kinematics, noise: float, columns: list[int]
    ) -> tuple[FloatArray, FloatArray]:
        """Information (n, n) without the directions, and gradients (B, n) of the blocks of time."""
        t = self.directions(at, noise)
        e, by_t = self.residuals(at, t)
        J = np.empty((*e.shape, len(columns)))
        for c, k in enumerate(columns):
            change = np.zeros(9)
            change[k] = _STEP[k]
            J[..., c] = (self.residuals(at.moved(change), t)[0] - e) / _STEP[k]
        # beyond the edge of a wide lens there is no bearing, so that a distance jumps in a step
        most = _JUMP * self._mounted.camera.fx / _LARGEST[columns]
        steady = np.all(np.abs(J) < most, axis=-1, keepdims=True)
        J = np.where(steady, J, 0.0)
        root = np.sqrt(self._there / (1.0 + (e / (_CAUCHY * noise)) ** 2)) / noise
        e, J, by_t = e * root, J * root[..., None], by_t * root[..., None]
        inner = by_t.transpose(0, 2, 1) @ by_t + 1e-9 * np.eye(2)
        J = J - by_t @ np.linalg.solve(inner, by_t.transpose(0, 2, 1) @ J)
        H = np.einsum("pni,pnj->ij", J, J)
        gradients = np.einsum("pni,pn->pi", J, e)
        scores = np.zeros((int(self._block.max()) + 1, len(columns)))
        np.add.at(scores, self._block, gradients)
        return H, scores


def _least(normals: FloatArray, weights: FloatArray) -> FloatArray:
    """Directions (P, 3) most orthogonal to normals (P, N, 3)."""
    scatter = np.einsum("pni,pn,pnj->pij", normals, weights, normals)
    return np.asarray(np.linalg.eigh(scatter)[1][:, :, 0])


def _residuals(
    one: FloatArray, two: FloatArray, normals: FloatArray, t: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The t · (f₁ × R f₂) (P, N), and its deviation for unit noise of both bearings."""
    e = np.einsum("pni,pi->pn", normals, t)
    along = np.einsum("pni,pi->pn", one, t) ** 2 + np.einsum("pni,pi->pn", two, t) ** 2
    return e, np.sqrt(np.maximum(2.0 - along, 0.02))


def _scales(sizes: FloatArray, there: FloatArray) -> FloatArray:
    """Robust standard deviations (P,) of residuals (P, N)."""
    return _SIGMA_OF_MEDIAN * np.nanmedian(np.where(there, sizes, np.nan), axis=1)


def _noise(e: FloatArray) -> float:
    return max(_SIGMA_OF_MEDIAN * float(median(np.abs(e))), _LEAST_PX)


def _tangents(t: FloatArray) -> FloatArray:
    """Two unit vectors (P, 3, 2) orthogonal to each direction (P, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(t), axis=1)]
    u = np.cross(t, axis)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([u, np.cross(t, u)], axis=-1)
