# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A recorded flight to simulate along: its path, rig and IMU samples.

The path of a flight with an IMU is the one that agrees with it (`imu_consistent_path.py`); of a
bare ground-truth file it is what the file says.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from slam_graph.datasets import RecordedSequence, open_dataset, read_groundtruth
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError, closest
from slam_graph.geometry import Trajectory
from slam_graph.sensors import ImuData, ImuNoise, Rig
from slam_graph.simulation.imu_consistent_path import consistent_path, overlap, truth_delay_s
from slam_graph.simulation.motion import Motion, RecordedMotion, SplineMotion
from slam_graph.simulation.path_report import PathReport
from slam_graph.simulation.simulation_config import TRAJECTORIES, SimulationConfig

_MARGIN_NS = 3_000_000_000
"""Time before and after the wanted part over which the path is made consistent with the IMU."""

_DELAY_NS = 30_000_000_000
"""Time over which it is estimated how late the positions of the truth are, at least: in parts of
14 s of flights that are in time up to 15 ms are found, in those of 26 s up to 4 ms."""

LEAD_NS = 100_000_000
"""Time by which motion and IMU extend beyond the first and last frame."""


@dataclass(frozen=True, eq=False)
class RecordedFlight:
    """A recorded flight, or the requested part of it.

    Attributes:
        path: where it was read from.
        truth: the poses to fly along.
        rig: its sensors, or None for a bare ground-truth file.
        sequence: the recording, or None for a bare ground-truth file.
        report: how the poses differ from the ground truth; None for a bare ground-truth file.
    """

    path: Path
    truth: Trajectory
    rig: Rig | None
    sequence: RecordedSequence | None
    report: PathReport | None

    @staticmethod
    def read(path: Path, config: SimulationConfig, diagnostics: Diagnostics) -> RecordedFlight:
        """Read the part of the recording at `path` that the settings ask for.

        Raises:
            DataError: if there is no such file, or no IMU although `real_imu` is set; or if no
                path fits ground truth and IMU (`consistent_path`).
        """
        if not path.exists():
            raise DataError(f"{path}: no such trajectory; {closest(str(path), TRAJECTORIES)}")
        truth = read_groundtruth(path, diagnostics)
        start_ns = int(truth.stamps_ns[0]) + round(config.start_s * 1e9)
        end_ns = int(truth.stamps_ns[-1])
        if config.duration_s is not None:
            end_ns = min(end_ns, start_ns + round(config.duration_s * 1e9) + 2 * LEAD_NS)
        folder = path / "mav0" if (path / "mav0").is_dir() else path
        sequence = None
        if (folder / "imu0" / "data.csv").is_file() and any(folder.glob("cam[0-9]*")):
            sequence = open_dataset(path, diagnostics=diagnostics)
        elif config.real_imu:
            raise DataError(f"{path}: no recorded IMU here; an EuRoC folder has one in mav0/imu0")
        if sequence is None:
            return RecordedFlight(path, _part(truth, start_ns, end_ns, path), None, None, None)
        around = _part(truth, start_ns - _MARGIN_NS, end_ns + _MARGIN_NS, path)
        imu = ImuData.concatenate(list(sequence.imu_blocks()))
        longer = _part(truth, *widened(start_ns, end_ns, truth), path)
        late_s = delay_s(longer, imu, sequence.rig.imu)
        flown, report = consistent_path(around, imu, sequence.rig.imu, late_s)
        poses = _part(flown, start_ns, end_ns, path)
        return RecordedFlight(path, poses, sequence.rig, sequence, report)

    def motion(self, smooth: SplineMotion) -> RecordedMotion:
        """The recorded poses; velocities are those of a smooth fit if none were recorded."""
        truth = self.truth
        if truth.velocities is None:
            truth = Trajectory(
                truth.stamps_ns,
                truth.positions,
                truth.quaternions,
                smooth.velocities(truth.stamps_ns),
            )
        return RecordedMotion(int(truth.stamps_ns[0]), int(truth.stamps_ns[-1]), truth)

    def samples(self, motion: Motion) -> ImuData:
        """The recorded IMU samples during a motion."""
        assert self.sequence is not None
        data = ImuData.concatenate(list(self.sequence.imu_blocks(motion.start_ns - LEAD_NS)))
        data = data[: int(np.searchsorted(data.stamps_ns, motion.end_ns + LEAD_NS))]
        if not len(data) or data.stamps_ns[0] > motion.start_ns + LEAD_NS:
            raise DataError(f"{self.path}: the recorded IMU does not cover the trajectory")
        return data


def widened(start_ns: int, end_ns: int, truth: Trajectory) -> tuple[int, int]:
    """Times about a part of the truth that are far enough apart to tell how late it is."""
    missing_ns = max(0, _DELAY_NS - (end_ns - start_ns))
    begin_ns = max(int(truth.stamps_ns[0]), start_ns - missing_ns // 2)
    stop_ns = min(int(truth.stamps_ns[-1]), begin_ns + missing_ns + end_ns - start_ns)
    return min(begin_ns, max(int(truth.stamps_ns[0]), stop_ns - _DELAY_NS)), stop_ns


def delay_s(truth: Trajectory, imu: ImuData, noise: ImuNoise) -> float | None:
    """How late positions are; None if a gap, perhaps beside the part that is flown, hides it."""
    try:
        overlap(truth, imu)
    except DataError:
        return None
    return truth_delay_s(truth, imu, noise)


def _part(truth: Trajectory, start_ns: int, end_ns: int, path: Path) -> Trajectory:
    rows = slice(
        int(np.searchsorted(truth.stamps_ns, start_ns)),
        int(np.searchsorted(truth.stamps_ns, end_ns)) + 1,  # so that the end is covered
    )
    if min(rows.stop, len(truth)) - rows.start < 2:
        raise DataError(f"{path}: the trajectory ends before start_s")
    columns: dict[str, Any] = {
        field.name: values[rows]
        for field in fields(Trajectory)
        if (values := getattr(truth, field.name)) is not None
    }
    return Trajectory(**columns)
