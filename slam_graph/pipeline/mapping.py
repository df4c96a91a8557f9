# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Stages of places: keyframes and loop closure, the map of a run, localization in a saved map.

Keyframes are collected on the way. Loops are closed and the map is built at the end, localization
gives every frame its pose in a map that was saved before.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from dataclasses import replace

import cv2
import gtsam
import numpy as np

from slam_graph.backend import PosedFrame
from slam_graph.datasets import Sequence
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.geometry import NavState, Trajectory
from slam_graph.loop_closure import Keyframe, KeyframeLog, Loop, close_loops
from slam_graph.maps import MapLocalizer, MapRecording, SlamMap, build_map
from slam_graph.pipeline.stage import COMPLETED, EstimatedFrame, Stage, warn_on_failure
from slam_graph.pose_graph import Poses
from slam_graph.results import RunInput, RunResult
from slam_graph.sensors import FeatureFrame

NOT_RECOGNISABLE = "nothing to recognise places by: no images, and tracks without descriptors"

_REMEDY = (
    "run on images, or on tracks that were recorded with descriptors (of a simulation: "
    "slam-graph simulate … --set tracks.descriptors=true)"
)

logger = logging.getLogger(__name__)


def require_places(sequence: Sequence, asked: RunInput, known_map: SlamMap | None) -> None:
    """Make sure that places can be recognised where a map is to be saved or to be used.

    Args:
        sequence: the recording; its first features are looked at if it has no images.
        asked: which part of it, and the settings.
        known_map: the map to be located in, if there is one.

    Raises:
        DataError: if they cannot.
    """
    wanted = asked.config.map.enabled or known_map is not None
    if wanted and not asked.rig.has_scale:
        raise DataError(
            f"{asked.info.name}: one camera without an IMU does not know the scale, and maps are "
            "in metres; add a second camera, depth or an IMU, or leave out the map"
        )
    if not wanted or asked.info.content != "tracks":
        return
    counts = sequence.diagnostics.counts.copy()
    packets = sequence.packets(asked.start_ns, asked.end_ns)
    seen = (p.frame.cameras[0] for p in packets if isinstance(p.frame, FeatureFrame))
    first = next((features for features in seen if len(features)), None)
    sequence.diagnostics.counts = counts  # the run reads the same packets again
    if first is not None and first.descriptors is None:
        purpose = "make a map" if known_map is None else "be located in a map"
        raise DataError(f"{asked.info.name}: cannot {purpose}, {NOT_RECOGNISABLE}; {_REMEDY}")


class Keyframes(Stage):
    """Collects the keyframes that loop closure and map need, with their descriptors.

    Args:
        result: of the run.

    Attributes:
        seconds: that collecting them took.
    """

    def __init__(self, result: RunResult) -> None:
        self.seconds = 0.0
        self._result = result
        self._log = KeyframeLog(result.causal_rig, result.config.loop_closure.keyframes)

    def frame(self, frame: EstimatedFrame) -> None:
        """Take a frame, if there is an estimate."""
        if frame.restarted:
            self._restart(frame.world_motion, frame.world_scale)
        state = frame.state
        if state is None or frame.waits:
            return
        began = time.perf_counter()
        # the state's time is on the IMU's clock, also where the camera's time offset is estimated
        features = FeatureFrame(state.stamp_ns, frame.features.cameras)
        self._log.rig = self._result.estimated_rig
        self._log.add(features, state.world_T_body, frame.image)
        self.seconds += time.perf_counter() - began

    def _restart(self, motion: gtsam.Pose3 | None, scale: float) -> None:
        """Keep the keyframes of segments that have ended, and forget those after them.

        Args:
            motion: new_T_old of the worlds, if those after them have moved instead.
            scale: by which they were scaled before.
        """
        result, earlier, good_ns = self._result, self._log.keyframes, self._result.segments.ended_ns
        if motion is not None:
            self._log.move(motion, good_ns, scale)
            return
        self._log = KeyframeLog(result.causal_rig, result.config.loop_closure.keyframes)
        if good_ns is not None:
            self._log.keyframes += [k for k in earlier if k.stamp_ns <= good_ns]

    @property
    def found(self) -> list[Keyframe]:
        """All keyframes so far, with causal poses."""
        return self._log.keyframes

    def at(self, trajectory: Trajectory) -> list[Keyframe]:
        """All keyframes so far, with the poses of a trajectory where it has them."""
        return self._log.at(trajectory)


class LoopClosing(Stage):
    """Closes the loops of a run; the causal and the smoothed trajectory stay as they are.

    Args:
        result: of the run; it is given the loop closures.
        keyframes: collected on the way.
        diagnostics: counts what goes wrong.
    """

    def __init__(self, result: RunResult, keyframes: Keyframes, diagnostics: Diagnostics) -> None:
        self._result, self._keyframes, self._diagnostics = result, keyframes, diagnostics

    def finish(self) -> None:
        """Close the loops, starting from the best trajectory so far."""
        result = self._result
        if result.status not in COMPLETED:
            return
        if not self._keyframes.found:
            self._diagnostics.warn("loop_closure_impossible", NOT_RECOGNISABLE)
            return
        began = time.perf_counter()
        with warn_on_failure(self._diagnostics, "loop_closure_failed", "no loops are closed"):
            closures = close_loops(
                self._keyframes.at(result.best_trajectory),
                result.estimated_rig,
                result.config.loop_closure,
                result.config.seed,
                self._diagnostics,
                result.segments.later,
            )
            for segment, joint in zip(result.segments.later, closures.joints, strict=False):
                segment.place_joint = joint
            for segment in result.segments.later:
                segment.loops = closures.across(segment.begin_ns, segment.end_ns)
            logger.info(
                "loop closure: %d keyframes, %d loop closures, %d accepted, %.1f s in all",
                len(self._keyframes.found),
                len(closures.loops),
                closures.accepted.sum(),
                self._keyframes.seconds + time.perf_counter() - began,
            )
            result.loops = closures


class MapBuilding(Stage):
    """Builds the map of a run.

    Args:
        result: of the run; it is given the map.
        keyframes: collected on the way.
        diagnostics: counts what goes wrong.
    """

    def __init__(self, result: RunResult, keyframes: Keyframes, diagnostics: Diagnostics) -> None:
        self._result, self._keyframes, self._diagnostics = result, keyframes, diagnostics

    def finish(self) -> None:
        """Build the map. A run that was to leave one and could not has failed, and says why."""
        if self._result.status not in COMPLETED:
            return
        reason = "what went wrong is counted as `map_failed`"
        if not self._keyframes.found:
            self._diagnostics.warn("map_impossible", NOT_RECOGNISABLE)
            reason = NOT_RECOGNISABLE
        else:
            with warn_on_failure(self._diagnostics, "map_failed", "no map is built"):
                self._result.slam_map = made = _build(self._result, self._keyframes)
                logger.info("map: %d keyframes, %d features", len(made), len(made.points))
        ending = self._result.ending
        if self._result.slam_map is None and ending.status == "ok":
            ending.status, ending.message = "no_map", f"no map was made: {reason}"


def _build(result: RunResult, keyframes: Keyframes) -> SlamMap:
    """The map of the keyframes at their best poses.

    After accepted loop closures these are the corrected poses, else the smoothed ones, else the
    causal ones.
    """
    config, loops = result.config, _accepted_loops(result)
    recording = MapRecording(result.input.info.name, "causal", result.estimated_rig)
    if loops and result.loops is not None:
        recording, poses = replace(recording, poses="loop_closed"), result.loops.poses
    elif result.final_ba is not None:
        recording = replace(recording, poses="smoothed")
        poses = _poses(keyframes.at(result.final_ba.trajectory))
    else:
        poses = _poses(keyframes.found)
    return build_map(keyframes.found, poses, recording, loops, config.loop_closure, config.seed)


def _poses(keyframes: list[Keyframe]) -> Poses:
    """(K,) world_T_body of keyframes."""
    return Poses.from_gtsam([k.world_T_body for k in keyframes])


def _accepted_loops(result: RunResult) -> list[Loop]:
    if result.loops is None:
        return []
    pairs = zip(result.loops.loops, result.loops.accepted.tolist(), strict=True)
    return [loop for loop, accepted in pairs if accepted]


class Localization(Stage):
    """Locates a run in a map while it goes on.

    Args:
        result: of the run; it is given the poses in the map.
        known: the map.
        diagnostics: counts what goes wrong.
    """

    def __init__(self, result: RunResult, known: SlamMap, diagnostics: Diagnostics) -> None:
        loops, self._result = result.config.loop_closure, result
        camera = result.input.rig.cameras[0].camera
        self._describer = KeyframeLog.Describer(camera, loops.keyframes.further_corners)
        config, rig = result.config.localization, result.causal_rig
        self._localizer = MapLocalizer(known, rig, loops, config)
        self._name, self._diagnostics = result.input.info.name, diagnostics
        self._log = result.begin_localization(known)
        self._last: deque[tuple[int, gtsam.Pose3]] = deque(maxlen=KeyframeLog.LAST_POSES)

    def frame(self, frame: EstimatedFrame) -> None:
        """Take a frame, if there is an estimate.

        Raises:
            DataError: if the run has descriptors of another kind than the map.
        """
        if frame.restarted:
            self._localizer.restart(self._result.causal_rig)
            self._last.clear()
        state = frame.state
        if state is None or frame.waits:
            return
        began = time.perf_counter()
        localizer = self._localizer
        self._last.append((state.stamp_ns, state.world_T_body))
        localizer.move(state.stamp_ns, state.world_T_body)
        if localizer.wants(state.stamp_ns):
            view = self._view(frame, state)
            if view is not None:
                localizer.places.check(view.descriptors, self._name)
                try:
                    localizer.match(view)
                except (cv2.error, np.linalg.LinAlgError) as error:
                    reason = " ".join(str(error).split())[:200]
                    self._diagnostics.warn("localization_query_failed", reason)
        known = localizer.filter
        if known is None:
            self._log.append(state.stamp_ns, localizer.located)
        else:
            self._log.append(state.stamp_ns, localizer.located, known.pose, known.position_sigma)
        self._log.seconds += time.perf_counter() - began

    def _view(self, frame: EstimatedFrame, state: NavState) -> Keyframe | None:
        """What the first camera sees, with descriptors; None if it has none."""
        seen = frame.features.cameras[0]
        if frame.image is not None:
            seen = self._describer.describe(frame.image, seen)
        if seen.descriptors is None or len(seen) == 0:
            return None
        unknown = np.full((len(seen), 3), np.nan)
        rig = self._result.estimated_rig
        features = FeatureFrame(state.stamp_ns, frame.features.cameras)
        posed = PosedFrame.of(features, tuple(self._last), rig)
        return Keyframe(
            state.stamp_ns,
            state.world_T_body,
            seen.ids,
            posed.unrolled(seen, unknown, rig),
            seen.descriptors,
            unknown,
        )

    def finish(self) -> None:
        """Count the comparisons, and say how much was located."""
        log = self._log
        names = ("queries", "matches", "accepted", "starts")
        log.count(**{name: getattr(self._localizer, name) for name in names})
        if len(log.located) and log.counts["queries"] == 0:
            self._diagnostics.warn(
                "localization_impossible",
                "nothing to recognise places by: no images, and tracks without descriptors",
            )
        located = int(log.located.sum())
        logger.info("located in the map: %d of %d frames", located, len(log.located))
