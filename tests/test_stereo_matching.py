# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Matches of two images: SIFT gets parts of them, which leaves no seam."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slam_graph.diagnosis import stereo_matching

SHIFT = np.array([7, 3])


def texture(height: int, width: int) -> NDArray[np.uint8]:
    """Smooth noise."""
    noise = np.random.default_rng(2).normal(size=(height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray(127.0 + 300.0 * smooth, np.float32).clip(0, 255).astype(np.uint8)


def test_a_shift_is_found_all_over_the_image_and_across_seams() -> None:
    whole = texture(470, 860)
    first, second = whole[:450, :850], whole[SHIFT[1] : 453, SHIFT[0] : 857]
    found = stereo_matching.match_images(0, first, second)
    assert len(found.first) > 200
    shifts = found.first - found.second
    np.testing.assert_allclose(shifts, np.broadcast_to(SHIFT, shifts.shape), atol=1.0)
    cells = np.histogram2d(*found.first.T, bins=(6, 3), range=[[0, 850], [0, 450]])[0]
    assert cells.min() > 0
    seam = 850.0 / 3.0
    assert np.any((found.first[:, 0] > seam) & (found.second[:, 0] < seam))


def test_keypoints_beside_a_seam_are_those_of_the_whole_image() -> None:
    """None twice, and none left out; a few differ, as each part has its own scales."""
    image = texture(450, 850)
    pixels, _ = stereo_matching._keypoints(image)
    found, _ = cv2.SIFT.create(stereo_matching._KEYPOINTS).detectAndCompute(image, None)
    whole = cv2.KeyPoint.convert(found)
    counts = [np.count_nonzero(np.abs(at[:, 0] - 850.0 / 3.0) < 40.0) for at in (pixels, whole)]
    assert len(pixels) == len(whole) == stereo_matching._KEYPOINTS
    assert abs(counts[0] - counts[1]) <= 0.1 * counts[1]


@pytest.mark.parametrize(("height", "width"), [(1, 1), (399, 400), (401, 300)])
def test_any_size_is_taken_also_two_different_ones(height: int, width: int) -> None:
    found = stereo_matching.match_images(5, texture(height, width), texture(300, 500))
    assert found.stamp_ns == 5
    assert found.first.shape == found.second.shape
