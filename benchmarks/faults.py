# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Faults put into two recordings, under several algorithms: how runs end, and what is reached then.

Images of MH_01, and tracks of OpenVINS' simulation, which images cannot be put into. A fault
strikes at 6 s of 17. What counts is the error of each segment, aligned on its own, relative
to that of the run without a fault; the time from the end of the fault to the next state in a
segment that is good; and that no run ends with an internal error.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from benchmarks.flights import in_parallel
from benchmarks.metric import EXACT, Metric
from benchmarks.running import Run
from benchmarks.suite import Benchmark, Outcome
from slam_graph.datasets import open_dataset
from slam_graph.errors import DataError
from slam_graph.evaluation import ape

RECORDING, TRACKS = "euroc/MH_01_easy_17s", "openvins_sim/euroc_V1_01"
CLIP_S = 17.0
AT_S = 6.0
ALGORITHMS = ("msckf", "swf", "okvis", "ekf", "fixed_lag_isam2")
FAULTS = {
    "frames lost, 30 % over 4 s": ("frames_dropped:duration_s=4,share=0.3", 4.0),
    "no frames, 2 s": ("frames_dropped:duration_s=2", 2.0),
    "first camera lost, 3 s": ("camera_lost:duration_s=3,camera=0", 3.0),
    "second camera lost, 3 s": ("camera_lost:duration_s=3,camera=1", 3.0),
    "first camera lost for good": ("camera_lost:duration_s=60,camera=0", 0.0),
    "second camera lost for good": ("camera_lost:duration_s=60,camera=1", 0.0),
    "blank, 2 s": ("image_blank:duration_s=2", 2.0),
    "overexposed, 3 s": ("image_overexposed:duration_s=3", 3.0),
    "blurred, 3 s": ("image_blurred:duration_s=3", 3.0),
    "frozen images, 3 s": ("image_frozen:duration_s=3", 3.0),
    "noise, 3 s": ("image_noise:duration_s=3", 3.0),
    "another place, 2 s": ("image_other_place:duration_s=2", 2.0),
    "no IMU, 1 s": ("imu_missing:duration_s=1", 1.0),
    "5 % of the IMU lost": ("imu_dropped:duration_s=4,share=0.05", 4.0),
    "IMU samples twice": ("imu_duplicated:duration_s=4", 4.0),
    "IMU out of order": ("imu_out_of_order:duration_s=4", 4.0),
    "IMU 30 ms late": ("imu_late:duration_s=60,by_s=0.03", 0.0),
    "one IMU sample of 1e6": ("imu_outlier", 0.0),
    "one of 50 rad/s": ("gyro_outlier", 0.0),
    "IMU saturated, 0.5 s": ("imu_saturated:duration_s=0.5", 0.5),
    "IMU zero, 1 s": ("imu_zeros:duration_s=1", 1.0),
    "IMU frozen, 3 s": ("imu_frozen:duration_s=3", 3.0),
    "spikes of the accelerometer": ("accel_spikes:duration_s=4", 4.0),
    "NaN in the IMU, 2 s": ("imu_nan:duration_s=2", 2.0),
    "clock jumps by 1 s": ("clock_jump:by_s=1", 1.0),
    "clock jumps by 5 s": ("clock_jump:by_s=5", 5.0),
    "clock jumps back by 1 s": ("clock_jump:by_s=-1", 0.0),
    "nothing, 3 s": ("all_missing:duration_s=3", 3.0),
    "carried away": ("kidnapped:duration_s=2", 0.0),
}
"""Faults as texts for `inject`, without the time, and how long they last, s."""
OF_TRACKS = {name: fault for name, fault in FAULTS.items() if not fault[0].startswith("image_")}
"""Those that recordings of tracks can have."""
RECOVERY_BAR_S = 5.0
"""Longest time to recover."""
_TOLERANCE = 0.5
"""How an estimate goes through a fault depends on chance more than its error elsewhere."""


@dataclass(frozen=True, slots=True)
class Survived:
    """What came of one run.

    Attributes:
        status: of the run.
        whole_m: error over all, aligned once; NaN without a trajectory.
        segments_m: errors of the segments, each aligned on its own.
        recovered_s: from the end of the fault to the first state of a later segment; 0 in one.
        internal: whether it ended with an internal error.
    """

    status: str
    whole_m: float
    segments_m: tuple[float, ...]
    recovered_s: float
    internal: bool = False


def survive(recording: Path, algorithm: str, fault: str, lasts_s: float) -> Survived:
    """One run with a fault, or without one if the text is empty."""
    logging.getLogger("slam_graph").setLevel(logging.CRITICAL)  # what is said is expected
    sequence = open_dataset(recording, faults=[fault] if fault else [])
    run = Run(sequence, algorithm, 2, duration_s=CLIP_S)
    result, errors = run.result, []
    for segment in result.segments:
        try:
            part = segment.part_of(result.trajectory)
            errors.append(ape(run.truth, part, alignment="yaw").statistics.rmse)
        except DataError:  # too short to be judged
            continue
    whole = float("nan")
    if len(result.history):
        whole = ape(run.truth, result.trajectory, alignment="yaw").statistics.rmse
    later = [s.begin_ns for s in result.segments.later]
    end_ns = result.input.start_ns + round((AT_S + lasts_s) * 1e9)
    recovered_s = max(0.0, (later[0] - end_ns) * 1e-9) if later else 0.0
    internal = result.message.startswith("internal error")
    return Survived(result.status, whole, tuple(errors), recovered_s, internal)


def measure(data: Path, algorithms: tuple[str, ...] = ALGORITHMS) -> Outcome:
    """How runs end on images, for each fault and algorithm."""
    return _measured(data / RECORDING, FAULTS, algorithms)


def measure_tracks(data: Path, algorithms: tuple[str, ...] = ALGORITHMS) -> Outcome:
    """The same on tracks."""
    return _measured(data / TRACKS, OF_TRACKS, algorithms)


def _measured(
    recording: Path, faults: dict[str, tuple[str, float]], algorithms: tuple[str, ...]
) -> Outcome:
    texts = {"none": ("", 0.0)}
    for name, (text, lasts_s) in faults.items():
        kind, _, settings = text.partition(":")
        at = f"at_s={AT_S:g}"
        texts[name] = (f"{kind}:{','.join(filter(None, [at, settings]))}", lasts_s)
    rows = [(recording, name, *texts[fault]) for name in algorithms for fault in texts]
    found = iter(in_parallel(survive, rows))
    outcome = Outcome()
    for name in algorithms:
        clean = next(found)
        outcome.add(f"none.{name}", [Metric("error", clean.whole_m, "m", "lower")])
        for fault in faults:
            run = next(found)
            outcome.add(f"{fault_key(fault)}.{name}", figures_of(run, clean))
            outcome.notes.append(f"{fault}, {name}: {run.status}")
    return outcome


def figures_of(run: Survived, clean: Survived) -> list[Metric]:
    """Figures of a run with a fault, beside the run without."""
    worst = max(run.segments_m, default=float("nan"))
    return [
        Metric("internal_errors", float(run.internal), "", "lower", 0.0, EXACT),
        Metric("completed", float(run.status == "ok"), "", "higher", tolerance=EXACT),
        Metric("segments", len(run.segments_m), "", "lower", tolerance=1.0),
        Metric("error", run.whole_m, "m", "lower", tolerance=_TOLERANCE),
        Metric("segment_ratio", worst / clean.whole_m, "× clean", "lower", tolerance=_TOLERANCE),
        Metric("recovered_in", run.recovered_s, "s", "lower", RECOVERY_BAR_S, _TOLERANCE),
    ]


def fault_key(fault: str) -> str:
    """The name of a fault as a part of a key."""
    return "".join(c if c.isalnum() else "_" for c in fault)


BENCHMARKS = {
    "faults": Benchmark(
        "29 faults put into MH_01, under five algorithms: how runs end, errors, time to recover",
        (RECORDING,),
        measure,
    ),
    "faults_tracks": Benchmark(
        "23 faults put into tracks of OpenVINS' simulation, under five algorithms",
        (TRACKS,),
        measure_tracks,
    ),
}
