# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Images of one camera at the scale of another: a patch of one is then as large in the other.

Patches are compared pixel by pixel, which needs images of about the same focal length.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.frontend.keypoints import Image, Pixels
from slam_graph.sensors import Camera

_ALIKE = 1.2
"""Ratio of focal lengths up to which images stay as they are: of the matches in EuRoC's images it
costs a twentieth, 1.33 a quarter, and 2 nearly all."""


class CommonScale:
    """Images of a camera, resampled where its focal length is not about that of a reference.

    Args:
        camera: whose images they are.
        reference: the other camera.

    Attributes:
        camera: that would have taken the images as they come out.
    """

    def __init__(self, camera: Camera, reference: Camera) -> None:
        factors = _focal_px(reference) / _focal_px(camera)
        size = np.array([camera.width, camera.height])
        self._resamples = bool(np.any(np.abs(np.log(factors)) > np.log(_ALIKE)))
        self.camera = camera
        if not self._resamples:
            return
        resampled = np.maximum(np.rint(size * factors), 1.0)
        self._factors: FloatArray = resampled / size
        self._enlarges = bool(np.all(self._factors > 1.0))
        fx, fy, cx, cy = camera.intrinsics
        across, down = self._factors
        self.camera = replace(
            camera,
            fx=fx * across,
            fy=fy * down,
            cx=(cx + 0.5) * across - 0.5,
            cy=(cy + 0.5) * down - 0.5,
            width=int(resampled[0]),
            height=int(resampled[1]),
        )

    def image(self, image: Image) -> Image:
        """An image of the camera, at the scale of the reference."""
        if not self._resamples:
            return image
        how = cv2.INTER_LINEAR if self._enlarges else cv2.INTER_AREA
        size = (self.camera.width, self.camera.height)
        return np.asarray(cv2.resize(image, size, interpolation=how), np.uint8)

    def raw(self, pixels: Pixels) -> Pixels:
        """Where pixels (N, 2) of a resampled image are in the image of the camera."""
        if not self._resamples:
            return pixels
        return ((pixels + 0.5) / self._factors - 0.5).astype(np.float32)


def _focal_px(camera: Camera) -> FloatArray:
    """Pixels per tangent (2,) across and down in the middle of an image.

    They are `fx` and `fy`, except for lens models in which these are generalised.
    """
    _, jacobian = camera.distort(np.zeros((1, 2)))
    focal_px: FloatArray = np.abs(np.diag(jacobian[0]))
    return focal_px
