# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Faults put into two recordings, under several algorithms: how runs end, and what is reached then.

Images of MH_01, and tracks of OpenVINS' simulation, which images cannot be put into. A fault
strikes at 6 s of 17. What counts is the error of each segment, aligned on its own, relative
to that of the run without a fault; that no run ends with an internal error; and that 5 s after the
fault at the latest the run is back, in one of two ways:

- A new segment has begun.
- The estimate is within 3 σ: √NEES of its position, which under a right covariance 97 % of the
  states are. Yaw and position are aligned as those of the run without a fault are over its whole
  length: both runs are the same before the fault, and a few seconds of path before it would not
  show the yaw well enough. Where the run without a fault is beyond 3 σ itself at that time, that
  tells nothing of the fault: the bar is multiplied by √(its mean NEES / 3), if that is more than 1.
  It is 1 on tracks. On MH_01 errors of tracks in images are correlated. The positions of its
  truth are 8 ms late, as its IMU shows without an image: errors in standard deviations are against
  these at the times of the IMU, errors in metres against the file of the truth.

What a run says are the warnings that it prints and the run without a fault does not, one of each
kind, and the message of its end.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.flights import in_parallel
from benchmarks.metric import EXACT, Metric, info
from benchmarks.running import Run
from benchmarks.suite import Benchmark, Outcome
from slam_graph.arrays import FloatArray
from slam_graph.datasets import open_dataset
from slam_graph.errors import DataError
from slam_graph.evaluation import ape, synchronize
from slam_graph.evaluation.consistency import Nees, nees
from slam_graph.geometry import Similarity, Trajectory
from slam_graph.results import RunResult
from slam_graph.sensors import ImuData
from slam_graph.simulation.imu_consistent_path import at_imu_times, truth_delay_s

RECORDING, TRACKS = "euroc/MH_01_easy_17s", "openvins_sim/euroc_V1_01"
CLIP_S = 17.0
AT_S = 6.0
ALGORITHMS = ("msckf", "swf", "okvis", "ekf", "fixed_lag_isam2")
FAULTS = {
    "single frames lost": ("frames_dropped:duration_s=4,share=0.1", 4.0),
    "five frames lost at a time": ("frames_dropped:duration_s=4,share=0.3,burst=5", 4.0),
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
    "images of half the size, 3 s": ("image_size:duration_s=3", 3.0),
    "images of 16 bits, 3 s": ("image_16_bit:duration_s=3", 3.0),
    "images in colour, 3 s": ("image_colour:duration_s=3", 3.0),
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
    "nothing, 10 s": ("all_missing:at_s=3,duration_s=10", 7.0),
    "carried away": ("kidnapped:duration_s=2", 0.0),
}
"""Faults as texts for `inject`, from `AT_S` on unless they say another time, and how long after
`AT_S` they end, s."""
OF_TRACKS = {name: fault for name, fault in FAULTS.items() if not fault[0].startswith("image_")}
"""Those that recordings of tracks can have."""
RECOVERY_BAR_S = 5.0
"""Longest time to recover."""
SIGMA_BAR = 3.0
"""Largest error after the fault, in standard deviations."""
BACK_S, _AROUND_S = 5.0, 0.5
"""The estimate is looked at so long after the end of a fault (after its beginning, if it does not
end): the median over so long before and after that."""
_TOLERANCE = 0.5
"""How an estimate goes through a fault depends on chance more than its error elsewhere."""
_LOGGER = logging.getLogger("slam_graph")


@dataclass(frozen=True, eq=False)
class RunPath:
    """Positions of a run, and how sure it is of them.

    Attributes:
        estimate: (N) causal poses.
        covariances: (N, 6, 6) of them, body frame, rotation before position.
        truth: the true trajectory, with positions at the times of the IMU.
        start_ns: time of the first frame.
    """

    estimate: Trajectory
    covariances: FloatArray
    truth: Trajectory
    start_ns: int

    def nees(self, onto: Similarity) -> Nees:
        """NEES of all poses in the world of the truth.

        Args:
            onto: leads there.
        """
        return nees(self.estimate, self.covariances, self.truth, onto)

    def onto_truth(self) -> Similarity:
        """The alignment in yaw and position to the truth."""
        true, own = synchronize(self.truth, self.estimate)
        return Similarity.of_positions(true.positions, own.positions, "yaw")

    def sigmas(self, onto: Similarity, at_s: float) -> float:
        """Error of the position around a time, in standard deviations; NaN where there is none.

        Args:
            onto: leads to the world of the truth.
            at_s: seconds after the first frame.
        """
        found = self.nees(onto)
        near = np.abs((found.stamps_ns - self.start_ns) * 1e-9 - at_s) <= _AROUND_S
        return float(np.sqrt(np.median(found.position[near]))) if near.any() else float("nan")


@dataclass(frozen=True, slots=True)
class Survived:
    """What came of one run.

    Attributes:
        status: of the run.
        whole_m: error over all, aligned once; NaN without a trajectory.
        segments_m: errors of the segments, each aligned on its own.
        recovered_s: from the end of the fault to the first state of a later segment; 0 in one.
        internal: whether it ended with an internal error.
        said: the first warning of each kind, by kind.
        counts: how often each kind was counted.
        message: of its end; empty if it ended well.
        path: where it was; None without a trajectory.
    """

    status: str
    whole_m: float
    segments_m: tuple[float, ...]
    recovered_s: float
    internal: bool = False
    said: Mapping[str, str] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    message: str = ""
    path: RunPath | None = None


@dataclass(frozen=True, slots=True)
class Off:
    """How far a run is off some time after a fault, in standard deviations; NaN if not known.

    Attributes:
        error: of the run with the fault.
        clean: of the run without it, at the same time.
        factor: by how much the run without it is off more than its σ over its whole length; 1 if it
            is not.
    """

    error: float
    clean: float
    factor: float

    @property
    def within(self) -> bool:
        """Whether the run is within the bar, as the head of this file says."""
        bar = SIGMA_BAR * (self.factor if self.clean > SIGMA_BAR else 1.0)
        return self.error <= bar

    @staticmethod
    def after(run: Survived, clean: Survived, lasts_s: float) -> Off:
        """That of two runs, at a time after a fault of some length."""
        if run.path is None or clean.path is None:
            return Off(*[float("nan")] * 3)
        at_s, onto = AT_S + lasts_s + BACK_S, clean.path.onto_truth()
        mean = float(np.mean(clean.path.nees(onto).position))
        factor = max(1.0, math.sqrt(mean / 3.0))
        return Off(run.path.sigmas(onto, at_s), clean.path.sigmas(onto, at_s), factor)


def survive(recording: Path, algorithm: str, fault: str, lasts_s: float) -> Survived:
    """One run with a fault, or without one if the text is empty."""
    sequence = open_dataset(recording, faults=[fault] if fault else [])
    with _heard() as said:
        run = Run(sequence, algorithm, 2, duration_s=CLIP_S)
    result, errors = run.result, []
    for segment in result.segments:
        try:
            part = segment.part_of(result.trajectory)
            errors.append(ape(run.truth, part, alignment="yaw").statistics.rmse)
        except DataError:  # too short to be judged
            continue
    whole, start_ns = float("nan"), result.input.start_ns
    if len(result.history):
        whole = ape(run.truth, result.trajectory, alignment="yaw").statistics.rmse
    later = [s.begin_ns for s in result.segments.later]
    end_ns = start_ns + round((AT_S + lasts_s) * 1e9)
    return Survived(
        status=result.status,
        whole_m=whole,
        segments_m=tuple(errors),
        recovered_s=max(0.0, (later[0] - end_ns) * 1e-9) if later else 0.0,
        internal=result.message.startswith("internal error"),
        said={kind: in_words(text, start_ns, recording) for kind, text in said.items()},
        counts=dict(result.warnings),
        message=in_words(result.message, start_ns, recording),
        path=_path_of(result, recording),
    )


def _path_of(result: RunResult, recording: Path) -> RunPath | None:
    """The path of a run with its truth, if it has both."""
    truth, start_ns = result.groundtruth, result.input.start_ns
    if truth is None or not len(result.history):
        return None
    truth = at_imu_times(truth, _late_s(recording))
    return RunPath(result.trajectory, result.history.pose_covariances(), truth, start_ns)


@cache
def _late_s(recording: Path) -> float:
    """How much later the positions of the truth are than the IMU says."""
    sequence = open_dataset(recording)
    truth, imu = sequence.groundtruth(), ImuData.concatenate(list(sequence.imu_blocks()))
    assert truth is not None
    assert sequence.rig.imu is not None
    return truth_delay_s(truth, imu, sequence.rig.imu)


@contextmanager
def _heard() -> Iterator[dict[str, str]]:
    """Collect the first warning of each kind, without its kind; none is shown."""
    said: dict[str, str] = {}

    class _Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            kind, _, text = record.getMessage().partition(": ")
            if record.levelno == logging.WARNING and _KIND.fullmatch(kind):
                said.setdefault(kind, text)

    listener, before = _Listener(logging.WARNING), (_LOGGER.level, _LOGGER.propagate)
    _LOGGER.setLevel(logging.WARNING)
    _LOGGER.propagate = False
    _LOGGER.addHandler(listener)
    try:
        yield said
    finally:
        _LOGGER.removeHandler(listener)
        _LOGGER.setLevel(before[0])
        _LOGGER.propagate = before[1]


_KIND = re.compile("[a-z_]+")
_STAMP = re.compile(r"(?:frame )?(?<![\w/])(\d{16,})\b(?: ns)?")


def in_words(text: str, start_ns: int, recording: Path) -> str:
    """A message with seconds since the first frame for stamps in ns, and without its folder."""
    text = text.replace(f"{recording}/", "")
    return _STAMP.sub(lambda found: f"t = {(int(found[1]) - start_ns) * 1e-9:.1f} s", text)


_CUT = re.compile(r"^IMU sample of t = [-\d.]+ s: (?=.*\bt = )|: gyroscope .*$")
"""What a table has no room for: a time that is said twice, and the values of a sample."""


def said_by(run: Survived, clean: Survived) -> str:
    """What a run with a fault says and the one without does not, in one line of a table."""
    new = [kind for kind in run.said if kind not in clean.said]
    lines = []
    for kind in new:
        count = run.counts.get(kind, 1)
        times = f" ({count} ×)" if count > 1 else ""
        lines.append(f"`{kind}`{times}: {_CUT.sub('', run.said[kind])}")
    return "; ".join([*lines, *filter(None, [run.message])])


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
        at = "" if "at_s=" in settings else f"at_s={AT_S:g}"
        texts[name] = (f"{kind}:{','.join(filter(None, [at, settings]))}", lasts_s)
    rows = [(recording, name, *texts[fault]) for name in algorithms for fault in texts]
    found = iter(in_parallel(survive, rows))
    outcome = Outcome()
    for name in algorithms:
        clean = next(found)
        factor = Off.after(clean, clean, 0.0).factor
        outcome.add(f"none.{name}", [Metric("error", clean.whole_m, "m", "lower")])
        outcome.add(f"none.{name}", [info("sigma_factor", factor, "")])
        for fault, (_, lasts_s) in faults.items():
            run = next(found)
            key, said = f"{fault_key(fault)}.{name}", said_by(run, clean)
            outcome.add(key, figures_of(run, clean, lasts_s))
            outcome.texts |= {f"{key}.status": run.status, f"{key}.said": said}
            outcome.notes.append(f"{fault}, {name}: {run.status}{f': {said}' if said else ''}")
    return outcome


def figures_of(run: Survived, clean: Survived, lasts_s: float) -> list[Metric]:
    """Figures of a run with a fault that lasts so long, beside the run without."""
    worst = max(run.segments_m, default=float("nan"))
    off, again = Off.after(run, clean, lasts_s), len(run.segments_m) > 1
    back = run.recovered_s <= RECOVERY_BAR_S if again else off.within
    return [
        Metric("internal_errors", float(run.internal), "", "lower", 0.0, EXACT),
        Metric("completed", float(run.status == "ok"), "", "higher", tolerance=EXACT),
        Metric("segments", len(run.segments_m), "", "lower", tolerance=1.0),
        Metric("error", run.whole_m, "m", "lower", tolerance=_TOLERANCE),
        Metric("segment_ratio", worst / clean.whole_m, "× clean", "lower", tolerance=_TOLERANCE),
        Metric("recovered_in", run.recovered_s, "s", "lower", RECOVERY_BAR_S, _TOLERANCE),
        Metric("back", float(back), "", "higher", 1.0, EXACT),
        info("sigmas", off.error, "σ"),
        info("sigmas_clean", off.clean, "σ"),
    ]


def fault_key(fault: str) -> str:
    """The name of a fault as a part of a key."""
    return "".join(c if c.isalnum() else "_" for c in fault)


BENCHMARKS = {
    "faults": Benchmark(
        f"{len(FAULTS)} faults in MH_01, under five algorithms: how runs end, errors, recovery",
        (RECORDING,),
        measure,
    ),
    "faults_tracks": Benchmark(
        f"{len(OF_TRACKS)} faults put into tracks of OpenVINS' simulation, under five algorithms",
        (TRACKS,),
        measure_tracks,
    ),
}
