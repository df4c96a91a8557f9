# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A bundle-adjustment problem as BAL has it: cameras, points, and where each was seen in which.

The camera of BAL (Agarwal, Snavely, Seitz & Szeliski 2010) looks along its negative z axis:

    P = R X + t,   p = -P_xy / P_z,   pixel = f (1 + k1 ‖p‖² + k2 ‖p‖⁴) p,

with (R, t) = camera_T_world and pixels from the centre of the image, y up. Neither the unit of
length nor the frame of the world means anything: every similarity of the world has the same pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

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
