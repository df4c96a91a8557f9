# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A camera model that the package does not have, as a plugin would bring it: all that it needs."""

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.camera_model import CameraModel, register_camera_model


@register_camera_model
class FieldOfView(CameraModel):
    """The field-of-view model: an image radius of atan(2 r tan(ω/2)) / ω.

    Devernay and Faugeras, "Straight lines have to be straight", 2001.
    """

    name = "atan_fov"
    coefficient_names = ("w",)
    ranges = {"w": (0.0, 3.1)}  # noqa: RUF012
    sees_sideways = True

    def distort(
        self, m: FloatArray, coefficients: tuple[float, ...]
    ) -> tuple[FloatArray, FloatArray]:
        (w,) = coefficients
        a, r = 2.0 * np.tan(0.5 * w), np.maximum(np.hypot(m[:, 0], m[:, 1]), 1e-9)
        scale = np.where(r > 1e-5, np.arctan(a * r) / (w * r), a / w)
        slope = np.where(r > 1e-5, (a / (1.0 + (a * r) ** 2) / w - scale) / r**2, 0.0)
        jacobian = scale[:, None, None] * np.eye(2)
        jacobian = jacobian + slope[:, None, None] * m[:, :, None] * m[:, None, :]
        return m * scale[:, None], jacobian

    def by_coefficients(self, m: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
        (w,) = coefficients
        a, r = 2.0 * np.tan(0.5 * w), np.maximum(np.hypot(m[:, 0], m[:, 1]), 1e-9)
        by_w = r * (1.0 + 0.25 * a * a) / (1.0 + (a * r) ** 2) / w - np.arctan(a * r) / w**2
        derivative: FloatArray = (m * (by_w / r)[:, None])[:, :, None]
        return derivative


FOV = Camera(200.0, 201.0, 255.0, 256.5, "atan_fov", (0.92,), 512, 512)
