# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle-adjustment problems in the form of BAL: cameras, points, observations, the camera model.

The camera of BAL (Agarwal, Snavely, Seitz & Szeliski 2010) looks along its negative z axis:

    P = R X + t,   p = -P_xy / P_z,   pixel = f (1 + k1 ‖p‖² + k2 ‖p‖⁴) p,

with (R, t) = camera_T_world and pixels from the centre of the image, y up. The unit of length and
the frame of the world are arbitrary: a similarity of the world changes no pixel.

`usable` selects what of a problem can be estimated; everything else is left out and counted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.display import Displayed
from slam_graph.errors import DataError

POSE_DIM = 6
CAMERA_DIM = 9
"""Tangent of a camera: rotation, translation, f k1 k2."""

_FEWEST_VIEWS = 2
"""A point must be observed by this many cameras to be determined."""


@dataclass(frozen=True, slots=True, eq=False)
class BalEstimates:
    """All variables.

    Their tangent: for each camera δθ and δt in its frame, with R ← Exp(δθ) R and t ← t + δt, and
    increments of f, k1, k2; for each point an increment in the world.

    Attributes:
        rotations: (C, 3, 3) camera_R_world.
        translations: (C, 3) camera_t_world: the origin of the world in the frame of the camera.
        intrinsics: (C, 3) f in pixels, k1, k2.
        points: (P, 3) in the world.
    """

    rotations: FloatArray
    translations: FloatArray
    intrinsics: FloatArray
    points: FloatArray

    def centres(self) -> FloatArray:
        """(C, 3) optical centres of the cameras in the world."""
        return np.asarray(-np.einsum("cji,cj->ci", self.rotations, self.translations))

    def select(self, cameras: IntArray, points: IntArray) -> BalEstimates:
        """Only some cameras and points."""
        return BalEstimates(
            self.rotations[cameras],
            self.translations[cameras],
            self.intrinsics[cameras],
            self.points[points],
        )

    def updated(self, cameras: IntArray, points: IntArray, new: BalEstimates) -> BalEstimates:
        """A copy with new values of some cameras and points."""
        merged = BalEstimates(
            self.rotations.copy(),
            self.translations.copy(),
            self.intrinsics.copy(),
            self.points.copy(),
        )
        merged.rotations[cameras] = new.rotations
        merged.translations[cameras] = new.translations
        merged.intrinsics[cameras] = new.intrinsics
        merged.points[points] = new.points
        return merged


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class BalProblem(Displayed):
    """Cameras, points and observations.

    Attributes:
        estimates: of all cameras and points.
        camera: (N,) index of the camera of each observation.
        point: (N,) index of its point.
        pixels: (N, 2) from the centre of the image, y up.
        name: of the problem.
    """

    estimates: BalEstimates
    camera: IntArray
    point: IntArray
    pixels: FloatArray
    name: str = "problem"

    def __repr__(self) -> str:
        return (
            f"BalProblem({self.name}: {self.cameras} cameras, {self.points} points, "
            f"{len(self.camera)} observations)"
        )

    def _facts(self) -> dict[str, object]:
        return {
            "name": self.name,
            "cameras": self.cameras,
            "points": self.points,
            "observations": f"{len(self.camera)}, "
            f"{len(self.camera) / max(self.points, 1):.1f} a point",
        }

    def plot(self) -> Any:
        """The estimates of the file from three sides, as a figure."""
        title = f"{self.name}  ·  {self.cameras} cameras, {self.points} points"
        estimates = self.estimates
        return self._drawn_by("bundle_picture").bundle_figure(
            title, estimates.points, estimates.centres(), {}
        )

    def _sketch(self) -> Any:
        return self.plot() if self.points and self.cameras else None

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.estimates.rotations)

    @property
    def points(self) -> int:
        """Number of points."""
        return len(self.estimates.points)

    def keep(self, observations: IntArray | BoolArray) -> BalProblem:
        """With only some observations; all cameras and points stay."""
        return replace(
            self,
            camera=self.camera[observations],
            point=self.point[observations],
            pixels=self.pixels[observations],
        )


@dataclass(frozen=True)
class BalPart:
    """The part of a problem that can be estimated, with its variables renumbered.

    Attributes:
        problem: observations sorted by camera, then point; every camera and point has some.
        cameras: (C,) indices of its cameras in the whole problem.
        points: (P,) indices of its points there.
        groups: (C,) number of the connected group of each camera; no point is observed by cameras
            of two groups.
    """

    problem: BalProblem
    cameras: IntArray
    points: IntArray
    groups: IntArray

    @cached_property
    def camera_starts(self) -> IntArray:
        """(C + 1,) index of the first observation of each camera, and N."""
        return np.searchsorted(self.problem.camera, np.arange(self.problem.cameras + 1))


@dataclass(frozen=True, slots=True, eq=False)
class BalLinearization:
    """N observations, linearised.

    Attributes:
        by_camera: (N, 2, 9) derivatives of the pixels by δθ, δt, f, k1, k2.
        by_point: (N, 2, 3) derivatives by the point.
        r: (N, 2) residuals: predicted minus measured pixels.

    In memory the same number of all observations lies together, as it is computed for all at once.
    """

    by_camera: FloatArray
    by_point: FloatArray
    r: FloatArray


def project(
    estimates: BalEstimates, camera: IntArray, point: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Project points into cameras.

    Args:
        estimates: cameras and points.
        camera: (N,) indices of cameras.
        point: (N,) indices of points.

    Returns:
        pixels: (N, 2); not finite for a point with zero depth.
        depths: (N,) along the optical axis; negative behind the camera.
    """
    R, X = _columns(estimates.rotations, camera), _columns(estimates.points, point)
    P = _rotated(R, X) + _columns(estimates.translations, camera)
    f, k1, k2 = _columns(estimates.intrinsics, camera)
    with np.errstate(all="ignore"):
        u, v = -P[:2] / P[2]
        q = u * u + v * v
        scale = f * (1.0 + q * (k1 + q * k2))
        return np.stack([scale * u, scale * v]).T, -P[2]


def linearize(
    estimates: BalEstimates, camera: IntArray, point: IntArray, pixels: FloatArray
) -> BalLinearization:
    """Residuals and Jacobians of observations.

    The arguments are those of `project`, and the measured pixels (N, 2).

    With (u, v) = -P_xy / P_z and the distortion d(q), q = u² + v², the pixel depends on P by

        G = f (d I + 2 d' (u, v)ᵀ (u, v)) · -1/P_z [I (u, v)ᵀ],

    and P = R X + t on δθ by -[R X]ₓ.
    """
    R, X = _columns(estimates.rotations, camera), _columns(estimates.points, point)
    y = _rotated(R, X)
    P = y + _columns(estimates.translations, camera)
    f, k1, k2 = _columns(estimates.intrinsics, camera)
    inverse = -1.0 / P[2]
    uv = P[:2] * inverse
    q = uv[0] ** 2 + uv[1] ** 2
    d, twice_slope = 1.0 + q * (k1 + q * k2), 2.0 * (k1 + 2.0 * q * k2)
    along, plain = f * inverse * twice_slope, f * inverse * d
    by_f = np.stack([d, f * q, f * q * q])
    by_camera, by_point = np.empty((2, CAMERA_DIM, len(f))), np.empty((2, 3, len(f)))
    for row, (of_camera, of_point) in enumerate(zip(by_camera, by_point, strict=True)):
        g = of_camera[3:6]
        g[:2] = along * uv[row] * uv
        g[row] += plain
        g[2] = g[0] * uv[0] + g[1] * uv[1]
        for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            of_camera[a] = y[b] * g[c] - y[c] * g[b]
        of_camera[6:] = by_f * uv[row]
        of_point[:] = g[0] * R[:3] + g[1] * R[3:6] + g[2] * R[6:]
    r = f * d * uv - pixels.T
    return BalLinearization(by_camera.transpose(2, 0, 1), by_point.transpose(2, 0, 1), r.T)


def _columns(values: FloatArray, index: IntArray) -> FloatArray:
    """(k, N) the k numbers of each chosen camera or point, one after the other in memory."""
    rows = values.reshape(len(values), math.prod(values.shape[1:]))
    return np.ascontiguousarray(rows.T).take(index, axis=1)


def _rotated(R: FloatArray, X: FloatArray) -> FloatArray:
    """(3, N) R X of each observation, of (9, N) rotations and (3, N) points."""
    rotated: FloatArray = R[::3] * X[0]
    rotated += R[1::3] * X[1]
    rotated += R[2::3] * X[2]
    return rotated


def usable(problem: BalProblem, diagnostics: Diagnostics) -> BalPart:
    """The part of a problem that can be estimated.

    Left out and counted are repeated observations of a point by a camera, observations of points
    that are not in front of their camera at the start, points that are then observed by fewer than
    two cameras, and cameras without any remaining observation. They keep their estimates.

    Raises:
        DataError: if nothing is left.
    """
    kept = _first_of_pair(problem, diagnostics)
    kept = kept[_in_front(problem.keep(kept), diagnostics)]
    kept = kept[_seen_twice(problem.keep(kept), diagnostics)]
    views = np.bincount(problem.camera[kept], minlength=problem.cameras)
    for camera in np.flatnonzero(views == 0):
        diagnostics.warn(
            "bal_camera_without_observations",
            f"{problem.name}: camera {camera} sees no point that can be used; it stays as it is",
        )
    if len(kept) == 0:
        raise DataError(f"{problem.name}: no point is in front of two cameras that saw it")
    return _renumbered(problem.keep(kept), diagnostics)


def _first_of_pair(problem: BalProblem, diagnostics: Diagnostics) -> IntArray:
    """The first observation of each point in each camera, by camera and then point."""
    pairs = problem.camera * problem.points + problem.point
    _, first = np.unique(pairs, return_index=True)
    repeated = np.ones(len(pairs), bool)
    repeated[first] = False
    for row in np.flatnonzero(repeated):
        diagnostics.warn(
            "bal_repeated_observation",
            f"{problem.name}: observation {row}: point {problem.point[row]} in camera "
            f"{problem.camera[row]} again; left out",
        )
    return np.asarray(first, dtype=np.int64)


def _in_front(problem: BalProblem, diagnostics: Diagnostics) -> BoolArray:
    """(N,) whether the point of each observation is in front of its camera."""
    pixels, depths = project(problem.estimates, problem.camera, problem.point)
    good = (depths > 0) & np.isfinite(pixels).all(axis=1)
    for row in np.flatnonzero(~good):
        diagnostics.warn(
            "bal_point_behind_camera",
            f"{problem.name}: point {problem.point[row]} is not in front of camera "
            f"{problem.camera[row]}; the observation is left out",
        )
    return good


def _seen_twice(problem: BalProblem, diagnostics: Diagnostics) -> BoolArray:
    """(N,) whether the point of each observation is seen by two cameras or more."""
    views = np.bincount(problem.point, minlength=problem.points)
    for point in np.flatnonzero(views < _FEWEST_VIEWS):
        diagnostics.warn(
            "bal_point_seen_once",
            f"{problem.name}: point {point} is seen by {views[point]} cameras; it stays as it is",
        )
    good: BoolArray = views[problem.point] >= _FEWEST_VIEWS
    return good


def _renumbered(problem: BalProblem, diagnostics: Diagnostics) -> BalPart:
    """The problem with only the variables that have observations."""
    cameras, camera = np.unique(problem.camera, return_inverse=True)
    points, point = np.unique(problem.point, return_inverse=True)
    estimates = problem.estimates.select(cameras, points)
    part = BalProblem(estimates, camera, point, problem.pixels, problem.name)
    groups = _groups(part)
    for group in range(1, int(groups.max()) + 1):
        diagnostics.warn(
            "bal_not_connected",
            f"{problem.name}: {np.count_nonzero(groups == group)} cameras have no point in common "
            "with the first ones; where they are to them stays as it is",
        )
    return BalPart(part, cameras, points, groups)


def _groups(part: BalProblem) -> IntArray:
    """(C,) the number of the group of cameras that each is in, linked by common points."""
    size = part.cameras + part.points
    ends = (part.camera, part.cameras + part.point)
    links = coo_array((np.ones(len(part.camera)), ends), shape=(size, size))
    _, labels = connected_components(links, directed=False)
    _, groups = np.unique(labels[: part.cameras], return_inverse=True)
    return groups.astype(np.int64)
