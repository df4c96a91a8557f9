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

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.epipolar_rotation import refine_rotation
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
_TINY = 1e-12
"""Keeps divisions finite."""


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


@dataclass(frozen=True, slots=True, eq=False)
class Bearings:
    """Bearings of the features of one frame: they are used for several pairs.

    Attributes:
        ids: (N,) of the features.
        normalized: (N, 2) on the plane z = 1.
        rays: (N, 3) unit bearings.
        sigmas: (N,) their noise, rad, by the area of a pixel on the sphere.
        plane_sigma: the noise on the plane z = 1, in the middle of the image.
    """

    ids: IntArray
    normalized: FloatArray
    rays: FloatArray
    sigmas: FloatArray
    plane_sigma: float

    @staticmethod
    def of(seen: FeatureObservations, camera: Camera, pixel_sigma: float) -> Bearings:
        """Those of the features that a camera sees.

        Args:
            seen: the features.
            camera: which sees them.
            pixel_sigma: standard deviation of an observation, pixels.
        """
        rays = np.column_stack([seen.normalized, np.ones(len(seen))])
        length = np.linalg.norm(rays, axis=1)
        slopes = camera.distort(seen.normalized)[1]
        area = slopes[:, 0, 0] * slopes[:, 1, 1] - slopes[:, 0, 1] * slopes[:, 1, 0]
        pixels = np.abs(area) * length**3
        sigmas = pixel_sigma / np.sqrt(np.maximum(pixels, _TINY))
        rays /= length[:, None]
        return Bearings(seen.ids, seen.normalized, rays, sigmas, pixel_sigma / camera.fx)


def visual_rotation(
    one: FeatureObservations,
    two: FeatureObservations,
    camera: Camera,
    pixel_sigma: float,
    guess: FloatArray | None,
) -> VisualRotation | None:
    """The rotation between two frames of a camera, as `rotation_between` finds it."""
    first, second = (Bearings.of(seen, camera, pixel_sigma) for seen in (one, two))
    return rotation_between(first, second, guess)


def rotation_between(
    one: Bearings, two: Bearings, guess: FloatArray | None
) -> VisualRotation | None:
    """The rotation between two frames of a camera; None without enough features.

    Args:
        one: features of the first frame.
        two: those of the second.
        guess: (3, 3) a rotation near; without it that of the bearings is taken, as if the camera
            only turned.
    """
    _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
    if len(i) < MIN_COMMON:
        return None
    first, second = one.rays[i], two.rays[j]
    variances = np.column_stack([one.sigmas[i], two.sigmas[j]]) ** 2
    best = None if guess is None else _refined(first, second, variances, guess)
    if best is None or best[0] > _SEARCH_COST * len(i):
        # there are local minima, and no start is known to be near the global one
        starts = [Rotation.align_vectors(first, second)[0].as_matrix()]
        starts += _by_five_points(one.normalized[i], two.normalized[j], one.plane_sigma)
        found = [_refined(first, second, variances, R) for R in starts]
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


def _refined(
    first: FloatArray, second: FloatArray, variances: FloatArray, start: FloatArray
) -> tuple[float, VisualRotation]:
    """Robust cost and rotation from a start; `variances` (N, 2) of the bearings, rad²."""
    R, information = np.array(start, order="C"), np.empty((3, 3))
    cost = refine_rotation(first, second, variances, R, information)
    return cost, VisualRotation(R, information)
