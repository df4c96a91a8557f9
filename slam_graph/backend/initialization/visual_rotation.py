# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The rotation of a camera between two frames from features alone, with its information.

Bearings f₁, f₂ of a feature at rest and the direction of the translation t lie in one plane:
e = t · (f₁ × R f₂) = 0. Rotation and direction are found by Gauss-Newton on e divided by its
standard deviation, that of the noise of both bearings (Sampson's error on the sphere), with
Cauchy weights against wrong matches. The direction is eliminated from the information. No IMU takes
part: the result is what a gyroscope is compared with.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.linalg import lapack
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, median, skew
from slam_graph.sensors import Camera, FeatureObservations

MIN_COMMON = 15
"""Fewest common features of two frames."""
_SEARCH_COST, _MAX_COST = 0.3, 1.0
"""Mean robust cost of a feature above which another start is searched for, and above which the
rotation is refused. Noise gives 0.13, and 1 % of wrong matches 0.06."""
_RANSAC_SIGMAS = 2.0
"""Tolerance of the search for another start, in units of the noise."""
_RANSAC_SAMPLES = 300
"""Most samples of five of that search: enough where half of the matches are right."""
_STEPS = 10
"""Most Gauss-Newton steps."""
_CONVERGED_RAD = 1e-5
"""A smaller step of the rotation is the last."""
_CAUCHY_WIDTH = 2.4
"""Residual with half the weight, in units of the noise."""
_MEDIAN = 0.455 / _CAUCHY_WIDTH**2
"""Median of the squared residuals if they are noise, in units of the width."""
_REWEIGHTINGS = 3
"""How often the first direction is found again without wrong matches."""
_MAX_STEP_RAD = 0.1
"""Longest step of the rotation."""
_FLOOR_RAD = 0.5e-3
"""No rotation is better known than this: tracks have errors that are common to many features."""
_WEAK = 1e-3
"""Information on the direction where the parallax shows none."""
_TINY = 1e-12
"""Keeps divisions finite."""
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
"""The axes after each axis, and before it."""


@dataclass(frozen=True, slots=True, eq=False)
class VisualRotation:
    """A rotation from the second camera frame to the first.

    Attributes:
        R: (3, 3) first_R_second.
        information: (3, 3) about it, in the tangent at the second frame, 1/rad². It compares
            directions and pairs; what is common to all is larger than noise alone says, and is
            measured where rotations are used (`gyro_alignment.py`).
    """

    R: FloatArray
    information: FloatArray


def visual_rotation(
    one: FeatureObservations,
    two: FeatureObservations,
    camera: Camera,
    pixel_sigma: float,
    guess: FloatArray | None,
) -> VisualRotation | None:
    """The rotation between two frames of a camera; None without enough features.

    Args:
        one: features of the first frame.
        two: those of the second.
        camera: which sees them.
        pixel_sigma: standard deviation of an observation, pixels.
        guess: (3, 3) a rotation near; without it that of the bearings is taken, as if the camera
            only turned.
    """
    _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
    if len(i) < MIN_COMMON:
        return None
    first, sigma_1 = _bearings(one.normalized[i], camera, pixel_sigma)
    second, sigma_2 = _bearings(two.normalized[j], camera, pixel_sigma)
    sigmas = np.column_stack([sigma_1, sigma_2])
    best = None if guess is None else _refined(first, second, sigmas, guess)
    if best is None or best[0] > _SEARCH_COST * len(i):
        # there are local minima, and no start is known to be near the global one
        starts = [Rotation.align_vectors(first, second)[0].as_matrix()]
        starts += _by_five_points(one.normalized[i], two.normalized[j], pixel_sigma / camera.fx)
        found = [_refined(first, second, sigmas, R) for R in starts]
        best = min(found if best is None else [best, *found], key=_cost)
    return None if best[0] > _MAX_COST * len(i) else best[1]


def _cost(candidate: tuple[float, VisualRotation]) -> float:
    return candidate[0]


def _by_five_points(one: FloatArray, two: FloatArray, noise: float) -> list[FloatArray]:
    """The first_R_second of an essential matrix by RANSAC (Nistér 2004)."""
    tolerance = _RANSAC_SIGMAS * noise
    E, _ = cv2.findEssentialMat(one, two, np.eye(3), cv2.RANSAC, 0.999, tolerance, _RANSAC_SAMPLES)
    if E is None or E.shape != (3, 3):
        return []
    R_1, R_2, _ = cv2.decomposeEssentialMat(E)
    # the other of the two turns by another half turn about the translation
    smaller = R_1 if np.trace(R_1) > np.trace(R_2) else R_2
    return [np.asarray(smaller.T, np.float64)]


def _bearings(
    normalized: FloatArray, camera: Camera, pixel_sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Unit bearings (N, 3) and their noise (N,), rad, by the area of a pixel on the sphere."""
    rays = np.column_stack([normalized, np.ones(len(normalized))])
    length = np.linalg.norm(rays, axis=1)
    slopes = camera.distort(normalized)[1]
    area = slopes[:, 0, 0] * slopes[:, 1, 1] - slopes[:, 0, 1] * slopes[:, 1, 0]
    pixels = np.abs(area) * length**3
    return rays / length[:, None], pixel_sigma / np.sqrt(np.maximum(pixels, _TINY))


def _refined(
    first: FloatArray, second: FloatArray, sigmas: FloatArray, R: FloatArray
) -> tuple[float, VisualRotation]:
    """Robust cost and rotation from a start R; `sigmas` (N, 2) of the bearings, rad."""
    pair = _Pair(first, second, sigmas, R)
    # normals of one length first: those of wrong matches are the longest
    weights = 1.0 / np.maximum(np.sum(pair.normals**2, axis=0), _TINY)
    t, of_t = pair.direction(weights)
    for _ in range(_REWEIGHTINGS):
        e, sigma = pair.residuals(t)
        weights = _weights((e / (_CAUCHY_WIDTH * sigma)) ** 2)
        t, of_t = pair.direction(weights / sigma**2)
    H, cost = np.zeros((5, 5)), np.inf
    for _ in range(_STEPS):
        e, sigma = pair.residuals(t)
        squares = (e / (_CAUCHY_WIDTH * sigma)) ** 2
        cost = float(np.sum(np.log1p(squares)))
        weights = _weights(squares)
        scale = np.sqrt(weights) / sigma
        white = pair.jacobian(t) * scale
        H = white @ white.T
        damped = H + (1e-6 * np.trace(H) + _TINY) * np.eye(5)
        step = -np.linalg.solve(damped, white @ (scale * e))[:3]
        length = math.sqrt(step @ step)
        step *= min(1.0, _MAX_STEP_RAD / max(length, _TINY))
        R = R @ Rotation.from_rotvec(step).as_matrix()
        pair.turn(R)
        t, of_t = pair.direction(weights)
        if length < _CONVERGED_RAD:
            break
    information = H[:3, :3] - H[:3, 3:] @ np.linalg.solve(of_t, H[3:, :3])
    return cost, VisualRotation(R, _believable(information))


def _weights(squares: FloatArray) -> FloatArray:
    """Cauchy weights (N,) of squared residuals (N,) in units of the width.

    Far from the solution all residuals are large, and none is an outlier.
    """
    return np.asarray(1.0 / (1.0 + squares / max(1.0, float(median(squares)) / _MEDIAN)))


def _believable(information: FloatArray) -> FloatArray:
    """The information (3, 3) without negative eigenvalues, and not above that of `_FLOOR_RAD`."""
    values, vectors = np.linalg.eigh(information)
    variances = 1.0 / np.maximum(values, 1.0) + _FLOOR_RAD**2
    return np.asarray((vectors / variances) @ vectors.T)


class _Pair:
    """The bearings of two frames under a rotation between them.

    Vectors are columns here, in which NumPy takes half the time for the few that there are.

    Attributes:
        normals: (3, N) f₁ × R f₂ of the epipolar planes.
    """

    def __init__(
        self, first: FloatArray, second: FloatArray, sigmas: FloatArray, R: FloatArray
    ) -> None:
        """Turn the second bearings (N, 3); `sigmas` (N, 2) of both, rad."""
        self._first, self._second = np.ascontiguousarray(first.T), np.ascontiguousarray(second.T)
        self._variances = np.ascontiguousarray(sigmas.T) ** 2
        self.turn(R)

    def turn(self, R: FloatArray) -> None:
        """Take another rotation (3, 3)."""
        self._R, self._turned = R, R @ self._second
        self.normals = _cross(self._first, self._turned)

    def direction(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The direction (3,) most orthogonal to the normals, and its information (2, 2).

        Both relative to what noise adds to the normals (Kanatani 1996, renormalization): where the
        parallax is below the noise, all directions are alike.

        Args:
            weights: (N,).

        Raises:
            numpy.linalg.LinAlgError: if there is no noise in some direction.
        """
        first, turned = self._first, self._turned
        scatter = (self.normals * weights) @ self.normals.T
        of_first, of_second = noises = weights * self._variances
        noise = float(noises.sum()) * np.eye(3)
        noise -= (first * of_second) @ first.T + (turned * of_first) @ turned.T
        values, vectors, info = lapack.dsygv(scatter, noise)
        if info != 0:
            raise np.linalg.LinAlgError("the noise of the normals is singular")
        t = vectors[:, 0] / math.sqrt(vectors[:, 0] @ vectors[:, 0])
        across = _tangent(t)
        per_variance = float(weights.sum()) / float(t @ noise @ t)
        known = across @ (scatter - values[0] * noise) @ across.T * per_variance
        return t, known + _WEAK * np.eye(2)

    def residuals(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The e (N,) of a direction t (3,), and its σ (N,)."""
        of_first, of_second = self._variances
        variance = of_first * (1.0 - (t @ self._turned) ** 2)
        variance += of_second * (1.0 - (t @ self._first) ** 2)
        return t @ self.normals, np.sqrt(np.maximum(variance, _TINY**2))

    def jacobian(self, t: FloatArray) -> FloatArray:
        """The derivative (5, N) of e by R ⊕ δ and t ⊕ ε on the sphere."""
        across = (self._R.T @ skew(t)) @ self._first
        return np.concatenate([_cross(self._second, across), _tangent(t) @ self.normals])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (3, N) of vectors (3, N), in a third of the time of `numpy.cross`."""
    return np.asarray(a[_NEXT] * b[_LAST] - a[_LAST] * b[_NEXT])


def _tangent(t: FloatArray) -> FloatArray:
    """Two unit vectors (2, 3) orthogonal to a unit vector (3,) and to each other.

    Those of Householder's reflection to the first axis, which are the same for t and -t.
    """
    x, y, z = t.tolist()
    sign, scale = math.copysign(1.0, x), 1.0 / (1.0 + abs(x))
    mixed = -y * z * scale
    return np.array(
        [[-sign * y, 1.0 - y * y * scale, mixed], [-sign * z, mixed, 1.0 - z * z * scale]]
    )
