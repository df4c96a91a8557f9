# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a ground truth is in the world of the position fixes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_graph.backend.backend_config import BackendConfig
from slam_graph.geometry import Similarity
from slam_graph.pipeline.world_of_fixes import is_in_world_of_fixes
from slam_graph.sensors import AidingData
from slam_graph.simulation import simulate


def with_arm(arm_m: tuple[float, float, float]) -> BackendConfig:
    return BackendConfig.model_validate({"gnss": {"lever_arm_m": arm_m}})


def test_a_truth_is_in_the_world_of_the_fixes_or_not() -> None:
    """Multipath and noise do not hide it, and a turn by ten degrees does not pass."""
    arm_m = (0.5, 0.0, 1.0)
    gnss = {"sigma_m": 1.0, "rate_hz": 2.0, "lever_arm_m": arm_m, "multipath": 0.2}
    few, config = {"features": 60}, with_arm(arm_m)
    sequence = simulate(
        trajectory="car", duration_s=40.0, seed=1, with_imu=False, tracks=few, gnss=gnss
    )
    truth = sequence.groundtruth()
    assert truth is not None
    assert is_in_world_of_fixes(truth, sequence.aiding, config)
    turned = Similarity(Rotation.from_euler("z", 10, degrees=True).as_matrix(), np.zeros(3), 1.0)
    moved = Similarity(np.eye(3), np.array([20.0, 0.0, 0.0]), 1.0)
    assert not is_in_world_of_fixes(turned.apply(truth), sequence.aiding, config)
    assert not is_in_world_of_fixes(moved.apply(truth), sequence.aiding, config)
    assert not is_in_world_of_fixes(None, sequence.aiding, config)
    assert not is_in_world_of_fixes(truth, AidingData.empty(), config)


@pytest.mark.parametrize("trajectory", ["car", "random", "figure8"])
def test_exact_fixes_are_compared_with_the_antenna(trajectory: str) -> None:
    """The body is 1.6 m away from it."""
    arm_m = (0.5, 0.0, 1.5)
    gnss = {"sigma_m": 0.03, "lever_arm_m": arm_m}
    sequence = simulate(
        trajectory=trajectory, duration_s=20.0, seed=1, tracks={"features": 10}, gnss=gnss
    )
    truth = sequence.groundtruth()
    assert is_in_world_of_fixes(truth, sequence.aiding, with_arm(arm_m))
    moved = Similarity(np.eye(3), np.array([0.2, 0.0, 0.0]), 1.0)
    assert not is_in_world_of_fixes(moved.apply(truth), sequence.aiding, with_arm(arm_m))


@pytest.mark.parametrize(("sigma_m", "shift_m"), [(0.3, 0.5), (2.0, 8.0)])
def test_the_noise_of_fixes_does_not_hide_another_world(sigma_m: float, shift_m: float) -> None:
    """On a path of 6 m, which fixes of 2 m do not resolve."""
    truth = simulate(trajectory="figure8", duration_s=20.0, rate_hz=10.0, seed=1).groundtruth()
    assert truth is not None
    some, rng = slice(2, -2, 2), np.random.default_rng(0)
    fixes = truth.positions[some] + rng.normal(0.0, sigma_m, truth.positions[some].shape)
    covariances = np.tile(sigma_m**2 * np.eye(3), (len(fixes), 1, 1))
    aiding = AidingData.of_fixes(truth.stamps_ns[some], fixes, covariances)
    assert is_in_world_of_fixes(truth, aiding, BackendConfig())
    for turn_deg, shift in ((180.0, 0.0), (0.0, shift_m), (180.0, shift_m)):
        R = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
        other = Similarity(R, np.array([shift, 0.0, 0.0]), 1.0)
        assert not is_in_world_of_fixes(other.apply(truth), aiding, BackendConfig())
