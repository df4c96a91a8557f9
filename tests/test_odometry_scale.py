# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One camera without an IMU whose unit of length is measured by the odometry of wheels."""

import gtsam
import numpy as np
import pytest
from groups import slow

from slam_graph.backend.aiding.odometry_factors import odometry_factor
from slam_graph.backend.backend_config import BackendConfig, OdometryConfig
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.initialization.odometry_scale import in_metres
from slam_graph.backend.initialization.start_diagnosis import Refusal
from slam_graph.backend.smoothing.keyframe_aiding import aiding_of_keyframes
from slam_graph.config import load_config
from slam_graph.evaluation import ape
from slam_graph.geometry import Similarity, Trajectory, interpolate
from slam_graph.pipeline import run
from slam_graph.results import RunResult
from slam_graph.sensors import AidingData
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence


def _flight(duration_s: float = 7.0, seed: int = 1) -> SimulatedSequence:
    return simulate(
        trajectory="figure8",
        duration_s=duration_s,
        seed=seed,
        with_imu=False,
        cameras=1,
        odometry={"enabled": True},
    )


def _scale(sequence: SimulatedSequence, result: RunResult) -> float:
    """How many metres are estimated for one."""
    truth, _ = interpolate(sequence.groundtruth(), result.trajectory.stamps_ns)
    found = Similarity.of_positions(truth.positions, result.trajectory.positions, "sim3")
    return 1.0 / found.scale


@pytest.mark.parametrize("algorithm", ["msckf", slow("okvis")])
def test_lengths_are_in_metres(algorithm: str) -> None:
    sequence = _flight()
    result = run(sequence, algorithm=algorithm, final_ba={"enabled": False})
    result.check()
    assert "scale_unknown" not in result.warnings
    assert result.metrics["extent"]["scale"] == "metres"
    assert result.metrics["extent"]["alignment"] == "se3"
    # four metres of way by the odometry are known to 0.02 / sqrt(4)
    assert abs(_scale(sequence, result) - 1.0) < 0.04
    assert ape(sequence.groundtruth(), result.trajectory, alignment="se3").statistics.rmse < 0.05
    assert result.metrics["nees"]["position"]["mean"] < 8.0


def test_without_odometry_the_scale_is_unknown() -> None:
    result = run(
        _flight(4.0), overrides=["backend.odometry.enabled=false"], final_ba={"enabled": False}
    )
    assert result.warnings["scale_unknown"] == 1
    assert result.metrics["extent"]["scale"] == "unknown"


@pytest.mark.slow
def test_a_gap_of_the_odometry_leaves_the_scale_as_it_is() -> None:
    sequence = _flight(9.0)
    whole = sequence.aiding
    seconds = (whole.odometry_stamps_ns - whole.odometry_stamps_ns[0]) * 1e-9
    kept = (seconds < 4.0) | (seconds > 6.5)
    sequence.aiding = whole.with_odometry(
        whole.odometry_stamps_ns[kept],
        whole.odometry_positions[kept],
        whole.odometry_quaternions[kept],
    )
    result = run(sequence, final_ba={"enabled": False})
    result.check()
    assert len(result.segments) == 1
    assert abs(_scale(sequence, result) - 1.0) < 0.04


def test_a_way_that_was_measured_too_long_counts_as_much_as_one_too_short() -> None:
    rng, count, step_m = np.random.default_rng(0), 50, 0.05
    stamps_ns = np.arange(count) * 50_000_000
    along = np.arange(count) * step_m
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    true = np.column_stack([along, 0.0 * along, 0.0 * along])
    measured = true + 0.02 * np.sqrt(step_m) * np.cumsum(rng.normal(size=(count, 3)), axis=0)
    data = AidingData.empty().with_odometry(stamps_ns, measured, upright)
    causal = Trajectory(stamps_ns, true, upright)
    aiding = aiding_of_keyframes(stamps_ns, data, causal, BackendConfig())
    assert len(aiding.odometry) == count - 1
    sigmas = []
    for factor in aiding.odometry:
        assert isinstance(factor, gtsam.NoiseModelFactor)
        sigmas.append(factor.noiseModel().sigmas()[3])
    assert np.ptp(sigmas) < 1e-9


def test_two_views_get_the_unit_of_the_odometry_whatever_the_place_of_the_camera() -> None:
    context = Estimator(_flight().rig, load_config().algorithm)._context
    arm = context.rig.cameras[0].body_T_camera.translation()
    assert np.linalg.norm(arm) > 0.01
    steps = [gtsam.Pose3(gtsam.Rot3.Ypr(0.2, 0.1, 0.05 * k), [0.3, 0.1, 0.0]) for k in range(5)]
    true = [gtsam.Pose3()]
    for step in steps:
        true.append(true[-1].compose(step))
    motions = [(gtsam.Rot3.Logmap(step.rotation()), step.translation()) for step in steps]
    shrunk = []
    for pose in true:
        camera = 0.4 * pose.transformFrom(arm)
        shrunk.append(gtsam.Pose3(pose.rotation(), camera - pose.rotation().rotate(arm)))
    found = in_metres(shrunk, motions, context)
    assert isinstance(found, list)
    for a, b in zip(found, true, strict=True):
        assert found[0].between(a).equals(true[0].between(b), 1e-9)
    still = [(turn, 0.0 * shift) for turn, shift in motions]
    assert isinstance(in_metres([true[0]] * len(true), still, context), Refusal)


@pytest.mark.parametrize("case", [slow("part"), "late", slow("elsewhere")])
def test_a_start_takes_what_the_odometry_covers(case: str) -> None:
    """A part of a recording, odometry that begins later than the images, and on another clock."""
    sequence = _flight(6.0)
    whole, first_s = sequence.aiding, 2.5 if case == "late" else 0.0
    shift_ns = 10**12 if case == "elsewhere" else 0
    kept = whole.odometry_stamps_ns >= whole.odometry_stamps_ns[0] + round(first_s * 1e9)
    sequence.aiding = whole.with_odometry(
        whole.odometry_stamps_ns[kept] + shift_ns,
        whole.odometry_positions[kept],
        whole.odometry_quaternions[kept],
    )
    start_s = 1.0 if case == "part" else 0.0
    result = run(
        sequence,
        start_s=start_s,
        duration_s=4.5,
        min_coverage=0.2,
        final_ba={"enabled": False},
    )
    result.check()
    unused = case == "elsewhere"
    assert result.warnings["odometry_unused"] == result.warnings["scale_unknown"] == unused
    assert unused or abs(_scale(sequence, result) - 1.0) < 0.06


def test_a_way_that_was_not_expected_has_the_noise_of_its_length() -> None:
    moved = np.zeros(3), np.array([5.0, 0.0, 0.0])
    factor = odometry_factor((0, 1), moved, 0.0, OdometryConfig())
    assert isinstance(factor, gtsam.NoiseModelFactor)
    assert factor.noiseModel().sigmas()[3] > 0.02 * np.sqrt(5.0)
