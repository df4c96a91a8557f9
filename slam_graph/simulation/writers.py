# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulations as files: a folder of recorded tracks, or an EuRoC (ASL) folder of images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import yaml

from slam_graph.datasets.formats.euroc_writer import EurocWriter
from slam_graph.datasets.formats.track_recorder import TrackRecorder
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame
from slam_graph.simulation.simulated_sequence import (
    SimulatedImages,
    SimulatedSequence,
    SimulatedTracks,
)

SETTINGS = "simulation.yaml"

Progress = Callable[[int], None]
"""Is told the time of every frame that was written."""


def write(sequence: SimulatedSequence, path: Path, progress: Progress | None = None) -> None:
    """Write a simulation to a new folder, whole or not at all, with its settings.

    Tracks become a recording (`datasets/recording_format.py`), images an EuRoC folder.

    Raises:
        DataError: if the folder exists already.
    """
    progress = progress if progress is not None else _ignore
    if isinstance(sequence, SimulatedTracks):
        write_tracks(sequence, path, progress)
    elif isinstance(sequence, SimulatedImages):
        write_euroc(sequence, path, progress)
    settings = sequence.config.model_dump(mode="json")
    (path / SETTINGS).write_text(yaml.safe_dump(settings, sort_keys=False))


def write_tracks(sequence: SimulatedTracks, path: Path, progress: Progress) -> None:
    """Write a recording with calibration, ground truth and start state."""
    recorder = TrackRecorder(
        path, sequence.rig, sequence.name, sequence.groundtruth(), sequence.initial_state()
    )
    with recorder:
        for packet in sequence.packets():
            assert isinstance(packet.frame, FeatureFrame)
            recorder.write(packet.imu, packet.frame)
            progress(packet.frame.stamp_ns)


def write_euroc(sequence: SimulatedImages, path: Path, progress: Progress) -> None:
    """Write an EuRoC folder with ground truth, and the calibration in Kalibr's format beside it."""
    truth, rate_hz = sequence.groundtruth(), sequence.config.rate_hz
    with EurocWriter(path, sequence.rig, truth, "simulated", rate_hz) as writer:
        for packet in sequence.packets():
            assert isinstance(packet.frame, CameraFrame)
            writer.write_imu(packet.imu)
            writer.write_frame(packet.frame)
            progress(packet.frame.stamp_ns)


def _ignore(stamp_ns: int) -> None:
    """Tell nobody."""
