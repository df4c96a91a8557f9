# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Any recording of images as an EuRoC folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slam_graph.datasets.formats.euroc_writer import EurocWriter
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.errors import DataError
from slam_graph.sensors.measurements import CameraFrame

Progress = Callable[[int], None]
"""Is told the time of every frame that was written."""


def convert_to_euroc(
    sequence: RecordedSequence, path: Path, force: bool = False, progress: Progress | None = None
) -> None:
    """Write a recording to a new EuRoC folder, whole or not at all.

    Images become 8 bit grey PNG with the stamp of their frame, samples of the IMU what remains of
    them when they are cleaned. Images that are missing or damaged are left out; they are counted by
    the sequence as usual.

    Args:
        sequence: any recording of images; without an IMU there is no ``imu0`` in the folder.
        path: the new folder.
        force: replace an EuRoC folder that is there already.
        progress: is told the time of every frame that was written.

    Raises:
        DataError: if the recording holds no images, or the folder exists already.
    """
    info = sequence.info()
    if info.content == "tracks":
        raise DataError(
            f"{info.name}: format '{info.format}' holds feature tracks, no images; copy it as it "
            "is, or write tracks with slam_graph.datasets.formats.track_recording.TrackRecorder"
        )
    seconds = max((info.end_ns - info.start_ns) * 1e-9, 1e-9)
    rate_hz = round((info.frames - 1) / seconds, 3)
    comment = f"converted from {info.format}"
    truth, has_imu = sequence.groundtruth(), sequence.has_imu
    with EurocWriter(path, sequence.rig, truth, comment, rate_hz, force, has_imu) as writer:
        for block in sequence.imu_blocks():
            writer.write_imu(block)
        for frame in sequence.frames():
            if not isinstance(frame, CameraFrame):
                raise DataError(f"{info.name}: frame at {frame.stamp_ns} holds no images")
            writer.write_frame(frame)
            if progress is not None:
                progress(frame.stamp_ns)
