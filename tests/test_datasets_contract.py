# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What every data set class owes its users: one set of laws, run on all of them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recordings import write_euroc, write_openvins
from recordings_loose import write_flight_video, write_image_folder
from recordings_public import (
    write_kitti_odometry,
    write_kitti_raw,
    write_tum_rgbd,
    write_tum_vi,
)
from recordings_ros import write_bag

from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.formats.track_recorder import TrackRecorder
from slam_graph.datasets.sequence import Sequence
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame, ImuData, Packet

SECOND_NS = 1_000_000_000


def euroc(folder: Path) -> Sequence:
    return open_dataset(write_euroc(folder / "made_up"))


def euroc_in_step(folder: Path) -> Sequence:
    return open_dataset(write_euroc(folder / "in_step", cameras=3, skew_ns=0, imu_lead=0))


def openvins(folder: Path) -> Sequence:
    return open_dataset(write_openvins(folder / "simulated"))


def wheel(folder: Path) -> Sequence:
    return open_dataset("demo")


def tum_vi(folder: Path) -> Sequence:
    return open_dataset(write_tum_vi(folder / "dataset-room1_512_16"))


def kitti_raw(folder: Path) -> Sequence:
    return open_dataset(write_kitti_raw(folder / "2011_09_26"))


def kitti_odometry(folder: Path) -> Sequence:
    return open_dataset(write_kitti_odometry(folder / "kitti"))


def tum_rgbd(folder: Path) -> Sequence:
    return open_dataset(write_tum_rgbd(folder / "rgbd_dataset_freiburg1_xyz"))


def bag_ros1(folder: Path) -> Sequence:
    return open_dataset(write_bag(folder, "ros1"))


def bag_sqlite(folder: Path) -> Sequence:
    return open_dataset(write_bag(folder, "sqlite"))


def bag_mcap(folder: Path) -> Sequence:
    return open_dataset(write_bag(folder, "mcap"))


def bag_mcap_file(folder: Path) -> Sequence:
    return open_dataset(write_bag(folder, "mcap_file"))


def video(folder: Path) -> Sequence:
    return open_dataset(write_flight_video(folder))


def image_folder(folder: Path) -> Sequence:
    return open_dataset(write_image_folder(folder / "walk"))


def recording(folder: Path) -> Sequence:
    source = openvins(folder)
    with TrackRecorder(folder / "recorded", source.rig) as recorder:
        for packet in source.packets():
            assert isinstance(packet.frame, FeatureFrame)
            recorder.write(packet.imu, packet.frame)
    return open_dataset(folder / "recorded")


MADE_UP: list[Callable[[Path], Sequence]] = [
    euroc,
    euroc_in_step,
    openvins,
    wheel,
    recording,
    tum_vi,
    kitti_raw,
    kitti_odometry,
    tum_rgbd,
    bag_ros1,
    bag_sqlite,
    bag_mcap,
    bag_mcap_file,
    video,
    image_folder,
]

ASSUMPTIONS = {"imu_noise_assumed"}
"""What is counted of recordings without a fault: ROS bags do not carry the noise of their IMU."""


@pytest.fixture(params=MADE_UP, ids=lambda make: make.__name__)
def sequence(request: pytest.FixtureRequest, tmp_path: Path) -> Sequence:
    made: Sequence = request.param(tmp_path)
    return made


def same_frame(a: CameraFrame | FeatureFrame, b: CameraFrame | FeatureFrame) -> bool:
    if isinstance(a, CameraFrame) and isinstance(b, CameraFrame):
        pairs = zip(a.images, b.images, strict=True)
        same = all((x is None and y is None) or np.array_equal(x, y) for x, y in pairs)
        return same and a.stamp_ns == b.stamp_ns
    assert isinstance(a, FeatureFrame)
    assert isinstance(b, FeatureFrame)
    return a.stamp_ns == b.stamp_ns and all(
        np.array_equal(x.ids, y.ids)
        and np.array_equal(x.pixels, y.pixels)
        and np.array_equal(x.normalized, y.normalized)
        for x, y in zip(a.cameras, b.cameras, strict=True)
    )


def same_imu(a: ImuData, b: ImuData) -> bool:
    return (
        np.array_equal(a.stamps_ns, b.stamps_ns)
        and np.array_equal(a.gyro, b.gyro)
        and np.array_equal(a.accel, b.accel)
    )


def check_contract(sequence: Sequence, packets: list[Packet]) -> None:
    """The laws that hold for the packets of a whole sequence."""
    info = sequence.info()
    stamps = np.array([packet.frame.stamp_ns for packet in packets])
    assert isinstance(sequence, Sequence)
    assert (info.frames, info.start_ns, info.end_ns) == (len(stamps), stamps[0], stamps[-1])
    assert info.cameras == len(sequence.rig.cameras)
    assert np.all(np.diff(stamps) > 0)
    assert info.has_groundtruth == (sequence.groundtruth() is not None)
    if info.imu_samples:
        check_imu(packets)
    assert sum(len(packet.imu) for packet in packets) <= info.imu_samples
    for packet in packets:
        check_frame(sequence, packet.frame, info.content)


def check_imu(packets: list[Packet]) -> None:
    """Packets cut the stream right after the first sample at or after their frame."""
    joined = ImuData.concatenate([packet.imu for packet in packets])
    assert np.all(np.diff(joined.stamps_ns) > 0)
    for packet in packets[:-1]:
        assert packet.imu.stamps_ns[-1] >= packet.frame.stamp_ns
        if len(packet.imu) > 1:
            assert packet.imu.stamps_ns[-2] < packet.frame.stamp_ns
    assert joined.gyro.shape == joined.accel.shape == (len(joined), 3)
    assert joined.stamps_ns.dtype == np.int64


def check_frame(sequence: Sequence, frame: CameraFrame | FeatureFrame, content: str) -> None:
    if isinstance(frame, CameraFrame):
        assert content == "images"
        for mounted, image in zip(sequence.rig.cameras, frame.images, strict=True):
            if image is not None:
                assert image.shape == (mounted.camera.height, mounted.camera.width)
                assert image.dtype == np.uint8
        return
    assert content == "tracks"
    for mounted, seen in zip(sequence.rig.cameras, frame.cameras, strict=True):
        assert len(np.unique(seen.ids)) == len(seen.ids)
        assert seen.pixels.shape == seen.normalized.shape == (len(seen), 2)
        pixels = mounted.camera.distort(seen.normalized)[0]
        np.testing.assert_allclose(pixels, seen.pixels, atol=1e-6)


def test_contract(sequence: Sequence) -> None:
    check_contract(sequence, list(sequence.packets()))
    assert not sequence.diagnostics.counts.keys() - ASSUMPTIONS


def test_two_passes_agree(sequence: Sequence) -> None:
    for a, b in zip(sequence.packets(), sequence.packets(), strict=True):
        assert same_frame(a.frame, b.frame)
        assert same_imu(a.imu, b.imu)


def test_first_packet_has_all_imu_before_it(sequence: Sequence) -> None:
    first = next(iter(sequence.packets()))
    if sequence.info().imu_samples == 0:
        assert len(first.imu) == 0
        return
    samples = np.concatenate([block.stamps_ns for block in sequence.imu_blocks()])  # type: ignore[attr-defined]
    assert first.imu.stamps_ns[0] == samples[0]
    assert len(samples) == sequence.info().imu_samples


def test_start_and_end_are_respected(sequence: Sequence) -> None:
    whole = list(sequence.packets())
    start, end = whole[2].frame.stamp_ns, whole[-2].frame.stamp_ns
    part = list(sequence.packets(start, end))
    assert len(part) == len(whole) - 3
    for a, b in zip(part, whole[2:-1], strict=True):
        assert same_frame(a.frame, b.frame)
    for a, b in zip(part[1:], whole[3:-1], strict=True):
        assert same_imu(a.imu, b.imu)
    history = ImuData.concatenate([packet.imu for packet in whole[:3]])
    keep = int(np.searchsorted(history.stamps_ns, start - SECOND_NS))
    assert same_imu(part[0].imu, history[keep:])
    between = list(sequence.packets(start + 1, end - 1))
    assert [p.frame.stamp_ns for p in between] == [p.frame.stamp_ns for p in whole[3:-2]]


def test_no_frames_in_range(sequence: Sequence) -> None:
    assert list(sequence.packets(sequence.info().end_ns + 1)) == []


def test_cameras_are_limited(sequence: Sequence, tmp_path: Path) -> None:
    mono = open_dataset(sequence.path, cameras=1)  # type: ignore[attr-defined]
    assert mono.info().cameras == 1
    for one, all_ in zip(mono.packets(), sequence.packets(), strict=True):
        if isinstance(one.frame, FeatureFrame) and isinstance(all_.frame, FeatureFrame):
            assert len(one.frame.cameras) == 1
            assert np.array_equal(one.frame.cameras[0].ids, all_.frame.cameras[0].ids)
        elif isinstance(one.frame, CameraFrame) and isinstance(all_.frame, CameraFrame):
            assert np.array_equal(one.frame.images[0], all_.frame.images[0])
            assert len(one.frame.images) == 1


@pytest.mark.data
def test_real_images(data_dir: Path) -> None:
    sequence = open_dataset(data_dir / "euroc" / "V1_01_easy_static_2s")
    check_contract(sequence, list(sequence.packets()))
    assert not sequence.diagnostics.counts


@pytest.mark.data
def test_real_simulation(data_dir: Path) -> None:
    sequence = open_dataset(data_dir / "openvins_sim" / "euroc_V1_01")
    check_contract(sequence, list(sequence.packets()))
    assert not sequence.diagnostics.counts
