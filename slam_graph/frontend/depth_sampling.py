# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The measured depth of features: taken from a depth image where its neighbourhood is one surface.

A plane in the world has an inverse depth that is linear in the pixels of a camera without
distortion, and nearly so over a few pixels of any other. So a plane is fitted to the inverse depths
around a feature. At the edge of an object, or where a depth is wrong, some of them are off by more
than the noise of the sensor explains; such a feature has no depth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.frontend.frontend_protocol import FrameStats
from slam_graph.sensors import CameraFrame, DepthSensor, FeatureObservations

_Metres = NDArray[np.float32]
"""(height, width) depth along the optical axis in m; NaN where there is none."""

_RADIUS = 2
"""The neighbourhood has 5 x 5 pixels around that nearest to a feature."""

_LEAST_VALID = 0.6
"""Share of the neighbourhood that must have a depth; the pixels next to the feature all must."""

_MOST_SIGMAS = 4.0
"""A neighbour whose inverse depth is farther off the plane than this has another surface."""

_PLACE_SIGMA_PX = 1.0
"""Uncertainty of where in the depth image a feature is, by registration and rolling shutters. On a
slanted surface it is one of the depth. With one pixel, predictions from frame to frame on TUM RGB-D
are off by as much as the standard deviations say in the median."""

_STEPS = np.arange(-_RADIUS, _RADIUS + 1)
_DU, _DV = (grid.ravel() for grid in np.meshgrid(_STEPS, _STEPS))
_DESIGN: FloatArray = np.column_stack([np.ones(len(_DU)), _DU, _DV]).astype(np.float64)


class DepthSampler:
    """Gives the features of a camera the depths that are measured with its images.

    Features are looked up where the camera's image has them, also if the depth image was taken a
    few milliseconds before or after: moving them on by their own motion fits TUM RGB-D worse.

    Args:
        sensor: camera and noise.

    Attributes:
        camera: number of the camera.
    """

    def __init__(self, sensor: DepthSensor) -> None:
        self.camera = sensor.camera
        self._sensor = sensor

    def measure(
        self, seen: FeatureObservations, frame: CameraFrame, stats: FrameStats
    ) -> FeatureObservations:
        """The features of a frame with their depths.

        Args:
            seen: N features of the camera.
            frame: may have a depth image.
            stats: counts the features `with_depth`.
        """
        if frame.depth is None:
            nothing = np.full(len(seen), np.nan)
            return replace(seen, depth_m=nothing, depth_sigma_m=nothing.copy())
        depth_m, sigma_m = sample_depth(seen.pixels, frame.depth, self._sensor)
        stats.count(with_depth=np.isfinite(depth_m))
        return replace(seen, depth_m=depth_m, depth_sigma_m=sigma_m)


def sample_depth(
    places: FloatArray, depth: _Metres, sensor: DepthSensor
) -> tuple[FloatArray, FloatArray]:
    """Depths (N,) at pixels and their standard deviations (N,), in m; NaN where there is none.

    Inverse depth is interpolated between the four pixels around a place. Its standard deviation is
    that of one pixel, as the errors of neighbouring pixels are alike, and that of the place.

    Args:
        places: (N, 2) pixels.
        depth: (height, width) in m, NaN where there is none.
        sensor: noise of the depth.
    """
    height, width = depth.shape
    depth_m, sigma_m = np.full(len(places), np.nan), np.full(len(places), np.nan)
    with np.errstate(invalid="ignore"):
        last = [width - 1 - _RADIUS, height - 1 - _RADIUS]
        inside = np.all((places >= _RADIUS) & (places < last), axis=1)
    rows = np.flatnonzero(inside)
    if len(rows) == 0:
        return depth_m, sigma_m
    u, v = places[rows].T
    inverse = _interpolated(depth, u, v)
    centre_u, centre_v = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
    around = depth[centre_v[:, None] + _DV, centre_u[:, None] + _DU].astype(np.float64)
    flat, slope = _one_surface(1.0 / around, sensor)
    good = flat & np.isfinite(inverse)
    rows, z = rows[good], 1.0 / inverse[good]
    noise = sensor.sigma_m(z)
    depth_m[rows] = z
    sigma_m[rows] = np.hypot(noise, z**2 * slope[good] * _PLACE_SIGMA_PX)
    return depth_m, sigma_m


def _interpolated(depth: _Metres, u: FloatArray, v: FloatArray) -> FloatArray:
    """Inverse depths (N,) between four pixels; NaN where one of them has none."""
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    right, below = u - left, v - top
    corners = [(0, 0), (1, 0), (0, 1), (1, 1)]
    weights = [(right if du else 1 - right) * (below if dv else 1 - below) for du, dv in corners]
    values = [1.0 / depth[top + dv, left + du].astype(np.float64) for du, dv in corners]
    total: FloatArray = np.sum(np.multiply(weights, values), axis=0)
    return total


def _one_surface(inverse: FloatArray, sensor: DepthSensor) -> tuple[BoolArray, FloatArray]:
    """Whether the inverse depths (N, 25) of each neighbourhood are those of one surface.

    Returns:
        Which are (N,), and by how much the inverse depth changes from pixel to pixel (N,), 1/m.
    """
    valid = np.isfinite(inverse)
    enough = np.mean(valid, axis=1) >= _LEAST_VALID
    values: FloatArray = np.where(valid, inverse, 0.0)
    normal: FloatArray = np.einsum("nk,ki,kj->nij", valid, _DESIGN, _DESIGN)
    normal[~enough] = np.eye(3)
    solved = np.linalg.solve(normal, (values @ _DESIGN)[:, :, None])
    plane: FloatArray = solved.astype(np.float64)[:, :, 0]
    fitted: FloatArray = plane @ _DESIGN.T
    # sigma of 1/z is that of z over z²
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = sensor.sigma_m(1.0 / fitted) * fitted**2
        off = np.abs(inverse - fitted) > _MOST_SIGMAS * sigma
    flat = enough & ~np.any(off & valid, axis=1) & np.all(fitted > 0.0, axis=1)
    return flat, np.linalg.norm(plane[:, 1:], axis=1)
