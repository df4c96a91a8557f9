# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Wrong samples of an IMU are left out and named; true ones stay, however they come in blocks."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from estimating import BELIEVED
from groups import slow

from slam_graph.config import load_config
from slam_graph.datasets import open_dataset
from slam_graph.datasets.faults.injection import inject
from slam_graph.datasets.streams.imu_outliers import without_outliers
from slam_graph.diagnostics import Diagnostics
from slam_graph.evaluation import ape, synchronize
from slam_graph.geometry import Similarity
from slam_graph.pipeline import run
from slam_graph.sensors import ImuData
from slam_graph.simulation import simulate

AT = 1500
FAULTS = {
    "imu_out_of_range": (slice(AT, AT + 1), lambda x: np.full_like(x, 1e6)),
    "imu_saturated": (slice(AT, AT + 100), lambda x: np.sign(x) * [9, 9, 9, 78, 78, 78]),
    "imu_stuck": (slice(AT, AT + 200), lambda x: np.repeat(x[:1], len(x), axis=0)),
    "imu_spike": (slice(AT, AT + 1), lambda x: x + np.array([0, 0, 0, 60, 0, 0])),
}


@pytest.fixture(scope="module")
def flown() -> ImuData:
    """Fifteen seconds with noise."""
    return simulate(trajectory="figure8", duration_s=15.0).imu()


def values(imu: ImuData) -> np.ndarray:
    """(N, 6): gyroscope, accelerometer."""
    return np.hstack([imu.gyro, imu.accel])


def cleaned(imu: ImuData, size: int = 1024) -> tuple[ImuData, Diagnostics]:
    """What is left of samples that come in blocks, and what was counted."""
    said = Diagnostics()
    blocks = (imu[k : k + size] for k in range(0, len(imu), size))
    return ImuData.concatenate(list(without_outliers(blocks, said))), said


@pytest.mark.parametrize("size", [7, 40, 1024, 100000])
def test_true_samples_stay(flown: ImuData, size: int) -> None:
    """All of a flight, in blocks of any size."""
    left, said = cleaned(flown, size)
    np.testing.assert_array_equal(left.stamps_ns, flown.stamps_ns)
    np.testing.assert_array_equal(values(left), values(flown))
    assert not said.counts


@pytest.mark.parametrize("size", [40, 1024, 100000])
@pytest.mark.parametrize("kind", list(FAULTS))
def test_wrong_samples_are_left_out_and_named(flown: ImuData, kind: str, size: int) -> None:
    """Those, and no others."""
    rows, wrong = FAULTS[kind]
    table = values(flown)
    table[rows] = wrong(table[rows])
    left, said = cleaned(ImuData(flown.stamps_ns, table[:, :3], table[:, 3:]), size)
    missing = np.flatnonzero(~np.isin(flown.stamps_ns, left.stamps_ns))
    np.testing.assert_array_equal(missing, np.arange(rows.start, rows.stop))
    assert said.counts == {kind: len(missing)}


def test_a_platform_that_stands_in_a_simulation_without_noise_is_not_stuck() -> None:
    """Its samples repeat, but nothing else shows noise."""
    seconds = np.arange(2000) * 0.005
    moving = np.clip(seconds - 3.0, 0.0, 4.0)[:, None]
    swing = np.sin(np.pi * moving * [1.0, 0.5, 0.25]) ** 2
    imu = ImuData(np.arange(2000) * 5_000_000, swing, swing + np.array([0.0, 0.0, 9.81]))
    left, said = cleaned(imu)
    assert len(left) == len(imu)
    assert not said.counts


def test_values_that_a_driver_repeats_are_kept(flown: ImuData) -> None:
    """Those of a sensor of 100 Hz at 1 kHz."""
    table = np.repeat(values(flown)[:400], 10, axis=0)
    imu = ImuData(np.arange(len(table)) * 1_000_000, table[:, :3], table[:, 3:])
    left, said = cleaned(imu)
    assert len(left) == len(imu)
    assert not said.counts


def test_a_block_of_shaking_is_no_spike(flown: ImuData) -> None:
    """A shock that lasts for several samples is measured, not made up."""
    table = values(flown)
    table[AT : AT + 4, 3] += [20.0, 45.0, 40.0, 15.0]
    left, _ = cleaned(ImuData(flown.stamps_ns, table[:, :3], table[:, 3:]))
    assert len(left) == len(flown)


@cache
def error_m(*faults: str) -> float:
    """Of a run that ends well."""
    config = load_config(algorithm="msckf", overrides=["final_ba.enabled=false", BELIEVED])
    sequence = inject(
        simulate(trajectory="figure8", cameras=2, duration_s=13.0, rate_hz=10.0), faults
    )
    result = run(sequence, config)
    assert result.status == "ok", result.message
    truth = sequence.groundtruth()
    assert truth is not None
    return ape(truth, result.trajectory, alignment="se3").statistics.rmse


@pytest.mark.parametrize(
    "fault", [slow("imu_outlier"), "gyro_outlier", slow("imu_saturated"), slow("imu_zeros")]
)
def test_a_run_survives_them(fault: str) -> None:
    """Its path is hardly worse than without the fault."""
    assert error_m(f"{fault}:at_s=8") < 2.0 * error_m()


@pytest.mark.slow
def test_one_camera_leads_over_a_gap_in_a_turn(data_dir: Path) -> None:
    """Nine tenths of a second without samples, of real tracks of one camera that turns."""
    truth = data_dir / "euroc_inertial/V1_01_easy"
    errors = []
    for faults in ([], ["imu_missing:at_s=20,duration_s=0.9"]):
        sequence = open_dataset("demo", groundtruth=truth, faults=faults)
        result = run(sequence, load_config(overrides=["final_ba.enabled=false"]), duration_s=24.0)
        assert result.status == "ok", result.message
        assert len(result.segments) == 1
        known = sequence.groundtruth()
        assert known is not None
        errors.append(ape(known, result.trajectory, alignment="yaw").statistics.rmse)
    assert errors[1] < 2.0 * errors[0]


@pytest.mark.parametrize("algorithm", ["msckf", slow("ekf"), slow("fixed_lag_isam2")])
def test_a_velocity_that_no_image_tells_is_not_gone_on_with(data_dir: Path, algorithm: str) -> None:
    """One camera takes off while samples are missing, and no feature has a known depth."""
    truth = data_dir / "euroc_inertial/V1_01_easy"
    sequence = open_dataset("demo", groundtruth=truth, faults=["imu_missing:at_s=5,duration_s=0.5"])
    config = load_config(algorithm=algorithm, overrides=["final_ba.enabled=false"])
    result = run(sequence, config, duration_s=10.0)
    assert result.status == "ok", result.message
    known = sequence.groundtruth()
    assert known is not None
    before, after = result.segments
    assert "do not tell the velocity" in before.ended_by
    assert (before.end_ns - result.input.start_ns) * 1e-9 < 5.0
    standing, flying = (part.part_of(result.trajectory) for part in (before, after))
    true, own = synchronize(known, standing)  # what stands determines no yaw
    placed = Similarity.of_first_pose(true, own).apply(own)
    assert len(own) > 60
    assert ape(true, placed).statistics.max < 0.01
    assert ape(known, flying, alignment="yaw").statistics.rmse < 0.05


def test_recorded_flights_have_no_outliers() -> None:
    """Not one sample of the demo is left out."""
    sequence = open_dataset("demo")
    assert len(sequence.imu()) == sequence.info().imu_samples
    assert not sequence.diagnostics.counts
