# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The epipolar test of one camera: which matches fit a rigid motion, within pixels.

For a narrow lens a pixel has about the same size everywhere on the plane z = 1, and the tests of
`outliers` are used, with distances on that plane times the focal length. On the plane of a wide
lens the noise of a pixel grows with 1 / cos² of the angle to the axis, by 33 at 80°. There bearings
of unit length are tested, and distances are in pixels, by the derivative of the camera model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, skew
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.outliers import (
    CONFIDENCE,
    MIN_POINTS,
    direction_inliers,
    eight_point,
    epipolar_distance,
    fundamental_inliers,
)
from slam_graph.sensors import Camera

_BATCH = 64
"""Samples that RANSAC draws at once."""
_MAX_SAMPLES = 1024
"""Most samples that RANSAC draws."""
_REFINEMENTS = 3
"""How often a motion is computed again from its inliers."""
_TINY = 1e-12
"""Keeps divisions finite."""


def fitted_motion(camera: Camera, before: FloatArray, after: FloatArray) -> FloatArray:
    """F (3, 3) with m_afterᵀ F m_before ≈ 0 for all matches (N, 2), at least eight of them."""
    if not camera.model.sees_sideways:
        return eight_point(before, after)
    return _fitted(_Matches.of(before, after, camera), None)


def distances_px(
    camera: Camera,
    F: FloatArray,
    before: FloatArray,
    after: FloatArray,
    other: Camera | None = None,
) -> FloatArray:
    """Sampson's distances (N,) in pixels of matches (N, 2) from a motion F (3, 3).

    Args:
        camera: which took the first image.
        F: with m_afterᵀ F m_before = 0 for a match that fits.
        before: (N, 2) normalised coordinates in the first image.
        after: (N, 2) the same points in the second one.
        other: which took the second image, if not the same.
    """
    other = other or camera
    if not (camera.model.sees_sideways or other.model.sees_sideways):
        return epipolar_distance(F, before, after) * camera.fx
    distances: FloatArray = _Matches.of(before, after, camera, other).distances_px(F[None])[0]
    return distances


class EpipolarTest:
    """Tests matches between two images of one camera.

    Args:
        camera: which took both.
        config: method and threshold.
        rng: draws the samples of RANSAC.
    """

    def __init__(self, camera: Camera, config: FrontendConfig, rng: np.random.Generator) -> None:
        self._camera = camera
        self._config = config
        self._rng = rng
        self._wide = camera.model.sees_sideways

    def inliers(
        self,
        before: FloatArray,
        after: FloatArray,
        after_R_before: FloatArray | None,
        scale: float = 1.0,
    ) -> BoolArray:
        """Which matches fit the motion of most of them, (N,).

        Args:
            before: (N, 2) normalised coordinates in the earlier image.
            after: (N, 2) the same points in the later one.
            after_R_before: (3, 3) rotation of the camera where it is known; used by `gyroscope`.
            scale: factor on the threshold.
        """
        config, focal_px = self._config, self._camera.fx
        R = after_R_before if config.outliers == "gyroscope" else None
        if self._wide:
            return self._wide_inliers(before, after, R, scale * config.epipolar_px)
        if R is not None:
            return direction_inliers(before, after, R, focal_px, config, self._rng, scale)
        order = self._rng.permutation(len(before))
        inlier = np.empty(len(before), np.bool_)
        shuffled = before.take(order, axis=0), after.take(order, axis=0)
        inlier[order] = fundamental_inliers(*shuffled, focal_px, config, scale)
        return inlier

    def _wide_inliers(
        self, before: FloatArray, after: FloatArray, R: FloatArray | None, tolerance_px: float
    ) -> BoolArray:
        """RANSAC on bearings, with samples of eight matches, or of two if the rotation is known.

        Two matches that fit a known rotation exactly tell no direction of motion. At a standstill
        there may be no others, so no motion at all is a candidate too.
        """
        count, size = len(before), 8 if R is None else 2
        if count < MIN_POINTS:
            return np.ones(count, np.bool_)
        matches = _Matches.of(before, after, self._camera)
        normals = None if R is None else np.cross(matches.a @ R.T, matches.b)
        best, lowest, drawn, needed = np.ones(count, np.bool_), np.inf, 0, float(_BATCH)
        if R is not None:
            unmoved = matches.rotation_distances_px(R)
            best, lowest = unmoved < tolerance_px, float(_cost(unmoved, tolerance_px))
        while drawn < min(needed, _MAX_SAMPLES):
            samples = np.argsort(self._rng.random((_BATCH, count)), axis=1)[:, :size]
            if R is None or normals is None:
                motions = _by_eight(matches.a[samples], matches.b[samples])
            else:
                t = np.cross(normals[samples[:, 0]], normals[samples[:, 1]])
                length = np.linalg.norm(t, axis=1)
                t = t[length > _TINY] / length[length > _TINY, None]
                motions = skew(t) @ R
            drawn += _BATCH
            if len(motions) == 0:
                continue
            distances = matches.distances_px(motions)
            costs = _cost(distances, tolerance_px)
            first = int(np.argmin(costs))
            if costs[first] < lowest:
                lowest, best = costs[first], distances[first] < tolerance_px
                share = np.count_nonzero(best) / count
                miss = np.log1p(-min(share**size, 1.0 - _TINY))
                needed = np.log(1.0 - CONFIDENCE) / min(miss, -_TINY)
        return _refined(matches, best, R, tolerance_px)


@dataclass(frozen=True, slots=True, eq=False)
class _Matches:
    """N matches on the sphere.

    Attributes:
        a, b: (N, 3) unit bearings in the earlier and in the later image.
        by_a, by_b: (N, 2, 3) their derivatives by the pixels, up to a change of their length.
    """

    a: FloatArray
    b: FloatArray
    by_a: FloatArray
    by_b: FloatArray

    @staticmethod
    def of(
        before: FloatArray, after: FloatArray, camera: Camera, other: Camera | None = None
    ) -> _Matches:
        """Those of normalised points (N, 2), the later ones in another camera if it is given."""
        (a, by_a), (b, by_b) = _on_sphere(before, camera), _on_sphere(after, other or camera)
        return _Matches(a, b, by_a, by_b)

    def select(self, rows: BoolArray) -> _Matches:
        """Those where `rows` (N,) holds."""
        return _Matches(self.a[rows], self.b[rows], self.by_a[rows], self.by_b[rows])

    def gradients(self, F: FloatArray) -> FloatArray:
        """Lengths (K, N) of the derivatives of bᵀ F a by the four pixel coordinates.

        Args:
            F: (K, 3, 3).
        """
        of_a = np.einsum("nij,knj->kni", self.by_a, self.b @ F)
        of_b = np.einsum("nij,knj->kni", self.by_b, self.a @ F.transpose(0, 2, 1))
        squares = np.sum(of_a**2, axis=2) + np.sum(of_b**2, axis=2)
        return np.asarray(np.sqrt(np.maximum(squares, _TINY**2)))

    def distances_px(self, F: FloatArray) -> FloatArray:
        """Sampson's distances (K, N) in pixels from motions F (K, 3, 3).

        To first order each is the length of the smallest correction of the four pixel coordinates
        that makes the match fit (Hartley and Zisserman 2004, eq. 11.9).
        """
        residuals = np.einsum("ni,kni->kn", self.b, self.a @ F.transpose(0, 2, 1))
        return np.asarray(np.abs(residuals) / self.gradients(F))

    def rotation_distances_px(self, R: FloatArray) -> FloatArray:
        """Distances (N,) in pixels from a rotation R (3, 3) without translation.

        To first order each is the length of the smallest correction of the four pixel coordinates
        with which b is parallel to R a. It is the largest of Sampson's distances from [t]× R over
        all directions t orthogonal to b: what fits a rotation fits it with any direction of motion.
        """
        turned = self.a @ R.T
        normals = np.cross(turned, self.b)
        by_a = np.cross(self.by_a @ R.T, self.b[:, None])
        by_b = np.cross(turned[:, None], self.by_b)
        J = np.concatenate([by_a, by_b], axis=1)  # transposed: (N, 4, 3)
        # The normal is orthogonal to b; a large variance along b keeps the solution orthogonal too
        S = J.transpose(0, 2, 1) @ J + self.b[:, :, None] * self.b[:, None]
        weighted = np.linalg.solve(S, normals[:, :, None])[:, :, 0]
        return np.asarray(np.sqrt(np.maximum(np.sum(normals * weighted, axis=1), 0.0)))


def _cost(distances_px: FloatArray, tolerance_px: float) -> FloatArray:
    """MSAC's cost (...) of distances (..., N): outliers count one, inliers less."""
    return np.asarray(np.sum(np.minimum(distances_px / tolerance_px, 1.0) ** 2, axis=-1))


def _on_sphere(m: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Unit bearings (N, 3) of normalised points (N, 2), and their derivatives (N, 2, 3)."""
    rays = np.column_stack([m, np.ones(len(m))])
    length = np.linalg.norm(rays, axis=1)
    by_pixel = np.zeros((len(m), 2, 3))
    slopes = camera.distort(m)[1]
    by_pixel[:, :, :2] = np.linalg.inv(slopes).transpose(0, 2, 1) / length[:, None, None]
    return rays / length[:, None], by_pixel


def _by_eight(a: FloatArray, b: FloatArray) -> FloatArray:
    """Motions (K, 3, 3) of rank 2 by samples (K, M, 3) of at least eight bearings."""
    rows = (b[..., :, None] * a[..., None, :]).reshape(*a.shape[:-1], 9)
    _, vectors = np.linalg.eigh(rows.transpose(0, 2, 1) @ rows)
    U, s, Vt = np.linalg.svd(vectors[:, :, 0].reshape(-1, 3, 3))
    s[:, 2] = 0.0
    return np.asarray((U * s[:, None, :]) @ Vt)


def _fitted(matches: _Matches, near: FloatArray | None) -> FloatArray:
    """The motion F (3, 3) that fits all matches, weighted by the gradients of one that is near."""
    weights = np.ones(len(matches.a))
    if near is not None:
        weights = 1.0 / matches.gradients(near[None])[0]
        weights /= np.max(weights)
    return np.asarray(_by_eight((matches.a * weights[:, None])[None], matches.b[None])[0])


def _along(matches: _Matches, R: FloatArray) -> FloatArray:
    """The motion (3, 3) with a known rotation whose direction fits all matches."""
    normals = np.cross(matches.a @ R.T, matches.b)
    _, vectors = np.linalg.eigh(normals.T @ normals)
    return np.asarray(skew(vectors[:, :1].T)[0] @ R)


def _refined(
    matches: _Matches, inlier: BoolArray, R: FloatArray | None, tolerance_px: float
) -> BoolArray:
    """More inliers (N,): those of the motion that fits the inliers so far."""
    F: FloatArray | None = None
    for _ in range(_REFINEMENTS):
        if np.count_nonzero(inlier) < MIN_POINTS:
            break
        within = matches.select(inlier)
        F = _fitted(within, F) if R is None else _along(within, R)
        refined = matches.distances_px(F[None])[0] < tolerance_px
        if np.count_nonzero(refined) < np.count_nonzero(inlier):
            break
        inlier = refined
    return inlier
