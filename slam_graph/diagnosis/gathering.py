# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis looks at: the IMU as a whole, and a few parts with tracks and images.

A recording of any length takes a bounded time: of a long one, the parts are those in which the
platform turns most, because rotation shows clocks, mounting and focal length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets import RecordedSequence
from slam_graph.diagnosis.image_quality import ImageSurvey
from slam_graph.diagnosis.stereo_matching import StereoMatches, match_images
from slam_graph.diagnostics import Diagnostics
from slam_graph.frontend import FrontendConfig, build_frontend
from slam_graph.sensors import CameraFrame, FeatureFrame, ImuData, Rig

PART_S = 8.0
"""Length of a part."""
_PARTS = 3
"""Most parts."""
_STEREO_EVERY_S = 2.5
"""Time between two pairs of images that are matched."""
_MARGIN_NS = 300_000_000
"""IMU samples around a part that are kept with it: more than a time offset."""

_PAUSE_NS, _GAP_NS = 500_000_000, 200_000_000
"""Nothing is compared across longer times without frames, and without samples."""
_PAUSE_FRAMES = 3.0
"""With a slow camera the first of them is so many times that from frame to frame."""

_FEWEST_SAMPLES, _FEWEST_FRAMES = 50, 11
"""Samples and frames that a comparison needs at least."""

_MATCHED_FRAMES = 3
"""The second camera is looked at in every third frame."""

_TRACKING = FrontendConfig(prediction="flow", max_features=150)
"""Neither gyroscope nor mounting may take part in the tracks that are to check them."""


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a recording.

    Attributes:
        frames: features of its frames.
        imu: samples around it, as they were recorded.
    """

    frames: list[FeatureFrame]
    imu: ImuData


@dataclass(eq=False)
class Material:
    """What a diagnosis looks at.

    Attributes:
        rig: the calibration.
        imu: all samples.
        parts: with frames.
        stereo: matches of the first two cameras, found without their calibration.
        images: their quality; None for tracks.
        faults: what the reader counted, by kind.
        lost: times in which an estimate was lost, from the last good state to where that was
            noticed, ns.
    """

    rig: Rig
    imu: ImuData
    parts: list[Part]
    stereo: list[StereoMatches] = field(default_factory=list)
    images: ImageSurvey | None = None
    faults: dict[str, int] = field(default_factory=dict)
    lost: Sequence[tuple[int, int]] = ()

    @property
    def stamps_ns(self) -> list[IntArray]:
        """Times of the frames of each part."""
        return [np.array([f.stamp_ns for f in part.frames], np.int64) for part in self.parts]


def gather(recording: RecordedSequence, tracked: bool = True) -> Material:
    """Read what a diagnosis needs.

    Args:
        recording: images or tracks, with or without an IMU.
        tracked: whether to track features and match cameras; otherwise images are only looked at.
    """
    before = dict(recording.diagnostics.counts)
    imu = recording.imu() if recording.has_imu else ImuData.empty()
    info = recording.info()
    images = ImageSurvey(len(recording.rig.cameras)) if info.content == "images" else None
    found = Material(recording.rig, imu, [], images=images)
    for start_ns, end_ns in chosen_parts(info.start_ns, info.end_ns, imu):
        frames = _part(recording, start_ns, end_ns, found, tracked)
        if frames:
            found.parts.append(Part(frames, around(imu, start_ns, end_ns)))
    counts = recording.diagnostics.counts
    found.faults = {k: n - before.get(k, 0) for k, n in counts.items() if n > before.get(k, 0)}
    return found


def around(imu: ImuData, start_ns: int, end_ns: int) -> ImuData:
    """The samples from a little before the start to a little after the end."""
    rows = np.searchsorted(imu.stamps_ns, [start_ns - _MARGIN_NS, end_ns + _MARGIN_NS])
    return imu[rows[0] : rows[1]]


def uninterrupted(part: Part, lost: Sequence[tuple[int, int]] = ()) -> list[Part]:
    """The pieces of a part between its gaps, without what is inside of the times that were lost.

    In these the platform may have been put somewhere else, which no sensor measures.

    Args:
        part: with frames.
        lost: beginnings and ends of such times, ns, in their order.
    """
    frames, samples = part.frames, part.imu.stamps_ns
    frames = [f for f in frames if not any(begin < f.stamp_ns < end for begin, end in lost)]
    stamps = np.array([frame.stamp_ns for frame in frames], np.int64)
    begins = samples[1:][np.diff(samples) > _GAP_NS]
    stretch = np.searchsorted(begins, stamps, side="right")
    ends = np.array([end for _, end in lost], np.int64)
    piece = stretch + np.searchsorted(ends, stamps, side="right")
    spacing = np.diff(stamps)
    if len(spacing):
        pause_ns = max(_PAUSE_NS, _PAUSE_FRAMES * float(np.median(spacing)))
        piece[1:] += np.cumsum(spacing > pause_ns)
    of_sample = np.searchsorted(begins, samples, side="right")
    pieces = []
    for k in np.unique(piece):
        rows = np.flatnonzero(piece == k)
        inside = of_sample == stretch[rows[0]]
        imu = ImuData(samples[inside], part.imu.gyro[inside], part.imu.accel[inside])
        imu = around(imu, int(stamps[rows[0]]), int(stamps[rows[-1]]))
        pieces.append(Part([frames[row] for row in rows], imu))
    return pieces


def finite(imu: ImuData, factor: float = 1.0) -> ImuData:
    """The samples that are finite, with a factor on the specific forces."""
    good = np.isfinite(imu.gyro).all(axis=1) & np.isfinite(imu.accel).all(axis=1)
    return ImuData(imu.stamps_ns[good], imu.gyro[good], factor * imu.accel[good])


def long_enough(pieces: Iterable[Part]) -> list[Part]:
    """The pieces with enough frames and samples to be compared."""
    return [p for p in pieces if len(p.imu) >= _FEWEST_SAMPLES and len(p.frames) >= _FEWEST_FRAMES]


def chosen_parts(start_ns: int, end_ns: int, imu: ImuData) -> list[tuple[int, int]]:
    """Beginning and end of the parts to look at: all of a short recording, else where it turns."""
    length_ns = round(PART_S * 1e9)
    if end_ns - start_ns <= _PARTS * length_ns:
        return [(start_ns, end_ns)]
    begins = np.arange(start_ns, end_ns - length_ns, length_ns, dtype=np.int64)
    activity = np.array([_activity(imu, int(b), int(b) + length_ns) for b in begins])
    chosen = np.sort(begins[np.argsort(-activity, kind="stable")[:_PARTS]])
    return [(int(begin), int(begin) + length_ns) for begin in chosen]


def _activity(imu: ImuData, start_ns: int, end_ns: int) -> float:
    """How much the body turns about its least turned axis; zero without samples."""
    rows = np.searchsorted(imu.stamps_ns, [start_ns, end_ns])
    rates: FloatArray = imu.gyro[rows[0] : rows[1]]
    if len(rates) < 10:
        return 0.0
    spread = np.linalg.eigvalsh(np.cov(rates.T))
    return float(np.sqrt(max(spread[0], 0.0)) + 0.3 * np.sqrt(spread[1]))


def _part(
    recording: RecordedSequence, start_ns: int, end_ns: int, found: Material, tracked: bool
) -> list[FeatureFrame]:
    """The features of a part; its images and stereo matches are added to what was found."""
    track = _tracker(found.rig) if tracked else None
    frames: list[FeatureFrame] = []
    matched_ns = 0
    for frame in recording.frames(start_ns, end_ns):
        due = tracked and frame.stamp_ns - matched_ns >= _STEREO_EVERY_S * 1e9
        if isinstance(frame, FeatureFrame):
            frames.append(frame.usable(len(found.rig.cameras))[0])
            if due and len(found.rig.cameras) > 1:
                found.stereo.append(StereoMatches.of_tracks(frames[-1]))
                matched_ns = frame.stamp_ns
            continue
        if found.images is not None:
            found.images.add(frame)
        frames.append(FeatureFrame(frame.stamp_ns, ()) if track is None else track(frame))
        pair = frame.images[:2]
        if due and len(pair) == 2 and pair[0] is not None and pair[1] is not None:
            found.stereo.append(match_images(frame.stamp_ns, pair[0], pair[1]))
            matched_ns = frame.stamp_ns
    return frames


def _tracker(rig: Rig) -> Callable[[CameraFrame], FeatureFrame]:
    """Tracks the features of the first camera, and finds them in the second now and then."""
    cameras = min(len(rig.cameras), 2)
    frontend = build_frontend(rig.select(cameras), _TRACKING, diagnostics=Diagnostics())
    count = 0

    def track(frame: CameraFrame) -> FeatureFrame:
        nonlocal count
        images = frame.images[:1]
        if cameras == 2:
            images += (frame.images[1] if count % _MATCHED_FRAMES == 0 else None,)
        count += 1
        return frontend.track(CameraFrame(frame.stamp_ns, images))

    return track
