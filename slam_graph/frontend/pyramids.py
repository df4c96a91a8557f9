# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Image pyramids for Lucas-Kanade, built once for each image."""

from __future__ import annotations

from collections import OrderedDict

import cv2
import numpy as np

from slam_graph.frontend.keypoints import Image
from slam_graph.kernels.window_tracking import BORDER_PX, WINDOW_PX


class Pyramid:
    """An image (height, width) and its halvings, each built when it is asked for.

    Attributes:
        image: level 0.
        highest: the last level. The window does not fit into further ones.
    """

    def __init__(self, image: Image) -> None:
        self.image = image
        self._inner = [image]
        self._bordered: list[Image] = []
        size, self.highest = min(image.shape), 0
        while (size := (size + 1) // 2) > WINDOW_PX:
            self.highest += 1

    def level(self, level: int) -> Image:
        """A level with the border that the kernel wants."""
        while len(self._bordered) <= level:
            if len(self._bordered) == len(self._inner):
                self._inner.append(np.asarray(cv2.pyrDown(self._inner[-1]), np.uint8))
            border = (BORDER_PX,) * 4
            bordered = cv2.copyMakeBorder(self._inner[-1], *border, cv2.BORDER_REFLECT_101)
            self._bordered.append(np.asarray(bordered, np.uint8))
        return self._bordered[level]


class Pyramids:
    """The pyramids of the images that were tracked last.

    Args:
        count: how many images are in use at a time.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._latest: OrderedDict[int, Pyramid] = OrderedDict()  # which keep their images alive

    def of(self, image: Image) -> Pyramid:
        """The pyramid of an image, which must not have changed since it was first asked for."""
        pyramid = self._latest.pop(id(image), None) or Pyramid(image)
        self._latest[id(image)] = pyramid
        if len(self._latest) > self._count:
            self._latest.popitem(last=False)
        return pyramid
