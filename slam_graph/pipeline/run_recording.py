# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run: a recording in, a trajectory and a map out."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from collections.abc import Sequence as SequenceOf
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slam_graph.backend import Estimator
from slam_graph.config import RunConfig, load_config
from slam_graph.datasets import RecordedSequence, Sequence, open_dataset
from slam_graph.errors import DataError
from slam_graph.frontend import build_frontend
from slam_graph.interrupts import Interrupts
from slam_graph.pipeline.estimation import ODOMETRY_UNUSED, Estimation
from slam_graph.pipeline.observers import (
    GraphKeeping,
    NullProgress,
    NullRecorder,
    NullViewer,
    Observers,
    Progress,
    Recorder,
    Snapshots,
    Viewer,
    Viewing,
)
from slam_graph.pipeline.smoothing import Smoothing
from slam_graph.pipeline.stage import NoObjects, Stage
from slam_graph.pipeline.supervision import finish, outcome
from slam_graph.pipeline.tracking import TrackedPacket, Tracking, can_overlap, packets_of
from slam_graph.pipeline.verdict import Verdict
from slam_graph.pipeline.world_of_fixes import NOT_TOLD, is_in_world_of_fixes, why_no_scale
from slam_graph.results import RunInput, RunResult

if TYPE_CHECKING:
    from slam_graph.maps import SlamMap


logger = logging.getLogger(__name__)

_LEAST_ODOMETRY_S = 1.0
"""Odometry of less time is not waited for, where it would tell the unit of length."""


def run(
    recording: Sequence | Path | str,
    config: RunConfig | Path | str | None = None,
    viewer: Viewer | None = None,
    progress: Progress | None = None,
    recorder: Recorder | None = None,
    known_map: SlamMap | None = None,
    *,
    graph_times: SequenceOf[int | float] = (),
    so_far: Path | str | None = None,
    overrides: Iterable[str] | Mapping[str, Any] = (),
    **options: Any,
) -> RunResult:
    """Estimate the trajectory of a recording.

    Once frames are being read nothing is lost: an interruption (Ctrl-C), a fault in the data or a
    divergence ends the run, and the result holds what was done so far and says so in `status`.
    `RunResult.check` raises what went wrong; `RunResult.save` writes the files.

        run("demo", algorithm="swf").save("results/mine")

    Args:
        recording: an open sequence (`open_dataset`), or the path or name of a recording.
        config: all settings (`load_config`), a YAML file of them, or the name of an algorithm.
        viewer: watches the run.
        progress: reports how far the run is.
        recorder: records the front end's output, for a replay.
        known_map: a map to locate every frame in, beside the estimate in the run's own world.
        graph_times: when to keep the factor graph of the back end, in seconds after the first frame
            or stamps in ns (int); `RunResult.graphs` has them.
        so_far: folder to write the estimate so far to now and then, with the status `unfinished`:
            it is left if the process is killed. Its files are replaced by `RunResult.save`.
        overrides: changes of the settings, as for `load_config`.
        options: top-level settings by name, as for `load_config`: `algorithm`, `duration_s`, …

    Raises:
        ConfigError: if a setting is wrong.
        DataError: if the recording cannot be opened, or lacks what the settings ask for.
    """
    settings = _settings(config, overrides, options)
    sequence = _opened(recording, settings)
    result = RunResult(_part_of(sequence, settings))
    rig = result.input.rig
    result.history.level, result.history.scaled_camera = rig.has_imu, rig.scaled_camera
    if result.input.truth is not None and result.groundtruth is None:
        sequence.diagnostics.warn("groundtruth_elsewhere", _truth_elsewhere(result.input))
    known = sequence.aiding if isinstance(sequence, RecordedSequence) else None
    if no_scale := why_no_scale(known, result.input):
        sequence.diagnostics.warn("scale_unknown", no_scale)
    if not rig.has_scale and known is not None and len(known.odometry_stamps_ns):
        sequence.diagnostics.warn("odometry_unused", ODOMETRY_UNUSED)
    places = _place_stages(sequence, result, known_map)
    tracking = _tracking(sequence, result.input)
    estimation = Estimation(sequence, result)
    objects = _objects_stage(sequence, result, estimation.estimator)
    estimator, diagnostics = estimation.estimator, sequence.diagnostics
    progress = progress or NullProgress()
    smoothed = result.config.final_ba.enabled
    stages: list[Stage] = [  # in the order in which they finish
        Observers(progress, recorder or NullRecorder()),
        *([Smoothing(result, progress, diagnostics, objects)] if smoothed else []),
        objects,  # it moves the smoothed trajectory, too
        *places,
        Verdict(result, diagnostics, objects),
        GraphKeeping(result, estimator, graph_times, diagnostics),
        *([] if so_far is None else [Snapshots(result, Path(so_far), diagnostics)]),
        Viewing(result, estimator, viewer or NullViewer(), diagnostics),
    ]

    with ExitStack() as resources, Interrupts.deferred() as interrupts:
        with outcome(result, estimator):
            with _tracked(tracking, result, sequence) as packets:
                for stage in stages:
                    stage.begin(resources)
                for tracked in packets:
                    frame = objects.noted(estimation.estimate(tracked))
                    for stage in stages:
                        stage.frame(frame)
                    tracking.give_feedback(objects.feedback(frame.feedback()))
                    interrupts.check()
                estimation.finish()
            interrupts.check()
        if len(result.history) and not (result.history.has_scale or no_scale):
            diagnostics.warn("scale_unknown", NOT_TOLD)
        finish(stages, result, interrupts)
    result.warnings = +sequence.diagnostics.counts
    return result


def _truth_elsewhere(asked: RunInput) -> str:
    """That the ground truth shares no time with what is run, and the spans of both."""
    assert asked.truth is not None
    truth_ns = asked.truth.stamps_ns.tolist()
    true, run = (
        f"from {ends[0] * 1e-9:.3f} to {ends[-1] * 1e-9:.3f} s" if ends else "empty"
        for ends in (truth_ns, asked.states_ns)
    )
    return (
        f"the ground truth is {true}, the run {run}: they share no time, so that there are no "
        "errors; check their clocks"
    )


def _place_stages(sequence: Sequence, result: RunResult, known_map: SlamMap | None) -> list[Stage]:
    """Localization, loop closure and the map, as far as they are wanted.

    Raises:
        DataError: if places cannot be recognised in the recording.
    """
    config, diagnostics = result.config, sequence.diagnostics
    loops, mapping = config.loop_closure.enabled, config.map.enabled
    if not (loops or mapping or known_map is not None):
        return []
    from slam_graph.pipeline import mapping as of_places  # most runs need none of it

    of_places.require_places(sequence, result.input, known_map)
    keyframes = of_places.Keyframes(result)
    off = Stage()
    return [
        off if known_map is None else of_places.Localization(result, known_map, diagnostics),
        keyframes if loops or mapping else off,
        of_places.LoopClosing(result, keyframes, diagnostics) if loops else off,
        of_places.MapBuilding(result, keyframes, diagnostics) if mapping else off,
    ]


def _objects_stage(sequence: Sequence, result: RunResult, estimator: Estimator) -> NoObjects:
    """The estimation of moving objects, if it is wanted."""
    if not result.config.objects.enabled:
        return NoObjects()
    from slam_graph.pipeline.object_estimation import Objects  # most runs need none of it

    recording = sequence if isinstance(sequence, RecordedSequence) else None
    return Objects(result, estimator, sequence.diagnostics, recording)


def _settings(
    config: RunConfig | Path | str | None,
    overrides: Iterable[str] | Mapping[str, Any],
    options: dict[str, Any],
) -> RunConfig:
    """The settings that the arguments of `run` mean."""
    if isinstance(config, RunConfig):
        return config.with_overrides(overrides, **options)
    return load_config(config, overrides, **options)


def _opened(recording: Sequence | Path | str, config: RunConfig) -> Sequence:
    """The recording, opened if it is named."""
    if isinstance(recording, Path | str):
        return open_dataset(recording, cameras=config.cameras)
    return recording


def _part_of(sequence: Sequence, config: RunConfig) -> RunInput:
    """The part of the sequence that is asked for."""
    info = sequence.info()
    if info.frames == 0:
        raise DataError(f"{info.name}: holds no camera frames; there is nothing to run on")
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
    recorded = rig.has_imu and info.imu_samples > 0
    rig = replace(rig, has_imu=config.backend.dynamics.uses_imu(recorded))
    if not rig.has_imu:  # gravity is not known
        config = config.with_overrides(["loop_closure.degrees_of_freedom=6"])
    datum, objects, truth, of_fixes = None, {}, sequence.groundtruth(), False
    if isinstance(sequence, RecordedSequence):
        datum = sequence.aiding.datum
        objects = sequence.object_truth() if config.objects.enabled else {}
        aiding = config.backend.on_the_clock(sequence.aiding)
        of_fixes = is_in_world_of_fixes(truth, aiding, config.backend)
        rig = replace(rig, has_odometry=_tells_lengths(sequence, config, start_ns, end_ns))
    return RunInput(info, config, rig, start_ns, end_ns, truth, datum, objects, of_fixes)


def _tells_lengths(
    sequence: RecordedSequence, config: RunConfig, start_ns: int, end_ns: int
) -> bool:
    """Whether odometry covers enough of a part, by the stamps of its first and last frame."""
    offset_ns = round(sequence.rig.pose_offset_s * 1e9)
    covered_s = sequence.aiding.odometry_covers_s(start_ns + offset_ns, end_ns + offset_ns)
    return config.backend.odometry.enabled and covered_s >= _LEAST_ODOMETRY_S


def _tracking(sequence: Sequence, asked: RunInput) -> Tracking:
    """Front end and reader of the recording."""
    config = asked.config
    frontend = build_frontend(
        asked.rig,
        config.used_frontend,
        config.seed,
        sequence.diagnostics,
        asked.info.content,
        config.backend.noise.gravity,
    )
    return Tracking(packets_of(sequence, asked), frontend)


def _tracked(
    tracking: Tracking, result: RunResult, sequence: Sequence
) -> AbstractContextManager[Iterator[TrackedPacket]]:
    """The tracked packets, by a process of its own where that is wanted and possible."""
    asked = result.input
    if not asked.config.overlap or asked.info.content == "tracks":
        return tracking.in_turn()
    if not can_overlap():
        logger.warning(
            "overlap needs a second core, the main thread and a system that forks; "
            "front and back end take turns (overlap=false avoids this warning)"
        )
        return tracking.in_turn()
    return tracking.beside(asked.rig, sequence.diagnostics)
