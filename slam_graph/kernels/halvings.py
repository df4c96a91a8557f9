# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The halvings of an image one behind another, as kernels take the levels of a pyramid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["halved", "halvings_room"]

_Image = NDArray[np.uint8]


def halvings_room(shape: tuple[int, ...], levels: int) -> int:
    """Bytes of so many halvings of an image of a shape (height, width)."""
    return sum(-(-shape[0] >> level) * -(-shape[1] >> level) for level in range(1, levels + 1))


def halved(image: _Image, halvings: _Image, level: int) -> _Image:
    """A level of a pyramid, as a view: the image itself, or one of its halvings.

    Args:
        image: (height, width).
        halvings: one behind another.
        level: 0 is the image.
    """
    if level == 0:
        return image
    begin, end = halvings_room(image.shape, level - 1), halvings_room(image.shape, level)
    return halvings[begin:end].reshape(-(-image.shape[0] >> level), -(-image.shape[1] >> level))
