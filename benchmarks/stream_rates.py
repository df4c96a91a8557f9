# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Low-rate and broken streams: starts and errors at other rates, with gaps and dropped frames.

Simulated tracks along recorded flights with their real IMU, begun in motion. Each variant of the
streams is compared with the same part of the flight at 20 Hz and whole. IMU rates that no recording
has are simulated, on a generated path.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.flights import KIND, in_parallel
from benchmarks.metric import EXACT, Metric, info
from benchmarks.recordings import is_held_out
from benchmarks.running import Run
from benchmarks.suite import Benchmark, Outcome
from slam_graph.arrays import IntArray
from slam_graph.datasets import RecordedSequence, dataset_from_arrays
from slam_graph.sensors import FeatureFrame, ImuData
from slam_graph.simulation import simulate

BEGUN_S = {
    "euroc_inertial/V1_02_medium": 20.0,
    "tumvi_inertial/room1": 5.0,
    "euroc_inertial/V2_02_medium": 20.0,
    "tumvi_inertial/room3": 5.0,
}
"""Where in a flight to begin: in motion."""
GENERATED = "figure8"
DURATION_S, SEEDS = 15.0, (7, 8)
"""Length of a part, and the seeds of noise and losses."""

CAMERA_HZ, WHOLE_HZ = (5.0, 10.0, 25.0, 30.0), 20.0
GAPS_S, GAP_S = (0.5, 2.0, 5.0, 8.0, 11.0), 0.4
"""Frames are missing from these times on, for so long."""
NEW_IDS = 1_000_000
"""Larger than any id: tracks that end in a gap go on under other ids."""
DROPPED = (0.1, 0.3)
"""Shares of the frames that are missing, at random."""
IMU_HZ = (100.0, 1000.0)
"""Rates of the simulated IMU."""

LATEST_S, RATIO_BAR = 3.0, 2.0
"""Bars: time to the first state, and the error relative to that of the whole stream. Where tracks
are lost in gaps no camera tells what went before, and the error has no bar."""
LOST = "gaps_tracks_lost"


@dataclass(frozen=True, slots=True, eq=False)
class Streams:
    """What a recording has, to be thinned.

    Attributes:
        sequence: with the rig and the ground truth.
        frames: of features.
        imu: all samples.
    """

    sequence: RecordedSequence
    frames: list[FeatureFrame]
    imu: ImuData

    @staticmethod
    def simulated(
        trajectory: str, cameras: int, rate_hz: float, seed: int, imu_hz: float | None = None
    ) -> Streams:
        """The streams of a flight: with its own IMU, or one of `imu_hz`."""
        recorded = trajectory != GENERATED
        begun_s = BEGUN_S["/".join(Path(trajectory).parts[-2:])] if recorded else 0.0
        sequence = simulate(
            trajectory=trajectory,
            real_imu=recorded,
            cameras=cameras,
            rate_hz=rate_hz,
            start_s=begun_s,
            duration_s=DURATION_S,
            tracks={"features": 150, "pixel_sigma": 1.0},
            imu={"rate_hz": imu_hz},
            flight={"hover_s": 0.0},
            seed=seed,
        )
        frames = [f for f in sequence.frames() if isinstance(f, FeatureFrame)]
        return Streams(sequence, frames, sequence.imu())

    def recording(self) -> RecordedSequence:
        """A recording without a known start."""
        return dataset_from_arrays(
            self.sequence.rig,
            imu_stamps_ns=self.imu.stamps_ns,
            gyro=self.imu.gyro,
            accel=self.imu.accel,
            features=self.frames,
            groundtruth=self.sequence.groundtruth(),
        )

    def with_slow_imu(self) -> Streams:
        """Every second IMU sample, after a low-pass filter as such a sensor has one."""
        gyro, accel = (
            0.25 * values[:-2:2] + 0.5 * values[1:-1:2] + 0.25 * values[2::2]
            for values in (self.imu.gyro[: self._odd], self.imu.accel[: self._odd])
        )
        stamps_ns = self.imu.stamps_ns[: self._odd][1:-1:2]
        return replace(self, imu=ImuData(stamps_ns, gyro, accel))

    @property
    def _odd(self) -> int:
        """The largest odd number of samples."""
        return len(self.imu) - 1 + len(self.imu) % 2

    def with_gaps(self, lost: bool) -> Streams:
        """Without the frames of some times; `lost`: their tracks end there."""
        began_ns = self.frames[0].stamp_ns
        kept = []
        for frame in self.frames:
            since_s = (frame.stamp_ns - began_ns) * 1e-9
            if any(gap <= since_s < gap + GAP_S - 1e-6 for gap in GAPS_S):
                continue
            passed = sum(gap <= since_s for gap in GAPS_S) if lost else 0
            kept.append(_renamed(frame, passed * NEW_IDS))
        return replace(self, frames=kept)

    def with_dropped(self, share: float, rng: np.random.Generator) -> Streams:
        """Without some of the frames, drawn at random."""
        kept: IntArray = np.flatnonzero(rng.random(len(self.frames)) >= share)
        return replace(self, frames=[self.frames[k] for k in kept])


def _renamed(frame: FeatureFrame, more: int) -> FeatureFrame:
    cameras = tuple(replace(seen, ids=seen.ids + more) for seen in frame.cameras)
    return FeatureFrame(frame.stamp_ns, cameras)


def variants(trajectory: str, cameras: int, seed: int) -> Iterator[tuple[str, Streams]]:
    """The streams of a flight by name, the whole ones first."""
    whole = Streams.simulated(trajectory, cameras, WHOLE_HZ, seed)
    yield "whole", whole
    if trajectory == GENERATED:
        for rate_hz in IMU_HZ:
            name = f"imu_{rate_hz:g}hz"
            yield name, Streams.simulated(trajectory, cameras, WHOLE_HZ, seed, rate_hz)
        return
    for rate_hz in CAMERA_HZ:
        name = f"camera_{rate_hz:g}hz"
        yield name, Streams.simulated(trajectory, cameras, rate_hz, seed)
    yield "imu_100hz", whole.with_slow_imu()
    yield "gaps", whole.with_gaps(lost=False)
    yield LOST, whole.with_gaps(lost=True)
    rng = np.random.default_rng(seed)
    for share in DROPPED:
        yield f"dropped_{share:.0%}".replace("%", "_percent"), whole.with_dropped(share, rng)


def measure(data: Path) -> Outcome:
    """Start and error of `msckf` with one camera and two.

    Args:
        data: folder of recordings.
    """
    outcome = Outcome()
    flights = [(str(data / flight), is_held_out(flight)) for flight in BEGUN_S]
    flights.append((GENERATED, False))
    tasks = [(flight, cameras, held) for flight, held in flights for cameras in (1, 2)]
    found = in_parallel(figures_of, [task[:2] for task in tasks])
    for (flight, cameras, held_out), (figures, notes) in zip(tasks, found, strict=True):
        name = f"{Path(flight).name}.{KIND[cameras]}"
        outcome.add(name, figures, held_out=held_out)
        outcome.notes += [f"{name}.{note}" for note in notes]
    return outcome


def figures_of(trajectory: str, cameras: int) -> tuple[list[Metric], list[str]]:
    """Figures of all variants, and how those ended that did not come to a good end."""
    runs: dict[str, list[Run]] = {}
    for seed in SEEDS:
        for name, streams in variants(trajectory, cameras, seed):
            runs.setdefault(name, []).append(Run(streams.recording(), "msckf"))
    figures: list[Metric] = []
    whole_m = float("nan")
    for name, of_seeds in runs.items():
        error_m = float(np.mean([run.errors("se3").position_m for run in of_seeds]))
        whole_m = error_m if name == "whole" else whole_m
        latest_s = float(np.max([run.seconds_to_start for run in of_seeds]))
        figures += [
            Metric(f"{name}.ok", float(all(run.ok for run in of_seeds)), "", "higher", 1.0, EXACT),
            Metric(f"{name}.start", latest_s, "s", "lower", None if name == LOST else LATEST_S),
            info(f"{name}.ate", error_m, "m"),
        ]
        if name != "whole":
            bar = None if name == LOST else RATIO_BAR
            figures.append(Metric(f"{name}.ratio", error_m / whole_m, "× whole", "lower", bar))
    notes = [f"{name}: {note}" for name, found in runs.items() for r in found for note in r.notes()]
    return figures, notes


BENCHMARKS = {
    "stream_rates": Benchmark(
        "cameras of 5 to 30 Hz, IMUs of 100 to 1000 Hz, gaps and dropped frames: start and error",
        tuple(BEGUN_S),
        measure,
    )
}
