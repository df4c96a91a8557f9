# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Axes of gyroscope or accelerometer that always measure the same, while the platform moves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.diagnosis.finding import Finding
from slam_graph.diagnosis.frame_pairs import FramePair
from slam_graph.diagnosis.gathering import Part
from slam_graph.diagnosis.gyroscope import Gyroscope

_LEAST_TURN_RAD, _LEAST_SHARE = 0.01, 0.25
"""The camera turns about an axis from so much from frame to frame on, and from such a share of all
of its turns on: a platform on a plane never turns about two of them."""
_LEAST_CHANGE = 1.0
"""Gravity moves along an axis of the accelerometer from so much on, m/s²."""
_MOST = 0.75
"""This share of the turns about an axis are smaller than what counts as its turn."""
_BLOCK_S = 1.0
"""Gravity is followed for so long at a time, as the bias of the gyroscope turns it away."""
_FIX = "look at the driver and at the columns that are read; --no-imu runs without the IMU"


def constant_axes(samples: FloatArray) -> BoolArray:
    """Which axes (3,) of samples (N, 3) never change: the noise of a sensor that works does."""
    return np.asarray(np.ptp(samples, axis=0) == 0.0)


def anything_constant(parts: list[Part]) -> bool:
    """Whether an axis of a part never changes, which is right only where nothing moves."""
    return any(
        np.any(constant_axes(part.imu.gyro) | constant_axes(part.imu.accel)) for part in parts
    )


def check_gyroscope(
    parts: list[Part], pairs: list[FramePair], body_R_camera: FloatArray
) -> list[Finding]:
    """A finding if an axis is constant about which the images turn.

    Args:
        parts: with samples.
        pairs: of the frames, with turns of the camera.
        body_R_camera: (3, 3) calibrated mounting.
    """
    for number, part in enumerate(parts):
        turns = [p.turn for p in pairs if p.part == number and p.turn is not None]
        constant = constant_axes(part.imu.gyro)
        if not turns or not np.any(constant):
            continue
        turned = np.array(turns) @ body_R_camera.T
        turned = np.abs(turned - np.median(turned, axis=0))
        size = np.quantile(turned, _MOST, axis=0)
        seen = size > max(_LEAST_TURN_RAD, _LEAST_SHARE * float(np.linalg.norm(size)))
        if np.any(constant & seen):
            degrees = float(np.rad2deg(np.linalg.norm(np.array(turns), axis=1).max()))
            what = (
                f"the gyroscope says nothing: {_said(constant, part.imu.gyro[0], 'rad/s')}, while "
                f"the images turn by up to {degrees:.1f}° from frame to frame"
            )
            values = {"axes": constant.tolist(), "degrees": degrees}
            return [Finding("gyroscope_constant", "error", what, _FIX, values=values)]
    return []


def check_accelerometer(
    parts: list[Part], gyroscopes: list[Gyroscope], turns: bool
) -> list[Finding]:
    """A finding if an axis is constant that gravity should move along as the gyroscope turns.

    Args:
        parts: with samples.
        gyroscopes: of the parts.
        turns: whether the images turn; nothing is said where they do not.
    """
    for part, gyroscope in zip(parts if turns else [], gyroscopes if turns else [], strict=True):
        force = part.imu.accel
        constant = constant_axes(force)
        alone = bool(np.all(constant)) and float(np.linalg.norm(force[0])) > 0.0
        if alone or np.any(constant & (_change_of_gravity(gyroscope) > _LEAST_CHANGE)):
            what = (
                f"the accelerometer says nothing: {_said(constant, force[0], 'm/s²')}, while the "
                "platform turns"
            )
            values = {"axes": constant.tolist()}
            return [Finding("accelerometer_constant", "error", what, _FIX, values=values)]
    return []


def _change_of_gravity(gyroscope: Gyroscope) -> FloatArray:
    """How far gravity moves along each axis (3,) within `_BLOCK_S`, by the gyroscope, m/s²."""
    ends = np.arange(0.0, float(gyroscope.t[-1]) + _BLOCK_S, _BLOCK_S)
    largest = np.zeros(3)
    for first, last in pairwise(np.searchsorted(gyroscope.t, ends).tolist()):
        R = gyroscope.R[first:last]
        if len(R):
            forces = np.einsum("nji,jk,k->ni", R, R[0], gyroscope.force[first])
            largest = np.maximum(largest, np.ptp(forces, axis=0))
    return largest


def _said(constant: BoolArray, sample: FloatArray, unit: str) -> str:
    """Which axes always measure what."""
    text = ", ".join(f"{axis} {sample['xyz'.index(axis)]:.4g}" for axis in _names(constant))
    return f"it always measures {text} {unit}"


def _names(axes: BoolArray) -> list[str]:
    return [name for name, there in zip("xyz", axes, strict=True) if there]
