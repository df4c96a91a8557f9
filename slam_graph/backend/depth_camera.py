# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Depth as a measurement: what a depth sensor says of a feature, as a second camera would.

A camera beside the first one, at a distance b along its x axis, sees a point of depth z at
x - b / z on its plane z = 1. So a depth is an observation of a virtual camera, and its
noise, which grows with z², is that of a disparity. The observation repeats the pixel of the real
camera, which must not count twice: so the noise of the virtual camera is r times as
large, by a focal length that is r times as small, and the distance b is such that z has the noise
of the sensor. What is counted twice of the pixel is then 1 / r².
"""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np

from slam_graph.arrays import BoolArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.sensors import (
    Camera,
    DepthSensor,
    FeatureFrame,
    FeatureObservations,
    Rig,
    RigCamera,
)

_NOISIER = 4.0
"""r: how many times noisier the virtual camera is."""
_NEAR_M = 0.7
"""The constant part of a depth's noise counts as it does at this depth; nearer it counts less."""
_MAX_SIGMAS = 3.0
"""A depth whose noise is so many times that of the sensor at its depth is left out."""


def with_depth_camera(rig: Rig) -> Rig:
    """The rig with a camera, the last one, that stands for its depth sensor, if it has one.

    Its noise is that of the sensor where the noise of a pixel (`noise.pixel_sigma`) is 1.
    """
    if rig.depth is None:
        return rig
    mounted = rig.cameras[rig.depth.camera]
    real = mounted.camera
    camera = replace(
        real,
        fx=real.fx / _NOISIER,
        fy=real.fy / _NOISIER,
        cx=real.cx / _NOISIER,
        cy=real.cy / _NOISIER,
        distortion="none",
        coefficients=(),
        width=max(1, round(real.width / _NOISIER)),
        height=max(1, round(real.height / _NOISIER)),
    )
    beside = gtsam.Pose3(gtsam.Rot3(), np.array([_baseline_m(rig.depth, real), 0.0, 0.0]))
    body_T_camera = mounted.body_T_camera.compose(beside)
    virtual: RigCamera = replace(
        mounted, camera=camera, body_T_camera=body_T_camera, name=f"{mounted.name}_depth"
    )
    return replace(rig, cameras=(*rig.cameras, virtual))


def with_depth_observed(frame: FeatureFrame, rig: Rig) -> FeatureFrame:
    """The frame with the observations of the camera that stands for the depth sensor.

    Args:
        frame: of the rig's cameras.
        rig: as it is, without that camera.
    """
    if rig.depth is None or len(frame.cameras) != len(rig.cameras):
        return frame
    seen, camera = frame.cameras[rig.depth.camera], rig.cameras[rig.depth.camera].camera
    if seen.depth_m is None or seen.depth_sigma_m is None:
        return replace(frame, cameras=(*frame.cameras, FeatureObservations.empty()))
    with np.errstate(invalid="ignore"):
        noise = _square_noise_per_m(rig.depth) * seen.depth_m**2
        rows = (seen.depth_m > 0.0) & (seen.depth_sigma_m < _MAX_SIGMAS * noise)
    beside = seen.normalized[rows].copy()
    beside[:, 0] -= _baseline_m(rig.depth, camera) / seen.depth_m[rows]
    pixels = (beside * [camera.fx, camera.fy] + [camera.cx, camera.cy]) / _NOISIER
    return replace(
        frame, cameras=(*frame.cameras, FeatureObservations(seen.ids[rows], pixels, beside))
    )


def is_of_depth(obs: Observations, rig: Rig) -> BoolArray:
    """Which observations (N,) are those of the depth sensor of a rig `with_depth_camera`."""
    return np.equal(obs.camera, len(rig.cameras) - 1 if rig.depth is not None else -1)


def _square_noise_per_m(sensor: DepthSensor) -> float:
    """Standard deviation of a depth z over z², 1/m."""
    return sensor.noise_square_per_m + sensor.noise_constant_m / _NEAR_M**2


def _baseline_m(sensor: DepthSensor, camera: Camera) -> float:
    """Distance of the virtual camera.

    The inverse depth has the standard deviation k of `_square_noise_per_m`, and b times it is the
    difference of two coordinates, of 1 and r pixels.
    """
    pixels = math.hypot(1.0, _NOISIER)
    return pixels / (camera.fx * _square_noise_per_m(sensor))
