# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded flights with their real IMU, and a simulated camera along them: 20 Hz, 150 features."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Tasks
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.recordings import is_held_out
from slam_graph.datasets import RecordedSequence, dataset_from_arrays
from slam_graph.sensors import FeatureFrame, ImuData
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence

FLIGHTS = (
    "euroc_inertial/V1_02_medium",
    "euroc_inertial/V2_01_easy",
    "euroc_inertial/V2_02_medium",
    "euroc_inertial/MH_04_difficult",
    "tumvi_inertial/room1",
    "tumvi_inertial/room3",
)
KIND = {1: "mono", 2: "stereo"}
"""What figures call a number of cameras."""


def flown_by_camera(
    path: Path,
    cameras: int,
    seed: int,
    pixel_sigma: float = 1.0,
    duration_s: float | None = None,
    readout_s: float = 0.0,
) -> SimulatedSequence:
    """Tracks of a simulated camera along a recorded flight, with the IMU of the recording.

    Args:
        path: folder of the flight.
        cameras: one or two.
        seed: of the noise of the tracks.
        pixel_sigma: their noise in px.
        duration_s: how much of the flight to take; all of it if not said.
        readout_s: readout time of a rolling shutter.
    """
    return simulate(
        trajectory=str(path),
        real_imu=True,
        cameras=cameras,
        rate_hz=20.0,
        duration_s=duration_s,
        tracks={"features": 150, "pixel_sigma": pixel_sigma},
        shutter_readout_s=readout_s,
        seed=seed,
    )


def without_start(sequence: SimulatedSequence) -> RecordedSequence:
    """The recording without the state that comes with it."""
    packets = list(sequence.packets())
    imu = ImuData.concatenate([packet.imu for packet in packets])
    return dataset_from_arrays(
        sequence.rig,
        imu_stamps_ns=imu.stamps_ns,
        gyro=imu.gyro,
        accel=imu.accel,
        features=[p.frame for p in packets if isinstance(p.frame, FeatureFrame)],
        groundtruth=sequence.groundtruth(),
    )


def flight_is_held_out(path: Path) -> bool:
    """Whether the flight in a folder is kept out of choices."""
    return is_held_out("/".join(path.parts[-2:]))


_Found = TypeVar("_Found")


def in_parallel(measure: Callable[..., _Found], tasks: Tasks[tuple[Any, ...]]) -> list[_Found]:
    """What a function finds for each of some arguments, in as many processes as there are cores."""
    with ProcessPoolExecutor() as pool:
        return list(pool.map(measure, *zip(*tasks, strict=True)))
