# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion to EuRoC: what is read from the new folder is what was read from the old one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from recordings import FRAME_PERIOD_NS, START_NS, edit_text, write_euroc, write_openvins
from recordings_loose import write_flight_video, write_image_folder
from recordings_public import write_kitti_odometry, write_kitti_raw, write_tum_rgbd, write_tum_vi
from recordings_ros import write_bag, write_bag_of
from typer.testing import CliRunner

from slam_graph.cli.main import app
from slam_graph.config import load_config
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, write_kalibr
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.formats.euroc_writer import EurocWriter
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.errors import DataError
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors.measurements import CameraFrame, ImuData
from slam_graph.sensors.rig import Rig

SOURCES: dict[str, Callable[[Path], Path]] = {
    "euroc": lambda folder: write_euroc(folder / "flight", skew_ns=0),
    "tum_vi": lambda folder: write_tum_vi(folder / "dataset-room1_512_16"),
    "kitti_raw": lambda folder: write_kitti_raw(folder / "2011_09_26"),
    "kitti_odometry": lambda folder: write_kitti_odometry(folder / "kitti"),
    "tum_rgbd": lambda folder: write_tum_rgbd(folder / "rgbd_dataset_freiburg1_xyz"),
    "rosbag": lambda folder: write_bag(folder, "mcap"),
    "video": lambda folder: write_flight_video(folder),
    "images": lambda folder: write_image_folder(folder / "walk", inertial=False),
}


def frames_of(sequence: RecordedSequence) -> list[CameraFrame]:
    frames = list(sequence.frames())
    assert all(isinstance(frame, CameraFrame) for frame in frames)
    return frames  # type: ignore[return-value]


def convert(*arguments: str | Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["data", "convert", "--no-progress", *map(str, arguments)])
    return done.exit_code, str(done.exception or done.output)


@pytest.mark.parametrize("kind", SOURCES)
def test_nothing_is_lost(tmp_path: Path, kind: str) -> None:
    source = SOURCES[kind](tmp_path)
    named = ["--topic", "groundtruth=/truth"] if kind == "rosbag" else []
    status, output = convert(source, tmp_path / "new", *named)
    assert status == 0, output
    before = open_dataset(source, sources={"groundtruth": "/truth"} if named else None)
    after = open_dataset(tmp_path / "new")
    assert (before.info().format, after.info().format) == (kind, "euroc")
    assert after.info() == replace(before.info(), name="new", format="euroc")
    same_rig(after.rig, before.rig)
    same_rig(read_kalibr(tmp_path / "new" / "calibration.yaml"), before.rig)
    for a, b in zip(frames_of(after), frames_of(before), strict=True):
        assert a.stamp_ns == b.stamp_ns
        assert all(np.array_equal(x, y) for x, y in zip(a.images, b.images, strict=True))
    same_imu(after.imu(), before.imu())
    same_truth(after, before)
    assert not after.diagnostics.counts


def same_rig(a: Rig, b: Rig) -> None:
    for x, y in zip(a.cameras, b.cameras, strict=True):
        assert x.camera == y.camera
        assert x.time_offset_s == y.time_offset_s
        assert x.rolling_shutter == y.rolling_shutter
        assert x.body_T_camera.equals(y.body_T_camera, 1e-9)
    assert a.imu == b.imu


def same_imu(a: ImuData, b: ImuData) -> None:
    assert np.array_equal(a.stamps_ns, b.stamps_ns)
    assert np.array_equal(a.gyro, b.gyro)
    assert np.array_equal(a.accel, b.accel)


def same_truth(a: RecordedSequence, b: RecordedSequence) -> None:
    one, other = a.groundtruth(), b.groundtruth()
    assert (one is None) == (other is None)
    if one is None or other is None:
        return
    assert np.array_equal(one.stamps_ns, other.stamps_ns)
    np.testing.assert_allclose(one.positions, other.positions, atol=1e-12)
    np.testing.assert_allclose(one.quaternions, other.quaternions, atol=1e-12)


def test_missing_images_stay_missing(tmp_path: Path) -> None:
    source = write_euroc(tmp_path / "flight", skew_ns=0)
    images = source / "mav0" / "cam1" / "data"
    (images / f"{START_NS + 2 * FRAME_PERIOD_NS}.png").write_bytes(b"not an image")
    status, output = convert(source, tmp_path / "new")
    assert status == 0
    assert "warning: image_unreadable 1" in output
    after = open_dataset(tmp_path / "new")
    seen = [frame.images[1] is not None for frame in frames_of(after)]
    assert seen == [k != 2 for k in range(8)]
    assert after.diagnostics.counts == {"camera_frame_missing": 1}


def test_time_offsets_and_shutters_are_kept(tmp_path: Path) -> None:
    source, chain = write_euroc(tmp_path / "flight"), tmp_path / "chain.yaml"
    rig = open_dataset(source).rig
    cameras = tuple(replace(c, time_offset_s=-3e-3, rolling_shutter=True) for c in rig.cameras)
    write_kalibr(Rig(cameras, rig.imu), chain)
    EurocWriter.convert(open_dataset(source, calibration=chain), tmp_path / "new")
    same_rig(open_dataset(tmp_path / "new").rig, Rig(cameras, rig.imu))


def test_only_euroc_folders_are_replaced_and_only_if_told_so(tmp_path: Path) -> None:
    source, target = write_euroc(tmp_path / "flight"), tmp_path / "new"
    target.mkdir()
    (target / "mine.txt").write_text("precious")
    for options, message in (([], "exists already"), (["--force"], "not an EuRoC folder")):
        status, said = convert(source, target, *options)
        assert status == 1
        assert message in said
    assert (target / "mine.txt").read_text() == "precious"
    EurocWriter.convert(open_dataset(source, cameras=1), tmp_path / "other")
    status, _ = convert(source, tmp_path / "other", "--force")
    assert status == 0
    assert open_dataset(tmp_path / "other").info().cameras == 2
    assert {path.name for path in tmp_path.iterdir()} == {"flight", "new", "other"}


def test_a_recording_that_cannot_be_read_leaves_nothing(tmp_path: Path) -> None:
    source = write_euroc(tmp_path / "flight")
    edit_text(source / "mav0" / "imu0" / "data.csv", "9.8", "9.8x")
    status, said = convert(source, tmp_path / "new")
    assert status == 1
    assert "imu0/data.csv" in said
    assert [path.name for path in tmp_path.iterdir()] == ["flight"]


def test_tracks_are_not_images(tmp_path: Path) -> None:
    tracks = open_dataset(write_openvins(tmp_path / "simulated"))
    with pytest.raises(DataError, match="holds feature tracks, no images"):
        EurocWriter.convert(tracks, tmp_path / "new")


def test_sources_need_a_name_and_a_place(tmp_path: Path) -> None:
    status, _ = convert(write_bag(tmp_path), tmp_path / "new", "--topic", "/imu0")
    assert status == 2


@pytest.mark.data
def test_a_real_bag_and_its_conversion_give_the_same_trajectory(
    data_dir: Path, tmp_path: Path
) -> None:
    source = open_dataset(data_dir / "euroc" / "MH_01_easy_17s", cameras=1)
    end_ns = source.info().start_ns + 2_500_000_000
    bag = write_bag_of(source, tmp_path / "flight.bag", "ros1", end_ns)
    write_kalibr(source.rig, tmp_path / "chain.yaml")
    status, said = convert(bag, tmp_path / "flight", "--calibration", tmp_path / "chain.yaml")
    assert status == 0, said
    config = load_config(algorithm="msckf")
    recorded = open_dataset(bag, calibration=tmp_path / "chain.yaml")
    before, after = (
        run(s, config).trajectory for s in (recorded, open_dataset(tmp_path / "flight"))
    )
    assert len(before) > 15
    assert np.array_equal(before.stamps_ns, after.stamps_ns)
    np.testing.assert_allclose(after.positions, before.positions, atol=1e-6)
    np.testing.assert_allclose(after.quaternions, before.quaternions, atol=1e-6)


def test_an_unknown_mounting_stays_unknown(tmp_path: Path) -> None:
    source, chain = write_euroc(tmp_path / "flight"), tmp_path / "chain.yaml"
    rig = open_dataset(source).rig
    first, second = (replace(camera, rotation_known=False) for camera in rig.cameras)
    moved = replace(second, body_T_camera=first.body_T_camera.between(second.body_T_camera))
    write_kalibr(Rig((replace(first, body_T_camera=gtsam.Pose3()), moved), rig.imu), chain)
    before = open_dataset(source, calibration=chain)
    EurocWriter.convert(before, tmp_path / "new")
    after = open_dataset(tmp_path / "new")
    same_rig(after.rig, before.rig)
    assert [camera.rotation_known for camera in after.rig.cameras] == [False, False]


def test_masks_and_true_objects_come_along(tmp_path: Path) -> None:
    source = write_euroc(tmp_path / "flight", skew_ns=0)
    stamps = [START_NS + k * FRAME_PERIOD_NS for k in range(8)]
    (source / "masks").mkdir()
    boxes = "".join(f"{stamp + 300},7,{k},2,20,30\n" for k, stamp in enumerate(stamps[:6]))
    (source / "masks" / "boxes.csv").write_text(boxes)
    (source / "masks" / "classes.csv").write_text("7,car\n")
    (source / "objects_truth.csv").write_text(f"#t\n{stamps[0]},3,1,2,3,0,0,0,1\n")
    before = open_dataset(source)
    EurocWriter.convert(before, tmp_path / "new")
    after = open_dataset(tmp_path / "new")
    assert (after.masks, after.mask_classes) == (6, {7: "car"})
    for stamp in stamps:
        found, expected = after.label_image(stamp), before.label_image(stamp)
        assert (found is None) == (expected is None)
        np.testing.assert_array_equal(found, expected)
    truth = after.object_truth()
    assert list(truth) == [3]
    assert truth[3].positions.tolist() == [[1.0, 2.0, 3.0]]
