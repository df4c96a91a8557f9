# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A whole run of the pipeline, and its errors at exactly the times of its states."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from slam_graph.config import load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.sequence import Sequence
from slam_graph.datasets.streams import images
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.evaluation.choices import PoseRelation
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.geometry.trajectory_alignment import AlignmentMode
from slam_graph.pipeline.observers import NullViewer
from slam_graph.pipeline.run_recording import run
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.sensors import Packet


@dataclass(frozen=True, slots=True)
class Errors:
    """Root-mean-square errors of a trajectory.

    Attributes:
        position_m: of the position.
        orientation_deg: of the orientation.
        span_s: time from the first pose to the last.
    """

    position_m: float
    orientation_deg: float
    span_s: float

    @staticmethod
    def of(truth: Trajectory, estimate: Trajectory, alignment: AlignmentMode) -> Errors:
        """The errors of an estimate."""

        def rmse(relation: PoseRelation) -> float:
            return ape(truth, estimate, relation, alignment).statistics.rmse

        stamps = estimate.stamps_ns
        return Errors(rmse("trans_part"), rmse("angle_deg"), float(stamps[-1] - stamps[0]) * 1e-9)

    @staticmethod
    def unknown() -> Errors:
        """Of a run that gave no trajectory to judge."""
        return Errors(math.nan, math.nan, 0.0)


class Run:
    """A run of the pipeline over a recording, as it ships and with its own progress counted.

    The bundle adjustment at its end is left out unless it is asked for.

    Attributes:
        result: what it found out.
        truth: ground truth; every recording of a benchmark has one.
        frames_waited: number of frames before the first one that had a state.
    """

    def __init__(
        self,
        recording: Path | str | Sequence,
        algorithm: str,
        cameras: int | None = None,
        groundtruth: Path | None = None,
        overrides: Iterable[str] = (),
        duration_s: float | None = None,
        final_ba: bool = False,
        seed: int | None = None,
    ) -> None:
        overrides = (f"final_ba.enabled={str(final_ba).lower()}", *overrides)
        config = load_config(
            None, overrides, algorithm=algorithm, cameras=cameras, duration_s=duration_s, seed=seed
        )
        sequence = (
            open_dataset(recording, cameras=cameras, groundtruth=groundtruth)
            if isinstance(recording, Path | str)
            else recording
        )
        counter = _StateCounter()
        with threadpool_limits(limits=1, user_api="blas"):
            self.result = run(sequence, config, viewer=counter)
        self.frames_waited = counter.waited
        truth = self.result.input.truth
        assert truth is not None, f"{recording} has no ground truth"
        self.truth = truth

    @property
    def ok(self) -> bool:
        """Whether it came to its end with an estimate; if not, none of its errors counts."""
        return self.result.status == "ok"

    @property
    def seconds_to_start(self) -> float:
        """From the first frame to the first state; NaN if there was none."""
        stamps = self.result.trajectory.stamps_ns
        return float(stamps[0] - self.result.input.start_ns) * 1e-9 if len(stamps) else math.nan

    @property
    def frames_lost(self) -> float:
        """Frames from the first state to the end without one; NaN if all."""
        states = len(self.result.history)
        whole = self.result.config.duration_s is None or not self.ok
        frames = self.result.input.info.frames if whole else self.result.logs.frames
        return frames - self.frames_waited - states if states else math.nan

    def errors(self, alignment: AlignmentMode) -> Errors:
        """The errors of the causal estimate."""
        if not self.ok:
            return Errors.unknown()
        return Errors.of(self.truth, self.result.trajectory, alignment)

    def notes(self) -> list[str]:
        """What a reader should know of the run: how it ended if not well, what it survived."""
        result, name = self.result, self.result.config.algorithm.name
        lines = [] if self.ok else [f"{name}: {result.status}: {result.message}"]
        faults = {k: n for k, n in result.warnings.items() if k.startswith(("image", "camera"))}
        return lines + [f"{name}: survived {n} × {kind}" for kind, n in faults.items()]


class _StateCounter(NullViewer):
    """Counts the frames before the first state."""

    def __init__(self) -> None:
        self.waited = 0
        self._started = False

    def show(self, frame: EstimatedFrame, estimator: object) -> None:
        """Look whether there is a state."""
        self._started |= frame.state is not None
        self.waited += not self._started


@contextmanager
def decoded_once() -> Iterator[None]:
    """Within it an image file is decoded when it is read first: for several runs over the same."""
    decode = images.decode_grey
    decoded: dict[str, images.Image | images.Fault] = {}

    def remembered(data: bytes, where: str) -> images.Image | images.Fault:
        if where not in decoded:
            image = decode(data, where)
            if not isinstance(image, images.Fault):
                image.flags.writeable = False  # a run that changed it would change the next one
            decoded[where] = image
        return decoded[where]

    images.decode_grey = remembered
    try:
        yield
    finally:
        images.decode_grey = decode


def read_once(recording: Sequence) -> Sequence:
    """The recording, whose packets are read, or simulated, when they are asked for first.

    For several runs over the whole of a recording of tracks, which fits into memory. Each of them
    counts the faults that reading has found, and its own.
    """
    read, kept, counts = recording.packets, list[Packet](), Counter[str]()

    def packets(start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Packet]:
        if start_ns is not None or end_ns is not None:
            return read(start_ns, end_ns)
        recording.diagnostics.counts.clear()
        if not kept:
            kept.extend(list(read()))  # nothing is kept where it fails
            counts.update(recording.diagnostics.counts)
        else:
            recording.diagnostics.counts.update(counts)
        return iter(kept)

    recording.packets = packets  # type: ignore[method-assign]
    return recording


def clipped(algorithm: str, duration_s: float | None) -> str:
    """The name of an algorithm in a table, with the length of the clip if there is one."""
    return algorithm if duration_s is None else f"{algorithm}_{duration_s:g}s"


def within(trajectory: Trajectory, span: Trajectory) -> Trajectory:
    """The part of a trajectory between the first and the last pose of another."""
    stamps = trajectory.stamps_ns
    inside = (stamps >= span.stamps_ns[0]) & (stamps <= span.stamps_ns[-1])
    return trajectory.select(inside)
