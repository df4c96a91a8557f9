# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings with depth, and without an IMU: written and read again, checked, and described."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from recordings import SIZE, write_euroc
from recordings_loose import CHAIN, STAMPS_NS, pictures, write_times
from recordings_public import write_tum_rgbd
from typer.testing import CliRunner

from slam_graph.cli.main import app
from slam_graph.datasets import (
    EurocWriter,
    TrackRecorder,
    check_sequence,
    dataset_from_arrays,
    kalibr_text,
    open_dataset,
    read_kalibr,
)
from slam_graph.datasets.formats.track_recording import DEPTHS
from slam_graph.datasets.streams.depth_images import Registration
from slam_graph.errors import DataError
from slam_graph.sensors import Camera, CameraFrame, DepthSensor, FeatureFrame, Rig
from slam_graph.simulation import simulate

WITHOUT_IMU = CHAIN.replace(CHAIN.splitlines()[1] + "\n", "")
RIGHT = "cam1:\n  T_cn_cnm1: [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n" + (
    "\n".join(WITHOUT_IMU.splitlines()[1:]) + "\n"
)
DEPTH = "depth0:\n  scale: 5000\n  range_m: [0.5, 6]\n  noise: [0.002, 0.003]\n"


def slope(frame: int) -> NDArray[np.uint16]:
    """A raw depth image in 5000ths of a metre, with a hole."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    raw = (5000 + 100 * u + 20 * v + frame).astype(np.uint16)
    raw[5:9, 7:9] = 0
    return raw


def in_metres(raw: NDArray[np.uint16]) -> NDArray[np.float32]:
    return np.where(raw == 0, np.float32(np.nan), raw.astype(np.float32) / np.float32(5000))


def stereo_folder(folder: Path, names: tuple[str, str] = ("left", "right")) -> Path:
    for name in (*names, "depth"):
        (folder / name).mkdir(parents=True)
    for k, picture in enumerate(pictures()):
        cv2.imwrite(str(folder / names[0] / f"{k:04d}.png"), picture)
        cv2.imwrite(str(folder / names[1] / f"{k:04d}.png"), 255 - picture)
        cv2.imwrite(str(folder / "depth" / f"{k:04d}.png"), slope(k))
    write_times(folder / "times.txt")
    (folder / "calibration.yaml").write_text(WITHOUT_IMU + RIGHT + DEPTH)
    return folder


def frames_of(path: Path, **options: int) -> list[CameraFrame]:
    frames = [packet.frame for packet in open_dataset(path, **options).packets()]
    assert all(isinstance(frame, CameraFrame) for frame in frames)
    return [frame for frame in frames if isinstance(frame, CameraFrame)]


# --- a folder of images of two cameras ------------------------------------------------------------


@pytest.mark.parametrize("names", [("left", "right"), ("image_0", "image_1")])
def test_folder_of_stereo_images(tmp_path: Path, names: tuple[str, str]) -> None:
    sequence = open_dataset(stereo_folder(tmp_path / "walk", names))
    info = sequence.info()
    assert (info.format, info.cameras, info.frames, info.has_imu) == ("images", 2, 8, False)
    assert (info.has_depth, info.depth_frames) == (True, 8)
    left, right = sequence.rig.cameras
    assert left.body_T_camera.equals(gtsam.Pose3(), 0.0)
    np.testing.assert_allclose(right.body_T_camera.translation(), [0.1, 0.0, 0.0])
    for k, frame in enumerate(frames_of(tmp_path / "walk")):
        assert frame.stamp_ns == STAMPS_NS[k]
        assert frame.depth is not None
        np.testing.assert_array_equal(frame.images[0], pictures()[k])
        np.testing.assert_array_equal(frame.images[1], 255 - pictures()[k])
        np.testing.assert_array_equal(frame.depth, in_metres(slope(k)))


def test_names_in_the_table_say_which_image_is_missing(tmp_path: Path) -> None:
    folder = stereo_folder(tmp_path / "walk")
    rows = [f"{stamp} {k:04d}.png" for k, stamp in enumerate(STAMPS_NS)]
    (folder / "times.txt").write_text("\n".join(rows) + "\n")
    (folder / "right" / "0003.png").unlink()
    (folder / "depth" / "0005.png").unlink()
    for k, frame in enumerate(frames_of(folder)):
        assert (frame.images[1] is None) == (k == 3)
        assert (frame.depth is None) == (k == 5)
    assert frames_of(folder, cameras=1)[3].images[0] is not None


def test_folder_of_stereo_images_needs_both_cameras_calibrated(tmp_path: Path) -> None:
    folder = stereo_folder(tmp_path / "walk")
    (folder / "calibration.yaml").write_text(WITHOUT_IMU + DEPTH)
    with pytest.raises(DataError, match="calibrates 1 cameras, there are images of 2"):
        open_dataset(folder)
    (folder / "calibration.yaml").write_text(WITHOUT_IMU + RIGHT)
    sequence = open_dataset(folder)
    assert sequence.diagnostics.counts["depth_left_out"] == 1
    assert not sequence.info().has_depth


# --- without the IMU ------------------------------------------------------------------------------


def test_a_recording_read_without_its_imu_is_the_same_but_for_it(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "flight")
    whole, seen = open_dataset(folder), open_dataset(folder, imu=False)
    assert (whole.info().has_imu, whole.rig.has_imu) == (True, True)
    assert (seen.info().has_imu, seen.rig.has_imu, seen.info().imu_samples) == (False, False, 0)
    assert len(seen.imu()) == 0
    for one, other in zip(whole.rig.cameras, seen.rig.cameras, strict=True):
        assert one.body_T_camera.equals(other.body_T_camera, 0.0)
    for one, other in zip(whole.packets(), seen.packets(), strict=True):
        assert len(other.imu) == 0
        assert isinstance(one.frame, CameraFrame)
        assert isinstance(other.frame, CameraFrame)
        assert one.frame.stamp_ns == other.frame.stamp_ns
        np.testing.assert_array_equal(one.frame.images[0], other.frame.images[0])
    assert not seen.diagnostics.counts
    found = check_sequence(seen)
    assert [finding.severity for finding in found if finding.where == "imu"] == ["info"]


def test_tracks_can_be_read_without_their_imu(tmp_path: Path) -> None:
    simulate(duration_s=1.0).save(tmp_path / "tracks")
    assert open_dataset(tmp_path / "tracks").info().has_imu
    assert sum(len(p.imu) for p in open_dataset(tmp_path / "tracks", imu=False).packets()) == 0
    assert sum(len(p.imu) for p in open_dataset("demo", imu=False).packets()) == 0


# --- written and read again -----------------------------------------------------------------------


def test_a_rig_with_depth_and_without_imu_is_written_and_read_again(tmp_path: Path) -> None:
    camera = Camera(50.0, 51.0, 32.5, 23.5, "radtan", (-0.28, 0.07, 2e-4, 1.7e-5), 64, 48)
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([0.1, 0.2, 0.3]))
    sensor = DepthSensor(1, 5000.0, 0.2, 7.0, 2e-3, 3e-3, camera, pose)
    rig = replace(simulate(duration_s=1.0).rig, has_imu=False, depth=sensor)
    (tmp_path / "rig.yaml").write_text(kalibr_text(rig))
    read = read_kalibr(tmp_path / "rig.yaml")
    assert not read.has_imu
    assert (depth := read.depth) is not None
    assert depth.camera_T_depth.equals(pose, 1e-12)
    assert replace(depth, camera_T_depth=sensor.camera_T_depth).__dict__ == sensor.__dict__
    assert read.select(1).depth is None


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("camera: 2", "number of a camera"),
        ("scale: 0", "above 0"),
        ("range_m: [3, 1]", "least and the largest"),
        ("noise: [0, 0]", "noise in m"),
        ("range_m: [0.3, 1e308]", "least and the largest"),
        ("noise: [1e308, 0]", "noise in m"),
        ("scale: 1e18", "units to a metre"),
    ],
)
def test_depth_calibration_that_makes_no_sense(tmp_path: Path, line: str, match: str) -> None:
    (tmp_path / "rig.yaml").write_text(f"{CHAIN}depth0:\n  {line}\n")
    with pytest.raises(DataError, match=match) as error:
        read_kalibr(tmp_path / "rig.yaml")
    assert "rig.yaml:11" in str(error.value)


def test_a_depth_sensor_that_is_far_coarser_than_its_camera_is_refused() -> None:
    """To fill the pixels between its points would take hours."""
    camera = Camera(50.0, 51.0, 32.5, 23.5, "none", (), 64, 48)
    with pytest.raises(DataError, match="5000 times shorter"):
        Registration(replace(camera, fx=0.01), camera, gtsam.Pose3())


def test_tracks_with_depth_are_replayed_to_the_last_bit(tmp_path: Path) -> None:
    sequence = simulate(duration_s=2.0, depth={"sensor": "kinect"}, with_imu=False, cameras=2)
    sequence.save(tmp_path / "tracks")
    replayed = open_dataset(tmp_path / "tracks")
    assert (replayed.info().has_imu, replayed.info().has_depth) == (False, True)
    start_ns = sequence.info().start_ns + 10**9
    for since in (None, start_ns):
        pairs = zip(sequence.packets(since), replayed.packets(since), strict=True)
        for one, other in pairs:
            assert isinstance(one.frame, FeatureFrame)
            assert isinstance(other.frame, FeatureFrame)
            for a, b in zip(one.frame.cameras, other.frame.cameras, strict=True):
                assert (a.depth_m is None) == (b.depth_m is None)
                if a.depth_m is not None:
                    np.testing.assert_array_equal(a.depth_m, b.depth_m)
                    np.testing.assert_array_equal(a.depth_sigma_m, b.depth_sigma_m)
    cut = tmp_path / "tracks" / DEPTHS
    cut.write_bytes(cut.read_bytes()[:-8])
    with pytest.raises(DataError, match=DEPTHS):
        open_dataset(tmp_path / "tracks")


def test_frames_without_depth_are_recorded_as_such(tmp_path: Path) -> None:
    sequence = simulate(duration_s=1.0, with_imu=False)
    rig = replace(sequence.rig, depth=DepthSensor(camera=1))
    with TrackRecorder(tmp_path / "tracks", rig) as recorder:
        for packet in sequence.packets():
            assert isinstance(packet.frame, FeatureFrame)
            recorder.write(packet.imu, packet.frame)
    for packet in open_dataset(tmp_path / "tracks").packets():
        assert isinstance(packet.frame, FeatureFrame)
        assert packet.frame.cameras[0].depth_m is None
        assert packet.frame.cameras[1].depth_m is not None
        assert np.isnan(packet.frame.cameras[1].depth_m).all()
    mono = open_dataset(tmp_path / "tracks", cameras=1)
    assert not mono.info().has_depth
    assert all(
        len(p.frame.cameras) == 1 for p in mono.packets() if isinstance(p.frame, FeatureFrame)
    )


def test_rgbd_recording_is_converted_and_read_again(tmp_path: Path) -> None:
    sequence = open_dataset(write_tum_rgbd(tmp_path / "rgbd_dataset_freiburg3_desk"))
    assert sequence.info().depth_frames == 6
    EurocWriter.convert(sequence, tmp_path / "euroc")
    again = open_dataset(tmp_path / "euroc")
    assert (again.info().has_imu, again.info().depth_frames) == (False, 6)
    assert kalibr_text(replace(again.rig, cameras=sequence.rig.cameras)) == kalibr_text(
        sequence.rig
    )
    for one, other in zip(sequence.frames(), again.frames(), strict=True):
        assert isinstance(one, CameraFrame)
        assert isinstance(other, CameraFrame)
        np.testing.assert_array_equal(one.depth, other.depth)
        assert one.depth_ns == other.depth_ns


def test_damaged_and_missing_depth_is_counted(tmp_path: Path) -> None:
    folder = stereo_folder(tmp_path / "walk")
    file = folder / "depth" / "0002.png"
    file.write_bytes(file.read_bytes()[:-20])
    cv2.imwrite(str(folder / "depth" / "0004.png"), slope(0)[:-1])
    cv2.imwrite(str(folder / "depth" / "0006.png"), pictures()[0])
    sequence = open_dataset(folder)
    missing = [isinstance(f, CameraFrame) and f.depth is None for f in sequence.frames()]
    assert np.flatnonzero(missing).tolist() == [2, 4, 6]
    assert sequence.diagnostics.counts == {"depth_unreadable": 2, "depth_wrong_size": 1}


# --- in memory ------------------------------------------------------------------------------------


def test_recording_in_memory_with_depth_and_without_imu(tmp_path: Path) -> None:
    rig = open_dataset(stereo_folder(tmp_path / "walk")).rig
    depth = [None if k == 1 else in_metres(slope(k)) for k in range(8)]
    images = [pictures(), pictures()]
    sequence = dataset_from_arrays(rig, image_stamps_ns=STAMPS_NS, images=images, depth=depth)
    assert (sequence.info().has_imu, sequence.info().depth_frames) == (False, 7)
    for frame, given in zip(sequence.frames(), depth, strict=True):
        assert isinstance(frame, CameraFrame)
        assert (frame.depth is None) == (given is None)
        if frame.depth is not None:
            np.testing.assert_array_equal(frame.depth, given)
    plain = Rig(rig.cameras)
    with pytest.raises(DataError, match="depth sensor"):
        dataset_from_arrays(plain, image_stamps_ns=STAMPS_NS, images=images, depth=depth)
    with pytest.raises(DataError, match="an IMU needs"):
        dataset_from_arrays(
            plain, imu_stamps_ns=STAMPS_NS, image_stamps_ns=STAMPS_NS, images=images
        )


# --- commands -------------------------------------------------------------------------------------


def test_commands_describe_depth_and_a_missing_imu(tmp_path: Path) -> None:
    folder = str(stereo_folder(tmp_path / "walk"))
    shown = CliRunner().invoke(app, ["data", "info", folder, "--json"])
    table = json.loads(shown.stdout)
    assert (table["has_imu"], table["has_depth"], table["depth_frames"]) == (False, True, 8)
    checked = CliRunner().invoke(app, ["data", "check", folder, "--images", "--json"])
    assert checked.exit_code == 0
    findings = json.loads(checked.stdout)["findings"]
    said = [finding["what"] for finding in findings if finding["where"] == "depth"]
    assert said[0] == "8 of 8 frames have a depth image"
    holes = 8 / (SIZE[0] * SIZE[1])
    far = np.mean([np.mean(in_metres(slope(k)) > 6.0) for k in range(8)])
    assert said[1].startswith(f"{1 - holes - far:.0%} of the pixels have a depth")


def test_commands_leave_out_the_imu(tmp_path: Path) -> None:
    folder = str(write_euroc(tmp_path / "flight"))
    shown = CliRunner().invoke(app, ["data", "info", folder, "--no-imu", "--json"])
    assert json.loads(shown.stdout)["has_imu"] is False
    options = ["--depth", "kinect", "--no-imu", "--duration", "1", "--no-progress", "--json"]
    made = CliRunner().invoke(app, ["simulate", str(tmp_path / "made"), *options])
    table = json.loads(made.stdout)
    assert (table["has_imu"], table["has_depth"], table["imu_samples"]) == (False, True, 0)


def test_what_a_recording_loses_by_another_calibration_is_said(tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    simulate(duration_s=1.0, cameras=1, depth={"sensor": "kinect"}).save(folder)
    assert open_dataset(folder).info().has_depth
    chain = read_kalibr(folder / "calibration.yaml")
    (tmp_path / "plain.yaml").write_text(kalibr_text(replace(chain, depth=None)))
    plain = open_dataset(folder, calibration=tmp_path / "plain.yaml")
    assert not plain.info().has_depth
    assert plain.diagnostics.counts == {"depth_left_out": 1}
    turned = replace(chain.cameras[0], rotation_known=False)
    (tmp_path / "unknown.yaml").write_text(kalibr_text(replace(chain, cameras=(turned,))))
    for imu, count in ((True, 0), (False, 1)):
        unknown = open_dataset(folder, calibration=tmp_path / "unknown.yaml", imu=imu)
        assert unknown.diagnostics.counts["mounting_assumed"] == count
