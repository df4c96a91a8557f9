# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Camera-IMU time offsets that the calibration does not know: found in the start, and how well.

Flights with a real IMU and simulated tracks are stamped by a clock that is off. No frame comes with
a later IMU sample than its own stamp, as with a driver that knows of no offset. The same tracks
with the right stamps are the reference.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.flights import FLIGHTS, KIND, flight_is_held_out, flown_by_camera, in_parallel
from benchmarks.metric import EXACT, Metric, info
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from benchmarks.suite import Benchmark, Outcome
from slam_graph.backend import Estimator
from slam_graph.config import load_config
from slam_graph.errors import SlamGraphError
from slam_graph.evaluation import ape
from slam_graph.geometry import NavState, StateHistory
from slam_graph.sensors import FeatureFrame, ImuData, Packet

OFFSETS_S = (0.0, 0.01, -0.01, 0.03, -0.03, 0.055, -0.055, 0.1, -0.1)
SECONDS = 25.0
"""Length of each run, from the beginning of the flight."""

FOUND_S, ATE_RATIO = 3e-3, 1.2
"""Bars: error of the offset that the start finds (largest, in units of this), and error of the run
relative to that with the right stamps (median)."""


@dataclass(frozen=True, slots=True)
class _Run:
    """What came of one flight under one offset.

    Attributes:
        offset_s: true offset, where the calibration says zero.
        found_s: offset with which the estimator began anew; zero if it did not.
        estimate_s: offset at the end.
        ate_m: root mean square position error; NaN without states.
    """

    offset_s: float
    found_s: float
    estimate_s: float
    ate_m: float


def measure(data: Path) -> Outcome:
    """All offsets on all flights, with one camera and two.

    Args:
        data: folder of recordings.
    """
    outcome = Outcome()
    tasks = [(data / flight, cameras) for flight in FLIGHTS for cameras in (1, 2)]
    found = in_parallel(runs_of, tasks)
    for (path, cameras), runs in zip(tasks, found, strict=True):
        held_out = flight_is_held_out(path)
        name = f"{path.name}.{KIND[cameras]}"
        outcome.add(name, figures_of(runs), held_out=held_out)
    return outcome


def figures_of(runs: list[_Run]) -> Iterator[Metric]:
    """Shares and errors; the first run is the reference."""
    late = [run for run in runs if run.offset_s != 0.0]
    reference = next(run for run in runs if run.offset_s == 0.0)
    started = [np.isfinite(run.ate_m) for run in late]
    errors = [abs(run.found_s - run.offset_s) for run in late]
    ratios = [run.ate_m / reference.ate_m for run in late]
    yield Metric("started", float(np.mean(started)), "share", "higher", 1.0, EXACT)
    yield Metric("false_alarm", float(reference.found_s != 0.0), "", "lower", 0.0, EXACT)
    yield Metric("start_error", float(np.max(errors)) / FOUND_S, "", "lower", 1.0, EXACT)
    yield info("start_error_ms", 1e3 * float(np.max(errors)), "ms")
    yield Metric("ate_ratio", float(np.nanmedian(ratios)), "", "lower", ATE_RATIO, EXACT)
    yield info("ate_ratio_worst", float(np.nanmax(ratios)), "")
    yield info("end_error_ms", 1e3 * max(abs(run.estimate_s - run.offset_s) for run in late), "ms")


def runs_of(
    path: Path, cameras: int, seed: int = FIRST_HELD_OUT_SEED, seconds: float = SECONDS
) -> list[_Run]:
    """A flight under every offset; its frames are simulated once."""
    sequence = flown_by_camera(path, cameras, seed)
    config = load_config(algorithm="msckf")
    first_ns, packets = sequence.info().start_ns, []
    for packet in sequence.packets():
        if packet.frame.stamp_ns > first_ns + round(seconds * 1e9):
            break
        packets.append(packet)
    runs = []
    for offset_s in OFFSETS_S:
        estimator = Estimator(sequence.rig, config.algorithm, config.backend)
        history = _states(estimator, _late(packets, offset_s))
        ate_m = np.nan
        if len(history) > 20:
            truth, estimate = sequence.groundtruth(), history.trajectory()
            ate_m = ape(truth, estimate, alignment="yaw").statistics.rmse
        rig, calibration = estimator.corrected_rig, estimator.calibration
        runs.append(
            _Run(
                offset_s,
                0.0 if rig is None else rig.cameras[0].time_offset_s,
                0.0 if calibration is None else calibration.rig.cameras[0].time_offset_s,
                float(ate_m),
            )
        )
    return runs


def _states(estimator: Estimator, packets: Iterator[Packet]) -> StateHistory:
    """The states that are left at the end, those that were superseded left out."""
    states: list[NavState] = []
    for packet in packets:
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        try:
            state = estimator.add_frame(packet.frame)
        except (SlamGraphError, np.linalg.LinAlgError, RuntimeError):
            break  # diverged: the error so far says it
        if estimator.replayed is not None:
            states = list(estimator.replayed)
        elif state is not None:
            states.append(state)
    history = StateHistory()
    for state in states:
        history.append(state)
    return history


def _late(packets: list[Packet], offset_s: float) -> Iterator[Packet]:
    """The packets with frames stamped by a clock that is off (t_imu = t_camera + offset)."""
    imu = ImuData.concatenate([packet.imu for packet in packets])
    begin, late_ns = 0, round(offset_s * 1e9)
    for packet in packets:
        assert isinstance(packet.frame, FeatureFrame)
        stamp_ns = int(packet.frame.stamp_ns) - late_ns
        end = max(begin, int(np.searchsorted(imu.stamps_ns, stamp_ns, side="right")))
        yield Packet(imu[begin:end], FeatureFrame(stamp_ns, packet.frame.cameras))
        begin = end


BENCHMARKS = {
    "time_offset": Benchmark(
        "camera-IMU time offsets that are not calibrated: found in the start, and what they cost",
        FLIGHTS,
        measure,
    )
}
