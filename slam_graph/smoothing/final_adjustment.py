# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A whole recording as one bundle adjustment, or as several that overlap where it is long.

Without loop closures what a piece says of its inside hardly depends on what is far outside. So a
long recording is solved in pieces, and each is laid on the one before, at a keyframe in the middle
of what both share: position and yaw, which no piece knows of itself, are taken over from there.
"""

from __future__ import annotations

import logging
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.errors import EstimationError
from slam_graph.geometry.trajectory import NavState, StateHistory, Trajectory
from slam_graph.sensors.imu_buffer import preintegration_params
from slam_graph.sensors.rig import Rig
from slam_graph.smoothing.frame_log import FrameLog
from slam_graph.smoothing.keyframe_states import states_at
from slam_graph.smoothing.recording_keyframes import Piece, read_piece
from slam_graph.smoothing.recording_problem import Adjustment, BundleAdjustment
from slam_graph.smoothing.smoothing_config import FinalBaConfig
from slam_graph.smoothing.track_fusion import with_fused_features

logger = logging.getLogger(__name__)


STRIDE, SUPPORT = 10, 40
"""Keyframes that the estimate is led back over at a time, and how many more help with it."""
MIN_KEYFRAMES = 3
MIN_OBSERVATIONS_PER_KEYFRAME = 2.0
MAX_PIXEL_RESIDUAL = 3.0
"""Root mean square of what is left of the observations, in σ, beyond which they do not fit."""

Report = Callable[[int, int, int], None]
"""Is told after each step: keyframes that are done, all keyframes, steps so far."""


class UndeterminedError(EstimationError):
    """Images say too little to improve on the causal estimate: nothing moves, or is seen."""


@dataclass(frozen=True, slots=True)
class FinalBaSummary:
    """What the bundle adjustment over a whole recording took.

    Attributes:
        pieces: in which the recording was solved.
        frames: number of poses.
        keyframes: number of keyframes, counted once for each piece.
        features: number of features in the costs.
        observations: number of observations in the costs.
        iterations: Levenberg-Marquardt steps.
        cost_before: of all observations, where the adjustment of all keyframes began.
        cost_after: without outliers, at the minimum.
        imu_residual: root mean square of the whitened residuals of the IMU.
        pixel_residual: of the observations.
        pixel_sigma: standard deviation of these that was assumed at the end.
        seconds: wall time.
        cpu_seconds: time of this process on its processors.
    """

    pieces: int
    frames: int
    keyframes: int
    features: int
    observations: int
    iterations: int
    cost_before: float
    cost_after: float
    imu_residual: float
    pixel_residual: float
    pixel_sigma: float
    seconds: float
    cpu_seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class FinalBa:
    """The best trajectory of a recording.

    Attributes:
        trajectory: of all its frames, with velocities and biases.
        summary: what it took.
    """

    trajectory: Trajectory
    summary: FinalBaSummary


def adjust_recording(
    log: FrameLog,
    causal: Trajectory,
    rig: Rig,
    backend: BackendConfig,
    config: FinalBaConfig,
    report: Report,
) -> FinalBa:
    """Solve a recording as a whole.

    Args:
        log: all its frames.
        causal: the estimate to begin with, with velocities and biases, on the clock of the IMU. Its
            first pose keeps its position and yaw, so that both live in one world.
        rig: the best calibration there is.
        backend: noise and triangulation.
        config: how to solve.
        report: is told of each step.

    Raises:
        UndeterminedError: if there is nothing to gain.
        EstimationError: if the minimum does not fit the images.
    """
    began = (time.perf_counter(), time.process_time())
    keyframes = log.keyframes
    if len(keyframes) < MIN_KEYFRAMES or len(causal) == 0:
        raise UndeterminedError(f"{len(keyframes)} keyframes are too few")
    params = preintegration_params(rig.imu, backend.noise.gravity)
    causal = led_back(log, causal, rig, backend, config, report)
    parts: list[Trajectory] = []  # final, as compact arrays
    states: list[NavState] = []  # of the last piece, from its anchor on
    solved: list[Adjustment] = []
    for first, stop in pieces(len(keyframes), config):
        piece = read_piece(log, keyframes[first:stop], rig, backend.zero_velocity)
        stamps_ns = piece.keyframe_stamps_ns
        if not _reaches(causal, stamps_ns):
            continue
        start = states_at(causal, stamps_ns, piece.imu, params)
        anchor = int(np.searchsorted(stamps_ns[:-1], causal.stamps_ns[0]))
        begin = 0
        if states:
            anchor = min(config.overlap_keyframes // 2, len(stamps_ns) - 1)
            begin = int(piece.keyframes[anchor])
            joint = bisect_left(states, stamps_ns[anchor], key=_stamp_ns)
            parts.append(_trajectory(states[:joint]))
            start = laid_on(start, start[anchor], states[joint])
        steps = sum(part.iterations for part in solved)
        told = _told_of_all(report, first, len(keyframes), steps)
        adjusted = _adjusted(piece, start, anchor, rig, backend, config, told)
        states = adjusted.states[begin:]
        solved.append(replace(adjusted, states=[]))
    if not solved:
        raise EstimationError("the causal estimate reaches none of the keyframes")
    trajectory = _joined([*parts, _trajectory(states)])
    return FinalBa(trajectory, _summary(solved, len(trajectory), began))


def _adjusted(
    piece: Piece,
    start: list[NavState],
    anchor: int,
    rig: Rig,
    backend: BackendConfig,
    config: FinalBaConfig,
    told: Callable[[int], None],
) -> Adjustment:
    """The minimum of a piece: with fused features, or if there is none, with those that it has."""
    if config.fuse_features:
        try:
            fused, states, steps = with_fused_features(
                piece, start, anchor, rig, backend, config, told
            )
            further = BundleAdjustment(
                fused, states, anchor, rig, backend, config, lambda step: told(steps + step)
            )
            solved = further.solve()
            _check(solved)
            return replace(solved, iterations=solved.iterations + steps)
        except UndeterminedError:
            raise
        except (EstimationError, RuntimeError, np.linalg.LinAlgError) as error:
            logger.warning("no features are fused: %s", " ".join(str(error).split())[:200])
    solved = BundleAdjustment(piece, start, anchor, rig, backend, config, told).solve()
    _check(solved)
    return solved


def led_back(
    log: FrameLog,
    causal: Trajectory,
    rig: Rig,
    backend: BackendConfig,
    config: FinalBaConfig,
    report: Report,
) -> Trajectory:
    """A trajectory with an estimate of the time before it began.

    The IMU alone leads back a few seconds, no more. So that is done in strides, each with a bundle
    adjustment of the frames around it, up to a stride from the first frame.
    """
    keyframes, params = log.keyframes, preintegration_params(rig.imu, backend.noise.gravity)
    stamps_ns = log.frames_ns[keyframes] + round(rig.cameras[0].time_offset_s * 1e9)
    while (before := int(np.searchsorted(stamps_ns, causal.stamps_ns[0]))) > STRIDE:
        first = before - STRIDE
        piece = read_piece(log, keyframes[first : before + SUPPORT], rig, backend.zero_velocity)
        known = piece.keyframe_stamps_ns
        if not _reaches(causal, known):
            break
        start = states_at(causal, known, piece.imu, params)
        anchor = min(STRIDE, len(known) - 1)
        told = _told_of_all(report, 0, len(keyframes), 0)
        solved = BundleAdjustment(piece, start, anchor, rig, backend, config, told).solve()
        _check(solved)
        earlier = [s for s in solved.states if s.stamp_ns < causal.stamps_ns[0]]
        causal = _joined([_trajectory(earlier), causal])
    return causal


def pieces(keyframes: int, config: FinalBaConfig) -> Iterator[tuple[int, int]]:
    """First keyframe of each piece, and the one behind its last."""
    step = max(config.max_keyframes - config.overlap_keyframes, 1)
    first = 0
    while True:
        stop = min(first + config.max_keyframes, keyframes)
        yield first, stop
        if stop == keyframes:
            return
        first += step


def laid_on(states: list[NavState], moving: NavState, fixed: NavState) -> list[NavState]:
    """States moved by the translation and yaw that take `moving` to `fixed`."""
    turn = fixed.world_T_body.rotation().compose(moving.world_T_body.rotation().inverse())
    yaw = gtsam.Rot3.Yaw(turn.yaw())
    shift = fixed.world_T_body.translation() - yaw.rotate(moving.world_T_body.translation())
    move = gtsam.Pose3(yaw, shift)
    return [
        replace(
            state,
            world_T_body=move.compose(state.world_T_body),
            velocity=np.asarray(yaw.rotate(state.velocity)),
        )
        for state in states
    ]


def _told_of_all(report: Report, done: int, keyframes: int, steps: int) -> Callable[[int], None]:
    """Tells of the steps of a piece as of those of the whole."""
    return lambda step: report(done, keyframes, steps + step)


def _stamp_ns(state: NavState) -> int:
    return state.stamp_ns


def _reaches(causal: Trajectory, stamps_ns: IntArray) -> bool:
    """Whether there is a causal estimate at any of some times."""
    return bool(np.any((stamps_ns >= causal.stamps_ns[0]) & (stamps_ns <= causal.stamps_ns[-1])))


def _check(solved: Adjustment) -> None:
    """Refuse what the images do not confirm."""
    if solved.observations < MIN_OBSERVATIONS_PER_KEYFRAME * solved.keyframes:
        raise UndeterminedError(
            f"{solved.observations} observations in {solved.keyframes} keyframes are too few"
        )
    if not solved.pixel_residual < MAX_PIXEL_RESIDUAL:
        raise EstimationError(f"images do not fit: {solved.pixel_residual:.1f} σ are left")
    if not all(np.isfinite(state.world_T_body.matrix()).all() for state in solved.states):
        raise EstimationError("a pose is not finite")


def _trajectory(states: list[NavState]) -> Trajectory:
    history = StateHistory()
    for state in states:
        history.append(state)
    return history.trajectory()


def _joined(parts: list[Trajectory]) -> Trajectory:
    """Trajectories with velocities and biases, one after the other."""
    names = ("stamps_ns", "positions", "quaternions", "velocities", "accel_biases", "gyro_biases")
    return Trajectory(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    )


def _summary(solved: list[Adjustment], frames: int, began: tuple[float, float]) -> FinalBaSummary:
    """The sum of all pieces."""

    def total(name: str) -> int:
        return sum(getattr(part, name) for part in solved)

    def rms(name: str, weight: str) -> float:
        weights = [getattr(part, weight) for part in solved]
        squares = [getattr(part, name) ** 2 for part in solved]
        return float(np.sqrt(np.average(squares, weights=weights)))

    return FinalBaSummary(
        len(solved),
        frames,
        total("keyframes"),
        total("features"),
        total("observations"),
        total("iterations"),
        sum(part.cost_before for part in solved),
        sum(part.cost_after for part in solved),
        rms("imu_residual", "keyframes"),
        rms("pixel_residual", "observations"),
        rms("pixel_sigma", "observations"),
        time.perf_counter() - began[0],
        time.process_time() - began[1],
    )
