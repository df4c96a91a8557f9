# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What of a bundle-adjustment problem can be estimated; all else is left out and counted.

A bundle-adjustment problem as BAL has it: cameras, points, and where each was seen in which.

The camera of BAL (Agarwal, Snavely, Seitz & Szeliski 2010) looks along its negative z axis:

    P = R X + t,   p = -P_xy / P_z,   pixel = f (1 + k1 ‖p‖² + k2 ‖p‖⁴) p,

with (R, t) = camera_T_world and pixels from the centre of the image, y up. Neither the unit of
length nor the frame of the world means anything: every similarity of the world has the same pixels.

The camera of BAL: pixels of points, and their derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError

POSE_DIM = 6
CAMERA_DIM = 9
"""Of a camera: rotation, translation, f k1 k2."""


@dataclass(frozen=True, slots=True, eq=False)
class BalEstimates:
    """All variables.

    Their tangent, by camera: δθ and δt in the camera's frame, R ← Exp(δθ) R and t ← t + δt, and
    additions to f, k1, k2; and additions to the points.

    Attributes:
        rotations: (C, 3, 3) camera_R_world.
        translations: (C, 3) world's origin in the camera's frame.
        intrinsics: (C, 3) f in pixels, k1, k2.
        points: (P, 3) in the world.
    """

    rotations: FloatArray
    translations: FloatArray
    intrinsics: FloatArray
    points: FloatArray

    def centres(self) -> FloatArray:
        """(C, 3) centres of the cameras in the world."""
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
        """With new values of some cameras and points."""
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


@dataclass(frozen=True, slots=True, eq=False)
class BalPrior:
    """What is known of poses and points beside the images, up to normal errors.

    Attributes:
        rotations: (C, 3, 3) camera_R_world.
        centres: (C, 3) of the cameras in the world.
        points: (P, 3) in the world.
        rotation_sigma: standard deviation of the rotations about each axis, rad.
        centre_sigma: of the centres along each axis, in the unit of length of the world.
        point_sigmas: (P,) of the points.
    """

    rotations: FloatArray
    centres: FloatArray
    points: FloatArray
    rotation_sigma: float
    centre_sigma: float
    point_sigmas: FloatArray

    def select(self, cameras: IntArray, points: IntArray) -> BalPrior:
        """Only some cameras and points."""
        return replace(
            self,
            rotations=self.rotations[cameras],
            centres=self.centres[cameras],
            points=self.points[points],
            point_sigmas=self.point_sigmas[points],
        )


@dataclass(frozen=True, slots=True, eq=False)
class BalProblem:
    """Cameras, points and observations.

    Attributes:
        estimates: of all cameras and points.
        camera: (N,) index of the camera of each observation.
        point: (N,) index of its point.
        pixels: (N, 2) from the centre of the image, y up.
        name: of the problem.
        prior: on poses and points; with one there is no gauge, the world is that of the prior.
        lenses: (C,) numbers, from 0 on, of what has intrinsics of its own; if there are none, each
            camera has.
    """

    estimates: BalEstimates
    camera: IntArray
    point: IntArray
    pixels: FloatArray
    name: str = "problem"
    prior: BalPrior | None = None
    lenses: IntArray | None = None

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
    """What of a problem can be estimated, with variables renumbered.

    Attributes:
        problem: observations by camera, then point; every camera and point has some.
        cameras: (C,) indices of its cameras in the whole problem.
        points: (P,) indices of its points there.
        groups: (C,) for each camera the number of its group; two groups have no point in common.
    """

    problem: BalProblem
    cameras: IntArray
    points: IntArray
    groups: IntArray

    @cached_property
    def camera_starts(self) -> IntArray:
        """(C + 1,) first observation of each camera, and the number of all."""
        return np.searchsorted(self.problem.camera, np.arange(self.problem.cameras + 1))


NEWTON_STEPS = 10
"""More than enough for the weak distortion that a calibration leaves."""


@dataclass(frozen=True, slots=True, eq=False)
class BalLinearization:
    """N observations, linearised.

    Attributes:
        by_camera: (N, 2, 9) derivatives of the pixels by δθ, δt, f, k1, k2.
        by_point: (N, 2, 3) derivatives by the point.
        r: (N, 2) predicted less measured pixels.
    """

    by_camera: FloatArray
    by_point: FloatArray
    r: FloatArray


def project(
    estimates: BalEstimates, camera: IntArray, point: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Where points are seen.

    Args:
        estimates: cameras and points.
        camera: (N,) indices of cameras.
        point: (N,) indices of points.

    Returns:
        pixels: (N, 2); not finite for a point in the plane of the camera.
        depths: (N,) along the optical axis; negative behind the camera.
    """
    P = _turned(estimates, camera, point) + estimates.translations[camera].T
    f, k1, k2 = estimates.intrinsics[camera].T
    with np.errstate(all="ignore"):
        u, v = -P[:2] / P[2]
        q = u * u + v * v
        scale = f * (1.0 + q * (k1 + q * k2))
        return np.stack([scale * u, scale * v], axis=1), -P[2]


def linearize(
    estimates: BalEstimates, camera: IntArray, point: IntArray, pixels: FloatArray
) -> BalLinearization:
    """Residuals and derivatives of observations; arguments as of `project`, and (N, 2) measured.

    With (u, v) = -P_xy / P_z and the distortion d(q), q = u² + v², the pixel depends on P by

        G = f (d I + 2 d' (u, v)ᵀ (u, v)) · -1/P_z [I (u, v)ᵀ],

    and P = R X + t on δθ by -[R X]ₓ.
    """
    N, y = len(camera), _turned(estimates, camera, point)
    P = y + estimates.translations[camera].T
    f, k1, k2 = estimates.intrinsics[camera].T
    inverse = -1.0 / P[2]
    uv = P[:2] * inverse
    q = uv[0] ** 2 + uv[1] ** 2
    d, twice_slope = 1.0 + q * (k1 + q * k2), 2.0 * (k1 + 2.0 * q * k2)
    along = f * inverse * twice_slope
    R = estimates.rotations[camera].transpose(1, 2, 0)
    by_camera, by_point = np.empty((N, 2, CAMERA_DIM)), np.empty((N, 2, 3))
    for row in range(2):
        g = np.empty((3, N))
        g[:2] = along * uv[row] * uv
        g[row] += f * inverse * d
        g[2] = g[0] * uv[0] + g[1] * uv[1]
        for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            by_camera[:, row, a] = y[b] * g[c] - y[c] * g[b]
            by_camera[:, row, 3 + a] = g[a]
            by_point[:, row, a] = g[0] * R[0, a] + g[1] * R[1, a] + g[2] * R[2, a]
        by_camera[:, row, 6] = d * uv[row]
        by_camera[:, row, 7] = f * q * uv[row]
        by_camera[:, row, 8] = f * q * q * uv[row]
    return BalLinearization(by_camera, by_point, (f * d * uv).T - pixels)


def rays_of(pixels: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """Where pixels (N, 2) are on the plane at distance 1; (N, 3) intrinsics f, k1, k2.

    The radius ρ of f (1 + k1 ρ² + k2 ρ⁴) ρ is found by Newton's method, from that without
    distortion.
    """
    f, k1, k2 = intrinsics.T
    plain = np.linalg.norm(pixels, axis=1) / f
    radius = plain.copy()
    for _ in range(NEWTON_STEPS):
        q = radius**2
        miss = radius * (1.0 + q * (k1 + q * k2)) - plain
        radius -= miss / (1.0 + q * (3.0 * k1 + q * 5.0 * k2))
    shrunk = np.divide(radius, plain, out=np.ones_like(plain), where=plain > 0)
    return np.asarray(pixels * (shrunk / f)[:, None])


def _turned(estimates: BalEstimates, camera: IntArray, point: IntArray) -> FloatArray:
    """(3, N) R X of each observation."""
    X = estimates.points[point].T
    R = estimates.rotations[camera].transpose(1, 2, 0)
    return np.asarray(R[:, 0] * X[0] + R[:, 1] * X[1] + R[:, 2] * X[2])


FEWEST_VIEWS = 2
"""Cameras in which a point must have been seen of which nothing else is known."""


def usable(problem: BalProblem, diagnostics: Diagnostics) -> BalPart:
    """The part of a problem that can be estimated.

    Left out and counted are second observations of a point in a camera, observations of points
    that are not in front of their camera at the start, points that are then seen by fewer than two
    cameras unless there is a prior, and cameras that see none of the others. They keep the
    estimates that they have.

    Raises:
        DataError: if nothing is left.
    """
    kept = _first_of_pair(problem, diagnostics)
    kept = kept[_in_front(problem.keep(kept), diagnostics)]
    if problem.prior is None:
        kept = kept[_seen_twice(problem.keep(kept), diagnostics)]
    for camera in np.setdiff1d(np.arange(problem.cameras), problem.camera[kept]):
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
    for row in np.setdiff1d(np.arange(len(pairs)), first):
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
    for point in np.flatnonzero(views < FEWEST_VIEWS):
        diagnostics.warn(
            "bal_point_seen_once",
            f"{problem.name}: point {point} is seen by {views[point]} cameras; it stays as it is",
        )
    good: BoolArray = views[problem.point] >= FEWEST_VIEWS
    return good


def _renumbered(problem: BalProblem, diagnostics: Diagnostics) -> BalPart:
    """The problem with only the variables that have observations."""
    cameras, camera = np.unique(problem.camera, return_inverse=True)
    points, point = np.unique(problem.point, return_inverse=True)
    estimates = problem.estimates.select(cameras, points)
    prior, lenses = problem.prior, problem.lenses
    prior = None if prior is None else prior.select(cameras, points)
    lenses = None if lenses is None else np.unique(lenses[cameras], return_inverse=True)[1]
    part = BalProblem(estimates, camera, point, problem.pixels, problem.name, prior, lenses)
    groups = _groups(part)
    apart = range(1, int(groups.max()) + 1) if prior is None else range(0)
    for group in apart:
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
