# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Do accelerometer and cameras tell the same motion? Axes, sign, and the length of the baseline.

With the rotations R_k of the gyroscope and the doubly integrated specific force α_k, the body is at
p_k = v t_k + ½ g t_k² + α_k - A_k b. Every observation of a feature gives two equations that are
linear in the feature, v, g, the accelerometer bias b, and a factor s on the baseline (Dong-Si &
Mourikis 2012, with bias and baseline added). Wrong axes leave residuals, a wrong sign puts the
features behind the camera, and a wrong baseline has s ≠ 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray, median
from slam_graph.diagnosis.gyroscope import Gyroscope
from slam_graph.diagnosis.kinematics import Kinematics
from slam_graph.sensors import FeatureFrame, Rig

_FEATURES, _FEWEST_FRAMES = 50, 5
"""Most features of a window, those with the longest tracks; the shortest track that is used."""
_BIAS_SIGMA, _GRAVITY_SIGMA = 0.15, 2.0
"""Prior standard deviations of the bias, and of gravity about the mean force, m/s²."""
_LINEAR = 3
"""So many linear solutions, each with the weights by the one before."""
_KNOWN_BASELINE, _FREE_BASELINE = 0.01, 10.0
"""Prior standard deviations of the factor on the baseline, about one."""
_CAUCHY = 2.4
"""Residual with half the weight, in units of the noise."""
_MEDIAN_OF_TWO = 1.177
"""Median length of a vector of two normal variables."""
_LEAST_DEPTH_M = 0.1
_LEAST_NOISE_PX = 0.3
_TINY = 1e-9
_V, _G, _B, _S = slice(0, 3), slice(3, 6), slice(6, 9), 9
"""Places of the unknowns."""
_EYE = _TINY * np.eye(10)
_PRIOR = np.diag([0.0] * 3 + [_GRAVITY_SIGMA**-2] * 3 + [_BIAS_SIGMA**-2] * 3 + [0.0])
"""Information about the unknowns that is assumed, but for the baseline."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowSolution:
    """The solution of a window.

    Attributes:
        baseline: factor on the calibrated baseline; NaN with one camera.
        baseline_sigma: its standard deviation.
        ahead: share of the observations that are in front of the camera.
        gravity: (3,) m/s², in the first body frame.
        residual_px: robust standard deviation of an observation.
    """

    baseline: float
    baseline_sigma: float
    ahead: float
    gravity: FloatArray
    residual_px: float


class Window:
    """The equations of a few seconds.

    Attributes:
        features: number of features.
        variation: standard deviation of the specific force, turned into the first body frame, m/s².
    """

    def __init__(
        self, frames: list[FeatureFrame], gyroscope: Gyroscope, rig: Rig, at: Kinematics
    ) -> None:
        """Collect observations and integrals; `at` is what camera and gyroscope say together."""
        cameras = rig.cameras[:2]
        self._focal_px = cameras[0].camera.fx
        stamps = np.array([frame.stamp_ns for frame in frames], np.int64)
        t = gyroscope.seconds(stamps) + at.offset_s
        self._t = t - t[0]
        self._integrate(gyroscope, t, at.bias)
        turn = at.body_R_camera @ cameras[0].body_T_camera.rotation().matrix().T
        self._places = np.array([turn @ c.body_T_camera.translation() for c in cameras])
        self._mounts = np.array([turn @ c.body_T_camera.rotation().matrix() for c in cameras])
        self._feature, self._frame, self._camera, self._m = _observations(frames, len(cameras))
        self._first = np.flatnonzero(np.diff(self._feature, prepend=-1))  # row of each feature
        self.features = len(self._first)

    def _integrate(self, gyroscope: Gyroscope, t: FloatArray, bias: FloatArray) -> None:
        """Rotations, and what α and A are made of, at the times of the frames."""
        rows = slice(*np.searchsorted(gyroscope.t, [t[0], t[-1] + 0.02]))
        times, R = gyroscope.t[rows], gyroscope.R[rows]
        # the bias turns the integral, to first order about the axes at the start
        R = _exponentials(-np.cumsum(R @ bias, axis=0) * np.gradient(times)[:, None]) @ R
        start = R[0]
        R = start.T @ R
        dt = np.diff(times)[:, None, None]

        def twice(values: FloatArray) -> FloatArray:
            shape = values.shape
            flat = values.reshape(len(times), -1, 1)
            speed = np.concatenate([0 * flat[:1], np.cumsum(0.5 * (flat[1:] + flat[:-1]) * dt, 0)])
            place = np.concatenate(
                [0 * flat[:1], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt, 0)]
            )
            at = [np.interp(t, times, column) for column in place[:, :, 0].T]
            return np.stack(at, axis=-1).reshape(len(t), *shape[1:])

        force = gyroscope.force[rows]
        self._of_axes = twice(R[:, :, :, None] * force[:, None, None, :])
        self._by_bias = twice(R)
        nearest = np.clip(np.searchsorted(times, t), 0, len(times) - 1)
        self._R = R[nearest]
        self._force = np.mean(R[:, :, :, None] * force[:, None, None, :], axis=0)
        turned = np.einsum("nij,nj->ni", R, force)
        self.variation = float(np.linalg.norm(np.std(turned, axis=0)))

    def solve(self, P: FloatArray, steps: int = 8) -> WindowSolution | None:
        """The solution if the accelerometer's axes should be read as P f, with P (3, 3).

        The linear equations, with the calibrated baseline, give the first guess. Noise of the
        bearings biases it, so that Gauss-Newton steps on the reprojection errors follow.

        Args:
            P: (3, 3) orthogonal.
            steps: number of them; with none the solution is only good enough to compare axes.
        """
        alpha = np.einsum("kaij,ij->ka", self._of_axes, P)
        mean = np.einsum("aij,ij->a", self._force, P)
        of_f, of_rest, b = self._equations(alpha, self._as_observed)
        weights, noise = np.ones(len(b)), 1.0 / self._focal_px
        last = _LINEAR + steps - 1
        for iteration in range(last + 1):
            by_steps = iteration >= _LINEAR
            sigma_s = _FREE_BASELINE if by_steps else _KNOWN_BASELINE
            try:
                x, covariance, points = self._solved(
                    of_f, of_rest, b, weights, noise, (mean, sigma_s)
                )
            except np.linalg.LinAlgError:
                return None
            seen, depth = self._projected(points, x, alpha)
            off = seen - self._m
            size = np.sqrt(off[:, 0] ** 2 + off[:, 1] ** 2) * self._focal_px
            sigma_px = max(float(median(size)) / _MEDIAN_OF_TWO, _LEAST_NOISE_PX)
            if iteration == last:
                break
            noise = sigma_px / self._focal_px
            safe = np.where(np.abs(depth) < _LEAST_DEPTH_M, _LEAST_DEPTH_M, depth)
            robust = 1.0 / np.sqrt(1.0 + (size / (_CAUCHY * sigma_px)) ** 2)
            if iteration >= _LINEAR - 1:
                of_f, of_rest, b = self._equations(alpha, self._coefficients(seen))
                b = b + (self._m - seen) * safe[:, None]
            weights = robust / np.abs(safe)
        s = float(x[_S]), float(np.sqrt(covariance[_S, _S]))
        if not np.any(self._camera == 1):
            s = np.nan, np.inf
        return WindowSolution(*s, float(np.mean(depth > 0.0)), x[_G], sigma_px)

    def _equations(
        self, alpha: FloatArray, coefficients: tuple[FloatArray, FloatArray, FloatArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The coefficients of features and of v, g, b and s, and right sides (N, 2).

        Args:
            alpha: (K, 3) doubly integrated specific force.
            coefficients: as `_coefficients` returns them.
        """
        of_f, of_rest, of_mounting = coefficients
        return of_f, of_rest, np.einsum("nij,nj->ni", of_f, alpha[self._frame]) + of_mounting

    @cached_property
    def _as_observed(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The coefficients for features that are seen where they were observed."""
        return self._coefficients(self._m)

    def _coefficients(self, m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients of features (N, 2, 3), of v, g, b and s (N, 2, 10), and of mounting (N, 2).

        Args:
            m: (N, 2) normalised points that the features are to be seen at.
        """
        k, c = self._frame, self._camera
        rows = np.zeros((len(k), 2, 3))
        rows[:, 0, 0] = rows[:, 1, 1] = 1.0
        rows[:, :, 2] = -m
        in_body = rows @ self._mounts[c].transpose(0, 2, 1)
        of_f = in_body @ self._R[k].transpose(0, 2, 1)
        t = self._t[k][:, None, None]
        by_s = -np.einsum("nij,nj->ni", in_body, self._places[c] - self._places[0])
        parts = [-of_f * t, -0.5 * of_f * t**2, of_f @ self._by_bias[k], by_s[..., None]]
        return of_f, np.concatenate(parts, axis=2), in_body @ self._places[0]

    def _solved(
        self,
        of_f: FloatArray,
        of_rest: FloatArray,
        b: FloatArray,
        weights: FloatArray,
        noise: float,
        expected: tuple[FloatArray, float],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Unknowns (10,), their covariance (10, 10), and features (J, 3), by a Schur complement."""
        rows = np.concatenate([of_f, of_rest, b[..., None]], axis=2)
        rows *= (weights / noise)[:, None, None]
        by_feature = np.add.reduceat(rows[..., :3].swapaxes(1, 2) @ rows, self._first, axis=0)
        H_ff, H_fr = by_feature[..., :3], by_feature[..., 3:]
        size = H_ff[:, 0, 0] + H_ff[:, 1, 1] + H_ff[:, 2, 2]
        H_ff[:, range(3), range(3)] += _TINY * (size[:, None] + 1.0)
        of_features = np.linalg.solve(H_ff, H_fr)
        rest = rows[..., 3:].reshape(-1, 11)
        reduced = rest.T @ rest - H_fr.reshape(-1, 11).T @ of_features.reshape(-1, 11)
        prior = _PRIOR.copy()
        prior[_S, _S] = expected[1] ** -2
        likely = np.concatenate([np.zeros(3), -expected[0], np.zeros(3), [1.0]])
        covariance = np.linalg.inv(reduced[:10, :10] + prior + _EYE)
        x = covariance @ (reduced[:10, 10] + prior @ likely)
        return x, covariance, of_features[..., 10] - of_features[..., :10] @ x

    def _projected(
        self, points: FloatArray, x: FloatArray, alpha: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Where the features are seen (N, 2), normalised, and their depths (N,)."""
        k, c, t = self._frame, self._camera, self._t[:, None]
        p = x[_V] * t + 0.5 * x[_G] * t**2 + alpha - self._by_bias @ x[_B]
        in_body = np.einsum("nji,nj->ni", self._R[k], points[self._feature] - p[k])
        place = self._places[0] + x[_S] * (self._places - self._places[0])
        in_camera = np.einsum("nji,nj->ni", self._mounts[c], in_body - place[c])
        depth = in_camera[:, 2]
        safe = np.where(np.abs(depth) < _LEAST_DEPTH_M, _LEAST_DEPTH_M, depth)
        return in_camera[:, :2] / safe[:, None], depth


def _exponentials(vectors: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def _observations(
    frames: list[FeatureFrame], cameras: int
) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Numbers of feature, frame and camera (N,), and normalised points (N, 2), of long tracks.

    In the order of the features.
    """
    ids, counts = np.unique(
        np.concatenate([f.cameras[0].ids for f in frames if f.cameras]), return_counts=True
    )
    order = np.argsort(-counts, kind="stable")[:_FEATURES]
    ids = np.sort(ids[order][counts[order] >= _FEWEST_FRAMES])
    rows = []
    for k, frame in enumerate(frames):
        for c, seen in enumerate(frame.cameras[:cameras]):
            _, i, j = np.intersect1d(ids, seen.ids, assume_unique=True, return_indices=True)
            numbers = np.column_stack([i, np.full(len(i), k), np.full(len(i), c)])
            rows.append((numbers, seen.normalized[j]))
    numbers = np.concatenate([r[0] for r in rows]) if rows else np.zeros((0, 3), np.int64)
    m = np.concatenate([r[1] for r in rows]) if rows else np.zeros((0, 2))
    good = np.all(np.isfinite(m), axis=1)
    numbers, m = numbers[good], m[good]
    order = np.argsort(numbers[:, 0], kind="stable")
    feature = np.unique(numbers[order, 0], return_inverse=True)[1]
    return feature, *numbers[order, 1:].T, m[order]
