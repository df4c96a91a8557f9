# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Starts from any second of flights with a real IMU: how soon, how accurate, how honest.

From every chosen time of a flight an estimator is given frames and IMU until it has a state, and
then for one second more. Counted from the moment at which the motion shows what a start needs, the
state must be there within two seconds (one with stereo), and be right one second later.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.flights import FLIGHTS, KIND, flight_is_held_out, flown_by_camera, in_parallel
from benchmarks.metric import EXACT, Metric, info
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from benchmarks.suite import Benchmark, Outcome
from slam_graph.arrays import skew
from slam_graph.backend import Estimator
from slam_graph.backend.cost.triangulation import triangulate_frames
from slam_graph.config import RunConfig, load_config
from slam_graph.geometry import NavState, Trajectory
from slam_graph.sensors import FeatureFrame, ImuData, Packet, Rig

SPACING_S, PATIENCE_S, JUDGED_AFTER_S = 2.0, 8.0, 1.0
"""Time between starts; how long one may take; and when after it the state is judged."""

LATENCY_S = {1: 2.0, 2: 1.0}
VELOCITY, GRAVITY_DEG, SCALE = 0.1, 1.5, 0.05
"""Bars: latency by number of cameras; errors of velocity (m/s), gravity, and scale."""

CHI2 = (14.16, 11.83)
"""3σ (0.27 %) of χ² with the three degrees of freedom of the velocity and the two of gravity."""

WINDOW_S, ACCELERATED_M, MOVED_M, STILL_M = 1.0, 0.03, 0.05, 0.002
"""Over this time, motion is observed if the path leaves a straight and even one by so much (one
camera: the scale follows from acceleration), or if it is as long as this (stereo); or if it stays
within this, which is a start at rest."""

SCALE_NEEDS = 5
"""Scale is judged by the median of at least so many distances to features."""

BARS = {"good": 0.95, "wrong": 0.005}


@dataclass(frozen=True, slots=True)
class Start:
    """What came of one start.

    Attributes:
        begun_s: where in the flight it was tried.
        latency_s: from when motion was observed to the state; NaN if it never came.
        velocity, gravity_deg, scale: errors one second later; scale NaN if too few features tell.
        chi2: normalised squared errors of velocity and gravity.
        reason: what the estimator waited for, if it did not start.
        cpu_ms: mean CPU time of a frame without a state.
    """

    begun_s: float
    latency_s: float
    velocity: float
    gravity_deg: float
    scale: float
    chi2: tuple[float, float]
    reason: str
    cpu_ms: float

    @property
    def started(self) -> bool:
        """Whether there was a state in time to be judged."""
        return bool(np.isfinite(self.velocity))

    @property
    def right(self) -> bool:
        """Whether the state was as accurate as it must be."""
        errors = (self.velocity / VELOCITY, self.gravity_deg / GRAVITY_DEG, self.scale / SCALE)
        return self.started and bool(np.nanmax(errors) <= 1.0)

    @property
    def wrong(self) -> bool:
        """Whether the state contradicts its own covariance."""
        return self.started and any(x > bar for x, bar in zip(self.chi2, CHI2, strict=True))


def measure(data: Path, spacing_s: float = SPACING_S) -> Outcome:
    """Starts from all flights, with one camera and two, and two levels of noise.

    Args:
        data: folder of recordings.
        spacing_s: time between the starts of a flight.
    """
    outcome = Outcome()
    tasks = [
        (data / flight, cameras, sigma, spacing_s)
        for flight in FLIGHTS
        for cameras in (1, 2)
        for sigma in (1.0, 0.5)
    ]
    found = in_parallel(starts_of, tasks)
    together: dict[tuple[int, bool], list[Start]] = {}
    for (path, cameras, sigma, _), starts in zip(tasks, found, strict=True):
        held_out = flight_is_held_out(path)
        name = f"{path.name}.{KIND[cameras]}_{sigma:g}px"
        outcome.add(name, figures_of(starts, cameras), judged=False, held_out=held_out)
        together.setdefault((cameras, held_out), []).extend(starts)
    add_together(outcome, together)
    return outcome


def add_together(outcome: Outcome, together: dict[tuple[int, bool], list[Start]]) -> None:
    """Add the figures of all flights, by number of cameras and whether they are held out."""
    for (cameras, held_out), starts in sorted(together.items()):
        name = f"{'held_out' if held_out else 'chosen_on'}.{KIND[cameras]}"
        outcome.add(name, figures_of(starts, cameras), held_out=held_out)
        reasons = Counter(start.reason for start in starts if not start.started)
        for reason, count in reasons.most_common(5):
            outcome.notes.append(f"{name}: {count} of {len(starts)} waited for {reason}")


def starts_of(path: Path, cameras: int, pixel_sigma: float, spacing_s: float) -> list[Start]:
    """Every start of one flight; frames are simulated once."""
    sequence = flown_by_camera(path, cameras, FIRST_HELD_OUT_SEED, pixel_sigma)
    config = load_config(
        algorithm="msckf",
        overrides=[f"backend.noise.pixel_sigma={pixel_sigma:g}"],
    )
    packets, truth = list(sequence.packets()), sequence.groundtruth()
    rows = rows_of_starts(packets, cameras, spacing_s)
    return [start(sequence.rig, config, packets_from(packets, row), truth) for row in rows]


def rows_of_starts(packets: list[Packet], cameras: int, spacing_s: float) -> list[int]:
    """Which packets of a flight are the first ones of a start."""
    stamps = np.array([packet.frame.stamp_ns for packet in packets])
    last = stamps[-1] - round((JUDGED_AFTER_S + LATENCY_S[cameras]) * 1e9)
    begun = np.arange(stamps[0], last, round(spacing_s * 1e9))
    return [int(row) for row in np.searchsorted(stamps, begun)]


def packets_from(packets: list[Packet], row: int) -> Iterator[Packet]:
    """The packets from a row on; the first one has the samples since the frame before, too."""
    since = max(0, row - 1)
    imu = ImuData.concatenate([packet.imu for packet in packets[since : row + 1]])
    yield replace(packets[row], imu=imu)
    yield from packets[row + 1 :]


def figures_of(starts: list[Start], cameras: int) -> Iterator[Metric]:
    """Shares and errors of some starts."""
    in_time = [s.right and s.latency_s <= LATENCY_S[cameras] for s in starts]
    good, wrong = np.mean(in_time), np.mean([s.wrong for s in starts])
    yield Metric("good", float(good), "share", "higher", BARS["good"], EXACT)
    yield Metric("wrong", float(wrong), "share", "lower", BARS["wrong"], EXACT)
    yield info("started", float(np.mean([s.started for s in starts])), "share")
    yield info(
        "right", float(np.mean([float(s.right) for s in starts if s.started] or [0.0])), "share"
    )
    for name, quantile in (("median", 0.5), ("p95", 0.95)):
        for figure, unit in (
            ("latency_s", "s"),
            ("velocity", "m/s"),
            ("gravity_deg", "deg"),
            ("scale", "share"),
        ):
            values = [getattr(s, figure) for s in starts if s.started]
            yield info(
                f"{figure}_{name}", float(np.nanquantile(values or [np.nan], quantile)), unit
            )
    for column, (name, dof) in enumerate((("velocity", 3), ("gravity", 2))):
        nees = [s.chi2[column] / dof for s in starts if s.started]
        yield info(f"nees_{name}_per_dof", float(np.mean(nees or [np.nan])), "")
    yield info("waiting", float(np.nanmean([s.cpu_ms for s in starts])), "ms CPU")


def start(rig: Rig, config: RunConfig, packets: Iterator[Packet], truth: Trajectory) -> Start:
    """One start.

    Args:
        rig: of the recording.
        config: of the estimator.
        packets: from the first frame of the start on, with features.
        truth: at the frames of the recording.
    """
    cameras = len(rig.cameras)
    estimator = Estimator(rig, config.algorithm, config.backend)
    frames: list[FeatureFrame] = []
    states: list[NavState] = []
    waited_s, observed_ns = [0.0], 0
    for packet in packets:
        assert isinstance(packet.frame, FeatureFrame)
        if not frames:
            observed_ns = _observed_ns(truth, packet.frame.stamp_ns, cameras)
        elif not states and packet.frame.stamp_ns > observed_ns + round(PATIENCE_S * 1e9):
            break
        frames.append(packet.frame)
        began = time.process_time()
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame)
        if state is None:
            waited_s.append(time.process_time() - began)
            continue
        states.append(state)
        if state.stamp_ns - states[0].stamp_ns >= JUDGED_AFTER_S * 1e9:
            break
    begun_s = (frames[0].stamp_ns - int(truth.stamps_ns[0])) * 1e-9
    cpu_ms = 1e3 * sum(waited_s) / max(len(waited_s) - 1, 1)
    if not states or states[-1].stamp_ns - states[0].stamp_ns < JUDGED_AFTER_S * 1e9:
        nothing = (np.nan, np.nan, np.nan, np.nan, (np.nan, np.nan))
        return Start(begun_s, *nothing, reason=estimator.waiting_for, cpu_ms=cpu_ms)
    scale = _scale_error(estimator, states[-1], frames, truth)
    return _judged(states, truth, begun_s, observed_ns, cpu_ms, scale)


def _observed_ns(truth: Trajectory, begun_ns: int, cameras: int) -> int:
    """First time from which on the motion of the last second showed what a start needs."""
    window_ns = round(WINDOW_S * 1e9)
    first = int(np.searchsorted(truth.stamps_ns, begun_ns))
    for row in range(first, len(truth)):
        since_ns = int(truth.stamps_ns[row]) - window_ns
        if since_ns < begun_ns:
            continue
        path = truth.positions[int(np.searchsorted(truth.stamps_ns, since_ns)) : row + 1]
        moved = np.linalg.norm(path - path[0], axis=1)
        even = np.linspace(0.0, 1.0, len(path))[:, None] * (path[-1] - path[0]) + path[0]
        accelerated = np.max(np.linalg.norm(path - even, axis=1))
        enough = accelerated > ACCELERATED_M if cameras == 1 else np.max(moved) > MOVED_M
        if enough or np.max(moved) < STILL_M:
            return int(truth.stamps_ns[row])
    return int(truth.stamps_ns[-1])


def _judged(
    states: list[NavState],
    truth: Trajectory,
    begun_s: float,
    observed_ns: int,
    cpu_ms: float,
    scale: float,
) -> Start:
    """The errors of the last state, in the body frame: heading and position are free."""
    first, last = states[0], states[-1]
    # the truth is given at the frames, so that its rows are those of the states
    end = int(np.searchsorted(truth.stamps_ns, last.stamp_ns - 1_000_000))
    assert truth.velocities is not None
    assert last.covariance is not None
    world_R_body = Rotation.from_quat(truth.quaternions[end])
    R = last.world_T_body.rotation().matrix()
    velocity, up = R.T @ last.velocity, R.T @ np.array([0.0, 0.0, 1.0])
    true_velocity = world_R_body.inv().apply(truth.velocities[end])
    true_up = world_R_body.inv().apply([0.0, 0.0, 1.0])
    P = last.covariance
    turn = np.concatenate([skew(velocity[None])[0], np.zeros((3, 3)), R.T], axis=1)
    error = velocity - true_velocity
    chi2_velocity = float(error @ np.linalg.solve(turn @ P[:9, :9] @ turn.T, error))
    across = np.linalg.svd(up[None, :])[2][1:]  # (2, 3) unit vectors orthogonal to it
    tilt = across @ (up - true_up)
    tilt_jacobian = across @ skew(up[None])[0]
    chi2_tilt = float(tilt @ np.linalg.solve(tilt_jacobian @ P[:3, :3] @ tilt_jacobian.T, tilt))
    return Start(
        begun_s,
        max(0.0, (first.stamp_ns - observed_ns) * 1e-9),
        float(np.linalg.norm(error)),
        float(np.rad2deg(np.arccos(np.clip(up @ true_up, -1.0, 1.0)))),
        scale,
        (chi2_velocity, chi2_tilt),
        "",
        cpu_ms,
    )


def _scale_error(
    estimator: Estimator, state: NavState, frames: list[Any], truth: Trajectory
) -> float:
    """Relative error of the scale: that of the median distance to the features in the map.

    A displacement would not do: where the platform hardly moves, it is that of the velocity.
    """
    ids, points = estimator.landmarks()
    rows = np.searchsorted(truth.stamps_ns, [f.stamp_ns - 1_000_000 for f in frames])
    rotations = Rotation.from_quat(truth.quaternions[rows]).as_matrix()
    positions = truth.positions[rows]
    true = triangulate_frames(ids, frames, rotations, positions, estimator.rig)
    if np.sum(true.good) < SCALE_NEEDS:
        return float("nan")
    here = state.world_T_body.translation()
    distances = np.linalg.norm(points[true.good] - here, axis=1)
    true_distances = np.linalg.norm(true.points[true.good] - positions[-1], axis=1)
    return float(abs(np.median(distances / true_distances) - 1.0))


BENCHMARKS = {
    "starts": Benchmark(
        "starts from every second second of flights with a real IMU: latency, errors, failures",
        FLIGHTS,
        measure,
    )
}
