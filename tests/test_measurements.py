# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What frames of features and IMU samples say of themselves."""

import gtsam
import numpy as np
import pytest

from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData


def test_features_of_a_frame() -> None:
    """Their ids, and the frame without some of them."""
    none = np.zeros((3, 2))
    cameras = [FeatureObservations(np.array(ids), none, none) for ids in ([7, 2, 9], [9, 3, 2])]
    frame = FeatureFrame(0, tuple(cameras))
    assert frame.ids.tolist() == [2, 3, 7, 9]
    left = frame.without(np.array([11, 7, 3]))
    assert [camera.ids.tolist() for camera in left.cameras] == [[2, 9], [9, 2]]
    assert frame.without(np.array([5])).cameras == frame.cameras
    only = frame.only(np.array([11, 7, 3]))
    assert [camera.ids.tolist() for camera in only.cameras] == [[7], [3]]
    assert all(len(camera) == 0 for camera in frame.only(np.zeros(0, np.int64)).cameras)
    assert FeatureFrame(0, ()).ids.tolist() == []


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("pixels", [[np.inf, -np.inf], [1e308, 1e308], [np.nan, 0.0]])
def test_what_is_not_finite_is_left_out(pixels: list[float]) -> None:
    seen = np.array([pixels, [3.0, 4.0]])
    frame = FeatureFrame(0, (FeatureObservations(np.array([5, 8]), seen, np.zeros((2, 2))),))
    usable, left_out = frame.usable(1)
    finite = np.isfinite(seen).all(axis=1)
    assert usable.ids.tolist() == np.array([5, 8])[finite].tolist()
    assert left_out == np.count_nonzero(~finite)


def test_chained_rotations() -> None:
    """As products one after the other."""
    turns = [gtsam.Rot3.Rodrigues(0.1 * k, 0.2, 0.3).matrix() for k in range(3)]
    chained = ImuData.chained(np.array(turns))
    np.testing.assert_allclose(chained[-1], turns[0] @ turns[1] @ turns[2], atol=1e-15)
    assert np.array_equal(chained[0], np.eye(3))
    assert np.array_equal(ImuData.chained(np.zeros((0, 3, 3))), [np.eye(3)])
