# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Images brought into the frame of a pinhole without distortion, where no camera model fits them.

KITTI's unsynchronised images and those of TUM RGB-D are calibrated with five coefficients of
Brown's distortion (k1, k2, p1, p2, k3), one more than `Camera` knows.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.images import Image

FloatArray = NDArray[np.float64]
Size = tuple[int, int]


def rectifier(
    K: FloatArray,
    coefficients: FloatArray,
    rectified_R_camera: FloatArray,
    rectified_K: FloatArray,
    size: Size,
    rectified_size: Size,
) -> Callable[[Image], Image]:
    """What turns images of a distorted camera into rectified ones.

    Images of another size than `size` are handed back as they are, to be found by their size.

    Args:
        K: (3, 3) of the camera as it is.
        coefficients: (5,) k1, k2, p1, p2, k3.
        rectified_R_camera: (3, 3) rotation into the rectified frame.
        rectified_K: (3, 3) of the rectified camera.
        size: width and height of the images as they are.
        rectified_size: width and height of the rectified images.
    """
    maps = cv2.initUndistortRectifyMap(
        K, coefficients, rectified_R_camera, rectified_K, rectified_size, cv2.CV_16SC2
    )
    return partial(_remap, maps[0], maps[1], size)


def _remap(whole: NDArray[Any], fraction: NDArray[Any], size: Size, image: Image) -> Image:
    if image.shape[::-1] != size:
        return image
    return np.asarray(cv2.remap(image, whole, fraction, cv2.INTER_LINEAR), np.uint8)
