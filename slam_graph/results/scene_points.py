# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Points of a map moved to where the poses of its keyframes see them.

The points of a map are means of what single keyframes have triangulated while the run went on.
After the final adjustment of the poses they are up to a pixel beside their observations, which is
nothing for recognising a place, and too much for a reconstruction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slam_graph.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from slam_graph.maps import SlamMap

_STEPS = 8
_DEPTH_PART = 0.05
"""Standard deviation of a point of the map, as a part of its distance: it holds the depth of what
is seen from nearly one place."""
_NEAREST_M = 0.05
_HUBER_PX = 2.0


def refined_points(known: SlamMap) -> FloatArray:
    """The points (P, 3) of a map of one recording that fit their observations best, in m.

    Gauss-Newton steps on each point alone; it stays where a step would make it worse.

    Args:
        known: the map; its poses stay.
    """
    fit = _Fit.of(known)
    points = fit.before.copy()
    value, H, g = fit.cost(points)
    for _ in range(_STEPS):
        good = np.isfinite(value)
        trial = points.copy()
        trial[good] -= np.linalg.solve(H[good], g[good][:, :, None])[:, :, 0]
        new = fit.cost(trial)
        better = good & (new[0] < value)  # not where it is NaN: behind a camera
        if not better.any():
            break
        points[better] = trial[better]
        for array, moved in zip((value, H, g), new, strict=True):
            array[better] = moved[better]
    return points


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Squared residuals of N observations of P points under Huber's loss, and a weak prior.

    Attributes:
        before: (P, 3) the points of the map, m; the prior is around them.
        information: (P,) of the prior, 1/m².
        features: (N,) which point is observed.
        world_R_camera: (N, 3, 3) of each observation.
        centres: (N, 3) of the camera in the world, m.
        normalized: (N, 2) on the plane z = 1.
        focal_px: pixels of a unit there.
    """

    before: FloatArray
    information: FloatArray
    features: IntArray
    world_R_camera: FloatArray
    centres: FloatArray
    normalized: FloatArray
    focal_px: float

    @staticmethod
    def of(known: SlamMap) -> _Fit:
        """Of the first camera in the keyframes of a map."""
        mounted = known.recordings[0].rig.cameras[0]
        rows = np.flatnonzero(known.features >= 0)
        features, keyframes = known.features[rows], known.keyframe_of[rows]
        poses = [known.pose(k).compose(mounted.body_T_camera) for k in range(len(known))]
        rotations = np.array([pose.rotation().matrix() for pose in poses]).reshape(-1, 3, 3)
        centres = np.array([pose.translation() for pose in poses]).reshape(-1, 3)[keyframes]
        before = np.asarray(known.points, np.float64)
        ranges = np.linalg.norm(before[features] - centres, axis=1)
        counts = np.bincount(features, minlength=len(before))
        means = np.bincount(features, ranges, len(before)) / np.maximum(counts, 1)
        return _Fit(
            before,
            1.0 / np.maximum(_DEPTH_PART * means, _NEAREST_M) ** 2,
            features,
            rotations[keyframes],
            centres,
            known.normalized[rows],
            mounted.camera.fx,
        )

    def cost(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Costs (P,), and the normal equations H (P, 3, 3) and g (P, 3), at points (P, 3)."""
        x = np.einsum("nij,ni->nj", self.world_R_camera, points[self.features] - self.centres)
        depth = np.where(x[:, 2] > _NEAREST_M, x[:, 2], np.nan)
        residuals = self.focal_px * (x[:, :2] / depth[:, None] - self.normalized)
        lengths = np.linalg.norm(residuals, axis=1)
        weights = _HUBER_PX / np.maximum(lengths, _HUBER_PX)
        losses = np.where(weights < 1.0, _HUBER_PX * (lengths - _HUBER_PX / 2), lengths**2 / 2)
        by_camera = np.zeros((len(depth), 2, 3))
        by_camera[:, 0, 0] = by_camera[:, 1, 1] = 1.0 / depth
        by_camera[:, :, 2] = -x[:, :2] / depth[:, None] ** 2
        J = self.focal_px * by_camera @ self.world_R_camera.transpose(0, 2, 1)
        moved, known = points - self.before, self.information
        H = self._sums(np.einsum("n,nki,nkj->nij", weights, J, J))
        g = self._sums(np.einsum("n,nki,nk->ni", weights, J, residuals)) + known[:, None] * moved
        value = self._sums(losses) + known * np.sum(moved**2, axis=1) / 2
        return value, H + known[:, None, None] * np.eye(3), g

    def _sums(self, values: FloatArray) -> FloatArray:
        """Sums (P, …) over the observations of each point of values (N, …)."""
        total = np.zeros((len(self.before), *values.shape[1:]))
        np.add.at(total, self.features, values)
        return total
