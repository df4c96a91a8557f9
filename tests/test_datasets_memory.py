# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings made of arrays in memory are like those that the arrays were read from."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import write_euroc

import slam_graph as sg
from slam_graph.datasets.data_checks import check_sequence
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame


def inertial(source: RecordedSequence) -> dict[str, Any]:
    imu = source.imu()
    return {"imu_stamps_ns": imu.stamps_ns, "gyro": imu.gyro, "accel": imu.accel}


def in_memory(source: RecordedSequence, **changes: Any) -> RecordedSequence:
    """The same recording as arrays."""
    frames = list(source.frames())
    arrays = inertial(source)
    if source.content == "tracks":
        arrays["features"] = frames
    else:
        shots = [frame.images for frame in frames if isinstance(frame, CameraFrame)]
        arrays["image_stamps_ns"] = np.array([frame.stamp_ns for frame in frames])
        arrays["images"] = [list(column) for column in zip(*shots, strict=True)]
    truth = source.groundtruth()
    return sg.dataset_from_arrays(source.rig, groundtruth=truth, **(arrays | changes))


def test_a_run_on_features_in_memory_is_the_run_on_their_file() -> None:
    config = sg.load_config(duration_s=8.0)
    source = sg.open_dataset("demo")
    expected = sg.run(source, config).trajectory
    found = sg.run(in_memory(source, name="again"), config).trajectory
    np.testing.assert_array_equal(found.stamps_ns, expected.stamps_ns)
    np.testing.assert_array_equal(found.positions, expected.positions)
    assert len(found) > 50


def test_images_in_memory_are_delivered_as_from_their_files(tmp_path: Path) -> None:
    source = sg.open_dataset(str(write_euroc(tmp_path)))
    memory = in_memory(source)
    for read, kept in zip(source.packets(), memory.packets(), strict=True):
        assert isinstance(read.frame, CameraFrame)
        assert isinstance(kept.frame, CameraFrame)
        assert read.frame.stamp_ns == kept.frame.stamp_ns
        np.testing.assert_array_equal(read.imu.stamps_ns, kept.imu.stamps_ns)
        for one, other in zip(read.frame.images, kept.frame.images, strict=True):
            np.testing.assert_array_equal(one, other)
    info = memory.info()
    assert (info.format, info.content, info.has_groundtruth) == ("arrays", "images", True)
    assert (info.frames, info.imu_samples) == (source.info().frames, len(source.imu()))
    assert all(finding.severity == "info" for finding in check_sequence(memory))


def test_a_camera_may_lack_images_and_have_an_array_of_them(tmp_path: Path) -> None:
    source = sg.open_dataset(write_euroc(tmp_path))
    frames = [frame for frame in source.frames() if isinstance(frame, CameraFrame)]
    left = np.array([frame.images[0] for frame in frames])
    right = [frame.images[1] for frame in frames]
    right[1] = None
    diagnostics = Diagnostics()
    memory = in_memory(source, images=[left, right], diagnostics=diagnostics)
    found = [frame for frame in memory.frames() if isinstance(frame, CameraFrame)]
    assert [frame.images[1] is None for frame in found] == [k == 1 for k in range(len(found))]
    assert diagnostics.counts == {"camera_frame_missing": 1}


def test_unusable_imu_samples_are_counted_and_left_out() -> None:
    source = sg.open_dataset("demo")
    gyro = source.imu().gyro.copy()
    gyro[7, 0] = np.nan
    diagnostics = Diagnostics()
    memory = in_memory(source, gyro=gyro, diagnostics=diagnostics)
    assert len(memory.imu()) == len(gyro) - 1
    assert diagnostics.counts == {"imu_not_finite": 1}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gyro": np.zeros((3, 3))}, r"must be \(N,\), \(N, 3\), \(N, 3\)"),
        ({"imu_stamps_ns": np.linspace(0.0, 1.0, 6001)}, "whole nanoseconds"),
        ({"features": None}, "either images or features"),
        ({"features": []}, "at least one frame"),
        ({"features": [FeatureFrame(2, ()), FeatureFrame(1, ())]}, "times that increase"),
        ({"features": [FeatureFrame(2, ())]}, "features of 0 cameras, the rig has 1"),
        ({"features": None, "images": [[None]]}, "need their times"),
        (
            {"features": None, "images": [[None]], "image_stamps_ns": [1, 2]},
            "expected 2 images for each of 1 cameras",
        ),
        (
            {"features": None, "images": [[np.zeros((2, 2))]], "image_stamps_ns": [1]},
            r"image 0 of camera 0 must be \(height, width\) uint8",
        ),
    ],
)
def test_arrays_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    source = sg.open_dataset("demo")
    count = len(source.imu())
    if "imu_stamps_ns" in changes:
        changes = {"imu_stamps_ns": np.linspace(0.0, 1.0, count)}
    with pytest.raises(DataError, match=message):
        in_memory(source, **changes)
