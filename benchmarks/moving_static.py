# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which tracks move? Answers of `--objects` in simulated stereo against the truth of every track.

EuRoC's cameras at 10 Hz, tracks of 0.5 px, and a box of 1 m that does not turn, about 3.5 m ahead:
its middle follows the path of the cameras and sways. So the speed of a point in the world is that
of both, and is taken from the simulation, track by track. What moves to the side by less than the
least speed counts neither as moving nor as static.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.metric import Metric, info
from benchmarks.suite import Benchmark, Outcome
from slam_graph import run
from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend import Estimator, ObjectFrame
from slam_graph.evaluation.detection import detection
from slam_graph.pipeline.observers import NullViewer
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.sensors import FeatureFrame
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedTracks

ALGORITHM = "msckf"
SEEDS = range(210, 215)
DURATION_S, RATE_HZ, SIGMA_PX = 8.0, 10.0, 0.5
SPEEDS = (0.3, 0.6, 1.2)
"""Largest speeds of the sway, m/s."""
LEAST_SPEED, SLOW = 0.3, 0.6
"""Speeds to the side, m/s: of a track that counts as moving, and up to which it counts as slow."""
WITHIN_S = 0.5
TESTED_FRAMES = 3
"""Shorter tracks are not tested."""
RIGHT_BAR, LOST_BAR = 0.95, 0.01
_STEP_NS = 5_000_000


@dataclass(frozen=True, eq=False)
class TrackTruth:
    """The tracks of the first camera in one frame.

    Attributes:
        stamp_ns: of the frame.
        ids: (N,) ascending.
        on_object: (N,) whether each is on an object.
        sideways: (N,) speed in the world across the ray from the camera, m/s.
    """

    stamp_ns: int
    ids: IntArray
    on_object: BoolArray
    sideways: FloatArray


def simulated(seed: int, speed: float, keep_ids: bool = False) -> SimulatedTracks:
    """A flight behind one object.

    Args:
        seed: of the simulation.
        speed: largest speed of the sway, m/s.
        keep_ids: whether ids are the numbers of landmarks; all else is the same.
    """
    sequence = simulate(
        duration_s=DURATION_S,
        rate_hz=RATE_HZ,
        seed=seed,
        tracks={"pixel_sigma": SIGMA_PX, "keep_ids": keep_ids},
        objects={"count": 1, "motion": "straight", "speed": speed},
    )
    assert isinstance(sequence, SimulatedTracks)
    return sequence


def track_truth(seed: int, speed: float) -> list[TrackTruth]:
    """The truth of the tracks in each frame: the same flight is simulated with known landmarks."""
    known = simulated(seed, speed, keep_ids=True)
    offset_ns = round(known.rig.pose_offset_s * 1e9)
    pairs = zip(simulated(seed, speed).frames(), known.frames(), strict=True)
    return [_truth_of(known, plain, twin, offset_ns) for plain, twin in pairs]


def _truth_of(
    known: SimulatedTracks, plain: FeatureFrame, twin: FeatureFrame, offset_ns: int
) -> TrackTruth:
    """The truth of one frame; `twin` has the numbers of the landmarks of `plain`, row by row."""
    ids, numbers = plain.cameras[0].ids, twin.cameras[0].ids
    now_ns = plain.stamp_ns + offset_ns
    before, here, after = (
        known.landmarks.at(numbers, now_ns + step)[0] for step in (-_STEP_NS, 0, _STEP_NS)
    )
    velocity = (after - before) / (2e-9 * _STEP_NS)
    body = known.groundtruth().at(now_ns)
    camera = body.compose(known.rig.cameras[0].body_T_camera)
    rays = here - camera.translation()
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    across = velocity - np.sum(velocity * rays, axis=1)[:, None] * rays
    order = np.argsort(ids)
    return TrackTruth(
        plain.stamp_ns,
        ids[order],
        known.landmarks.labels(numbers)[order] > 0,
        np.linalg.norm(across, axis=1)[order],
    )


class _Kept(NullViewer):
    """Keeps what was found in each frame."""

    def __init__(self) -> None:
        self.found: list[ObjectFrame] = []

    def show(self, frame: EstimatedFrame, estimator: Estimator) -> None:
        """Keep it."""
        assert frame.objects is not None
        self.found.append(frame.objects)


@dataclass(frozen=True, eq=False)
class Answers:
    """What was said of the tracks of a flight, or of several.

    Attributes:
        seconds: (M,) of each moving track, from when it was seen first until it is called moving;
            infinite if it never was.
        right: (M,) whether it is called moving half a second after it was seen first.
        speeds: (M,) its least speed to the side in this time, m/s.
        lost: (S,) of each static track, whether it was ever called moving.
        probabilities: (T,) of motion, of all tests of tracks that are static or move.
        moves: (T,) the truth.
    """

    seconds: FloatArray
    right: BoolArray
    speeds: FloatArray
    lost: BoolArray
    probabilities: FloatArray
    moves: BoolArray

    @staticmethod
    def joined(parts: list[Answers]) -> Answers:
        """Those of several flights."""
        names = ("seconds", "right", "speeds", "lost", "probabilities", "moves")
        return Answers(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def figures(self) -> list[Metric]:
        """Shares and the area under the ROC."""
        slow = self.speeds < SLOW
        return [
            Metric("right", float(np.mean(self.right)), "", "higher", RIGHT_BAR),
            Metric("lost", float(np.mean(self.lost)), "", "lower", LOST_BAR, tolerance=None),
            Metric("area", detection(self.probabilities, self.moves).area, "", "higher"),
            info("right_slow", float(np.mean(self.right[slow])) if slow.any() else np.nan, ""),
            info("slow_tracks", float(np.count_nonzero(slow)), ""),
            info("moving_tracks", float(len(self.right)), ""),
            info("static_tracks", float(len(self.lost)), ""),
            info("median_delay", float(np.median(self.seconds)), "s"),
        ]


def answers(truth: list[TrackTruth], found: list[ObjectFrame]) -> Answers:
    """Compare what was found in each frame with the truth of the tracks in it."""
    sightings: dict[int, list[tuple[int, bool, float, bool]]] = {}
    probabilities, moves = [], []
    for frame, result in zip(truth, found, strict=True):
        called = np.isin(frame.ids, result.moving)
        columns = (frame.ids, frame.on_object, frame.sideways, called)
        for track, on_object, speed, moving in zip(*(c.tolist() for c in columns), strict=True):
            sightings.setdefault(track, []).append((frame.stamp_ns, on_object, speed, moving))
        _, there, asked = np.intersect1d(frame.ids, result.probabilities[0], return_indices=True)
        counts = ~frame.on_object[there] | (frame.sideways[there] >= LEAST_SPEED)
        probabilities.append(result.probabilities[1][asked][counts])
        moves.append(frame.on_object[there][counts])
    fast: list[tuple[float, bool, float]] = []
    lost: list[bool] = []
    for seen in sightings.values():
        if not seen[0][1]:
            if len(seen) >= TESTED_FRAMES:
                lost.append(any(called for *_, called in seen))
            continue
        track = _moving_track(seen)
        if track is not None:
            fast.append(track)
    seconds, right, speeds = np.array(fast).reshape(-1, 3).T
    return Answers(
        seconds,
        right > 0,
        speeds,
        np.array(lost, bool),
        np.concatenate(probabilities),
        np.concatenate(moves),
    )


def _moving_track(
    seen: list[tuple[int, bool, float, bool]],
) -> tuple[float, bool, float] | None:
    """Delay, answer after half a second and least speed; None if it is too slow or too short."""
    since = [(stamp_ns - seen[0][0]) * 1e-9 for stamp_ns, *_ in seen]
    first = [row for row, age in zip(seen, since, strict=True) if age <= WITHIN_S + 1e-6]
    least = min(speed for _, _, speed, _ in first)
    if since[-1] < WITHIN_S - 1e-6 or least < LEAST_SPEED:
        return None
    delays = [age for age, (*_, called) in zip(since, seen, strict=True) if called]
    return min(delays, default=np.inf), first[-1][3], least


def measure(_: Path) -> Outcome:
    """Figures for each speed, over the seeds."""
    outcome = Outcome()
    for speed in SPEEDS:
        parts = []
        for seed in SEEDS:
            kept = _Kept()
            run(
                simulated(seed, speed),
                algorithm=ALGORITHM,
                viewer=kept,
                overrides={"objects.enabled": True, "backend.noise.pixel_sigma": SIGMA_PX},
                final_ba={"enabled": False},
            )
            parts.append(answers(track_truth(seed, speed), kept.found))
        outcome.add(f"sway_{speed:g}", Answers.joined(parts).figures())
    return outcome


BENCHMARKS = {
    "moving_static": Benchmark(
        "Tracks that move told from static ones, simulated stereo, 5 seeds", (), measure
    ),
}
