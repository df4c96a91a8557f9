# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run: a recorded sequence in, a trajectory and a map out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Protocol

from slam_graph.backend.estimator import Estimator
from slam_graph.config import RunConfig, load_config
from slam_graph.datasets.sequence import Sequence
from slam_graph.errors import DataError
from slam_graph.frontend.build_frontend import build_frontend
from slam_graph.frontend.frontend_protocol import Feedback
from slam_graph.maps.map_model import SlamMap
from slam_graph.pipeline.final_stage import FinalStage
from slam_graph.pipeline.known_start import KnownStart
from slam_graph.pipeline.localization_stage import Localization, LocalizationStage, NoLocalization
from slam_graph.pipeline.loop_stage import LoopStage
from slam_graph.pipeline.map_stage import map_of
from slam_graph.pipeline.supervision import (
    Agreement,
    check_sane,
    estimate,
    interrupts_between_frames,
    outcome,
)
from slam_graph.pipeline.tracking import Tracking
from slam_graph.results.run_result import RunResult
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame, ImuData, Packet
from slam_graph.visualization.viewer import NullViewer, Viewer

__all__ = ["Progress", "RunResult", "run"]


CORRECTED = ("ok", "low_coverage")
"""How runs end of which loops are closed: who interrupts one does not want to wait."""


class Progress(Protocol):
    """Is told how far a run is."""

    def advance(self, stamp_ns: int, initialized: bool) -> None:
        """Called after each frame with its time."""
        ...

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        """Called after each step of the final bundle adjustment, with keyframes done and all."""
        ...


class Recorder(Protocol):
    """Takes what the front end found, with the IMU samples that led up to it."""

    def write(self, imu: ImuData, frame: FeatureFrame) -> None:
        """Called after each frame."""
        ...


class NullProgress:
    """Tells nobody."""

    def advance(self, stamp_ns: int, initialized: bool) -> None:
        """Tell nobody."""

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        """Tell nobody."""


class NullRecorder:
    """Records nothing."""

    def write(self, imu: ImuData, frame: FeatureFrame) -> None:
        """Record nothing."""


def run(
    sequence: Sequence,
    config: RunConfig | None = None,
    viewer: Viewer | None = None,
    progress: Progress | None = None,
    recorder: Recorder | None = None,
    known_map: SlamMap | None = None,
) -> RunResult:
    """Estimate the trajectory of a recorded sequence.

    Once frames are being read nothing is lost: an interruption (Ctrl-C), a fault in the data or a
    divergence ends the run, and the result holds what was done so far and says so in `status`.
    `RunResult.check` raises what went wrong; `RunResult.save` writes the files.

    Args:
        sequence: the recording.
        config: all settings, by default those of `load_config()`.
        viewer: watches the run.
        progress: is told how far the run is.
        recorder: takes the front end's output, for a replay.
        known_map: a map to locate every frame in, beside the estimate in the run's own world.

    Raises:
        DataError: if the sequence has not what the settings ask for.
    """
    config = config or load_config()
    viewer, progress = viewer or NullViewer(), progress or NullProgress()
    recorder = recorder or NullRecorder()

    result = _open(sequence, config)
    frontend = build_frontend(
        result.rig,
        config.frontend,
        config.seed,
        sequence.diagnostics,
        result.info.content,
        config.backend.noise.gravity,
    )
    estimator = Estimator(result.rig, config.algorithm, config.backend, sequence.diagnostics)
    start = KnownStart.of(sequence, result, config.backend.initialization.mode)
    loops = LoopStage(
        result.rig, config.loop_closure, config.seed, sequence.diagnostics, config.map.enabled
    )
    localization: Localization = NoLocalization()
    if known_map is not None:
        localization = LocalizationStage(
            known_map, result.rig, config, result.info.name, sequence.diagnostics
        )

    agreement = Agreement(config.limits)
    tracking = Tracking(_packets(sequence, result), frontend, config.overlap)
    with FinalStage(result, sequence.diagnostics) as final:
        with (
            outcome(result, estimator, sequence.diagnostics),
            _watched(viewer, result),
            interrupts_between_frames() as frame_done,
            closing(tracking.run()) as packets,
        ):
            for tracked in packets:
                packet, features, clock = tracked.packet, tracked.features, tracked.clock
                start.apply(estimator, packet.frame.stamp_ns, result)
                estimator.add_imu(packet.imu)
                state = estimate(estimator, features)
                clock.lap("backend", {k: 1e3 * s for k, s in estimator.timings.items()})
                if estimator.costs:
                    result.steps.append(features.stamp_ns, estimator.costs, estimator.columns)
                result.innovations.append(features.stamp_ns, estimator.innovations)
                ids, points = estimator.landmarks()
                tracking.tell(Feedback.of(state, estimator.rejected, ids, points))
                if state is not None:
                    check_sane(state, config.limits)
                    agreement.check(features.stamp_ns, estimator.innovations)
                    result.history.append(state)
                    result.points.update(ids, points)
                    loops.keep(packet.frame, features, state)
                    localization.keep(packet.frame, features, state)
                if state is not None and estimator.calibration is not None:
                    result.calibration.append(estimator.calibration)
                result.count_frame(features.stamp_ns, clock.milliseconds, tracked.frame_stats)
                recorder.write(packet.imu, features)
                final.keep(packet.imu, features, estimator.imu_noise)
                progress.advance(features.stamp_ns, estimator.initialized)
                viewer.show(packet.frame, features, state, points)
                frame_done()
        final.finish(progress.adjusting)
    result.localization = localization.finish()
    if result.status in CORRECTED:
        result.loops = loops.finish(result.best_trajectory)
        if config.map.enabled:
            result.slam_map = map_of(result, loops.keyframes, sequence.diagnostics)
    result.warnings = +sequence.diagnostics.counts
    return result


def _open(sequence: Sequence, config: RunConfig) -> RunResult:
    """An empty result for the part of the sequence that is asked for."""
    info = sequence.info()
    if info.frames == 0:
        raise DataError(f"{info.name}: holds no camera frames; there is nothing to run on")
    if info.imu_samples == 0:
        raise DataError(
            f"{info.name}: format '{info.format}' gives no IMU (gyroscope and accelerometer); "
            "every back end needs one, only the front end can be run on its frames"
        )
    start_ns = info.start_ns + round(config.start_s * 1e9)
    if start_ns > info.end_ns:
        length_s = (info.end_ns - info.start_ns) * 1e-9
        raise DataError(
            f"{info.name}: cannot start at {config.start_s:g} s, it is {length_s:.3f} s long"
        )
    end_ns = info.end_ns
    if config.duration_s is not None:
        end_ns = min(end_ns, start_ns + round(config.duration_s * 1e9))
    rig = sequence.rig if config.cameras is None else sequence.rig.select(config.cameras)
    return RunResult(info, config, rig, start_ns, end_ns, truth=sequence.groundtruth())


def _packets(sequence: Sequence, result: RunResult) -> Iterator[Packet]:
    """The packets that are asked for."""
    packets = sequence.packets(
        result.start_ns if result.config.start_s > 0 else None,
        result.end_ns if result.config.duration_s is not None else None,
    )
    count = len(result.rig.cameras)
    for packet in packets:
        yield Packet(packet.imu, _first_cameras(packet.frame, count))


def _first_cameras(frame: CameraFrame | FeatureFrame, count: int) -> CameraFrame | FeatureFrame:
    """The same frame without the cameras that are not used."""
    if isinstance(frame, CameraFrame):
        return CameraFrame(frame.stamp_ns, frame.images[:count])
    return FeatureFrame(frame.stamp_ns, frame.cameras[:count])


@contextmanager
def _watched(viewer: Viewer, result: RunResult) -> Iterator[None]:
    """Open the viewer, and close it however the run ends."""
    viewer.open(result.rig, result.truth_of_run())
    try:
        yield
    finally:
        viewer.close()
