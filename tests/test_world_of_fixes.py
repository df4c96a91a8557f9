# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a ground truth is in the world of the position fixes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_graph.geometry import Similarity
from slam_graph.pipeline.world_of_fixes import is_in_world_of_fixes
from slam_graph.sensors import AidingData
from slam_graph.simulation import simulate


def test_a_truth_is_in_the_world_of_the_fixes_or_not() -> None:
    """Lever arm and noise do not hide it, and a turn by ten degrees does not pass."""
    gnss = {"sigma_m": 1.0, "rate_hz": 2.0, "lever_arm_m": (0.5, 0.0, 1.0), "multipath": 0.2}
    few = {"features": 60}
    sequence = simulate(
        trajectory="car", duration_s=40.0, seed=1, with_imu=False, tracks=few, gnss=gnss
    )
    truth = sequence.groundtruth()
    assert truth is not None
    assert is_in_world_of_fixes(truth, sequence.aiding)
    turned = Similarity(Rotation.from_euler("z", 10, degrees=True).as_matrix(), np.zeros(3), 1.0)
    moved = Similarity(np.eye(3), np.array([20.0, 0.0, 0.0]), 1.0)
    assert not is_in_world_of_fixes(turned.apply(truth), sequence.aiding)
    assert not is_in_world_of_fixes(moved.apply(truth), sequence.aiding)
    assert not is_in_world_of_fixes(None, sequence.aiding)
    assert not is_in_world_of_fixes(truth, AidingData.empty())


@pytest.mark.parametrize(("sigma_m", "shift_m"), [(0.3, 0.5), (2.0, 8.0)])
def test_the_noise_of_fixes_does_not_hide_another_world(sigma_m: float, shift_m: float) -> None:
    """On a path of 6 m, which fixes of 2 m do not resolve."""
    truth = simulate(trajectory="figure8", duration_s=20.0, rate_hz=10.0, seed=1).groundtruth()
    assert truth is not None
    some, rng = slice(2, -2, 2), np.random.default_rng(0)
    fixes = truth.positions[some] + rng.normal(0.0, sigma_m, truth.positions[some].shape)
    covariances = np.tile(sigma_m**2 * np.eye(3), (len(fixes), 1, 1))
    aiding = AidingData.of_fixes(truth.stamps_ns[some], fixes, covariances)
    assert is_in_world_of_fixes(truth, aiding)
    for turn_deg, shift in ((180.0, 0.0), (0.0, shift_m), (180.0, shift_m)):
        R = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
        other = Similarity(R, np.array([shift, 0.0, 0.0]), 1.0)
        assert not is_in_world_of_fixes(other.apply(truth), aiding)
