# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The depth sensor of a rig: what its images mean, and their noise."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.sensors.camera import Camera


@dataclass(frozen=True, eq=False)
class DepthSensor:
    """What measures the depth of the points that a camera of a rig sees.

    The depth images of a frame are always registered to that camera: a pixel is the depth, along
    the camera's axis, of what the camera has there. Those of a recording are as well, unless `lens`
    says otherwise; a reader then registers them.

    The standard deviation of a depth z is `noise_constant_m` + `noise_square_per_m` z²: depth is
    found by triangulation, in which an error of e pixels of disparity, with a focal length of f
    pixels and a baseline b, is one of z² e / (f b). The default is that of a small depth camera of
    two infrared images, such as RealSense D435: 0.08 px of disparity in textured scenes (Keselman
    et al., "Intel RealSense Stereoscopic Depth Cameras", CVPR workshops 2017), a focal length of
    425 px, and a baseline of 50 mm.

    Attributes:
        camera: number, in the rig, of the camera.
        scale: units to a metre in images of 16 bits (1000 are mm; TUM RGB-D has 5000). In images of
            floating-point numbers they are metres.
        min_m: smallest depth that is trusted.
        max_m: largest depth that is trusted.
        noise_constant_m: part of the standard deviation of a depth that is the same at all depths.
        noise_square_per_m: part that grows with the squared depth, 1/m.
        lens: intrinsics of a depth camera of its own, whose images are not registered; None where
            they are.
        camera_T_depth: its pose in the frame of the camera.
    """

    camera: int = 0
    scale: float = 1000.0
    min_m: float = 0.3
    max_m: float = 10.0
    noise_constant_m: float = 1e-3
    noise_square_per_m: float = 3.8e-3
    lens: Camera | None = None
    camera_T_depth: gtsam.Pose3 = field(default_factory=gtsam.Pose3)

    @staticmethod
    def kinect(scale: float = 1000.0) -> DepthSensor:
        """Microsoft's first Kinect, or another sensor of structured light of its geometry.

        The noise is that of Khoshelham and Elberink, "Accuracy and Resolution of Kinect Depth Data
        for Indoor Mapping Applications", Sensors 2012: 2.85e-5 per cm and half a unit of disparity.
        Its constant part is about the smallest error in Nguyen et al., "Modeling Kinect Sensor
        Noise for Improved 3D Reconstruction and Tracking", 3DIMPVT 2012. It measures nothing nearer
        than 0.4 m, and little that is farther away than 5 m.

        Args:
            scale: units to a metre in images of 16 bits.
        """
        return DepthSensor(0, scale, 0.4, 8.0, 1e-3, 1.425e-3)

    def sigma_m(self, depth_m: FloatArray) -> FloatArray:
        """Standard deviations, in m, of depths in m."""
        sigma: FloatArray = self.noise_constant_m + self.noise_square_per_m * depth_m**2
        return sigma

    def metres(self, raw: NDArray[np.uint16] | NDArray[np.float32]) -> NDArray[np.float32]:
        """Depth in m of a raw image (height, width); NaN where it is 0 or outside of the range."""
        depth = raw.astype(np.float32)
        if raw.dtype == np.uint16:
            depth /= np.float32(self.scale)
        with np.errstate(invalid="ignore"):
            measured = (depth > 0.0) & (depth >= self.min_m) & (depth <= self.max_m)
        depth[~measured] = np.nan
        return depth

    def raw(self, depth: NDArray[np.float32]) -> NDArray[np.uint16]:
        """The image (height, width) of 16 bits of a depth; `metres` undoes it.

        It has 0 for NaN, and for what 16 bits of these units do not hold.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            units = np.rint(depth * np.float32(self.scale))
            fits = (units > 0.0) & (units <= np.iinfo(np.uint16).max)
        return np.where(fits, units, 0.0).astype(np.uint16)
