# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The formats of public benchmarks: frames, units and calibration as their makers define them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import edit_line, edit_text
from recordings_public import (
    CAM_R_VELO,
    CAM_T_VELO,
    D_TAKEN,
    K_TAKEN,
    KITTI_START_NS,
    P_RECT,
    R_RECT,
    SIZE,
    TAKEN,
    VELO_R_IMU,
    VELO_T_IMU,
    write_kitti_odometry,
    write_kitti_raw,
    write_tum_rgbd,
    write_tum_vi,
)
from scipy.spatial.transform import Rotation

from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.sequence import Sequence
from slam_graph.errors import ConfigError, DataError
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors.measurements import CameraFrame


def frames_of(sequence: Sequence) -> list[CameraFrame]:
    frames = [packet.frame for packet in sequence.packets()]
    assert all(isinstance(frame, CameraFrame) for frame in frames)
    return frames  # type: ignore[return-value]


# --- TUM-VI ---------------------------------------------------------------------------------------


def test_tum_vi_takes_its_calibration_and_noise_from_dso(tmp_path: Path) -> None:
    path = write_tum_vi(tmp_path / "dataset-room1_512_16")
    sequence = open_dataset(path)
    assert (sequence.info().format, sequence.info().cameras) == ("tum_vi", 2)
    assert open_dataset(path / "mav0").info() == sequence.info()
    assert sequence.rig.imu.gyro_noise_density == 0.00016
    assert sequence.rig.imu.accel_random_walk == 0.00086
    truth = sequence.groundtruth()
    assert truth is not None
    np.testing.assert_allclose(truth.positions[1], [0.01, 0.2, 0.3])


def test_sixteen_bits_become_the_upper_eight(tmp_path: Path) -> None:
    path = write_tum_vi(tmp_path / "dataset-room1_512_16")
    sequence = open_dataset(path)
    for frame in frames_of(sequence):
        name = f"{frame.stamp_ns}.png"
        stored = cv2.imread(str(path / "mav0" / "cam0" / "data" / name), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint16
        assert np.array_equal(frame.images[0], stored >> 8)
    assert not sequence.diagnostics.counts


def test_calibration_for_another_resolution_is_refused(tmp_path: Path) -> None:
    path = write_tum_vi(tmp_path / "dataset-room1_1024_16")
    edit_text(path / "dso" / "camchain.yaml", "resolution: [64, 48]", "resolution: [32, 24]")
    with pytest.raises(DataError, match=r"64x48 \(2 times as large\).* 32x24; .*--calibration"):
        open_dataset(path)


# --- KITTI raw ------------------------------------------------------------------------------------


def test_kitti_projects_points_of_the_navigation_unit(tmp_path: Path) -> None:
    """The chain of KITTI's documentation: P_rect R_rect cam_T_velo velo_T_imu."""
    sequence = open_dataset(write_kitti_raw(tmp_path / "2011_09_26"))
    points = np.random.default_rng(0).uniform([5, -3, -2], [20, 3, 2], (20, 3))
    velodyne = points @ VELO_R_IMU.T + VELO_T_IMU
    rectified = (velodyne @ CAM_R_VELO.T + CAM_T_VELO) @ R_RECT.T
    for mounted, projection in zip(sequence.rig.cameras, P_RECT.values(), strict=True):
        pixels = np.column_stack([rectified, np.ones(20)]) @ projection.T
        local = mounted.body_T_camera.transformTo(points.T).T
        expected = pixels[:, :2] / pixels[:, 2:]
        np.testing.assert_allclose(mounted.camera.project(local), expected, atol=1e-6)


def test_kitti_poses_and_imu_are_in_metres_and_agree(tmp_path: Path) -> None:
    sequence = open_dataset(write_kitti_raw(tmp_path / "2011_09_26"))
    truth, imu = sequence.groundtruth(), sequence.imu()
    assert truth is not None
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
    expected = np.column_stack([10.0 * seconds, 0.0 * seconds, seconds])
    np.testing.assert_allclose(truth.positions, expected, atol=1e-6)
    assert truth.velocities is not None
    np.testing.assert_allclose(truth.velocities, np.tile([10.0, 0.0, 1.0], (len(truth), 1)))
    yaw, pitch, roll = 0.1 * seconds[5], -0.05, 0.02
    about_z, about_y, about_x = (
        Rotation.from_rotvec(v).as_matrix() for v in ([0, 0, yaw], [0, pitch, 0], [roll, 0, 0])
    )
    rotation = truth.pose(5).rotation().matrix()
    np.testing.assert_allclose(rotation, about_z @ about_y @ about_x, atol=1e-12)
    np.testing.assert_allclose(imu.accel[0], [0.5, 0.1, 9.81])
    np.testing.assert_allclose(imu.gyro[0], [0.01, 0.02, 0.1])
    assert frames_of(sequence)[0].stamp_ns == KITTI_START_NS


def test_kitti_at_ten_hertz_is_counted(tmp_path: Path) -> None:
    sequence = open_dataset(write_kitti_raw(tmp_path / "2011_09_26", extract=False))
    assert sequence.diagnostics.counts == {"imu_slow": 1}
    assert sequence.rig.imu.rate_hz == pytest.approx(10.0)


def test_kitti_images_as_taken_are_rectified(tmp_path: Path) -> None:
    """A smooth scene at infinity looks the same through the rectified camera."""
    drive = write_kitti_raw(tmp_path / "2011_09_26")

    def scene(directions: np.ndarray) -> np.ndarray:
        x, y = directions[..., 0] / directions[..., 2], directions[..., 1] / directions[..., 2]
        return 128 + 80 * np.sin(3 * x + 1) * np.cos(4 * y)

    u, v = np.meshgrid(np.arange(TAKEN[0]), np.arange(TAKEN[1]))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(float)
    rays = cv2.undistortPoints(pixels, K_TAKEN, D_TAKEN).reshape(TAKEN[1], TAKEN[0], 2)
    taken = scene(np.dstack([rays, np.ones(rays.shape[:2])])).round().astype(np.uint8)
    for file in drive.rglob("*.png"):
        cv2.imwrite(str(file), taken)
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    K = P_RECT["00"][:, :3]
    rays = np.dstack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)])
    expected = scene(rays @ R_RECT)
    image = frames_of(open_dataset(drive))[0].images[0]
    assert image is not None
    inside = (slice(8, -8), slice(8, -8))
    assert np.max(np.abs(image[inside] - expected[inside])) < 3.0


def test_kitti_faults_are_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path / "2011_09_26")
    (drive / "image_00" / "data" / "0000000002.png").unlink()
    oxts = drive.parent / "2011_09_26_drive_0001_extract" / "oxts"
    (oxts / "data" / "0000000030.txt").unlink()
    stamps = (oxts / "timestamps.txt").read_text().splitlines()
    edit_line(oxts / "timestamps.txt", 41, stamps[37])
    sequence = open_dataset(drive)
    frames = frames_of(sequence)
    assert [frame.images[0] is None for frame in frames] == [k == 2 for k in range(6)]
    assert sequence.diagnostics.counts == {
        "image_unreadable": 1,
        "imu_not_finite": 1,
        "imu_out_of_order": 1,
    }
    (drive.parent / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(DataError, match="calib_velo_to_cam"):
        open_dataset(drive)


def test_kitti_bad_cells_are_named(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path / "2011_09_26")
    edit_line(drive / "image_00" / "timestamps.txt", 3, "soon")
    with pytest.raises(DataError, match=r"timestamps.txt:3: 'soon'"):
        open_dataset(drive)


# --- without an IMU -------------------------------------------------------------------------------


def test_kitti_odometry(tmp_path: Path) -> None:
    sequence = open_dataset(write_kitti_odometry(tmp_path))
    info, truth = sequence.info(), sequence.groundtruth()
    assert (info.format, info.cameras, info.imu_samples) == ("kitti_odometry", 2, 0)
    assert truth is not None
    assert np.array_equal(truth.stamps_ns, [f.stamp_ns for f in frames_of(sequence)])
    right = sequence.rig.cameras[1].body_T_camera
    np.testing.assert_allclose(right.matrix(), np.eye(4) + 0.54 * np.eye(4, k=3), atol=1e-9)
    np.testing.assert_allclose(truth.positions[5], [4.0, -0.5, 0.1], atol=1e-9)  # forward is x
    turned = truth.pose(0).between(truth.pose(5)).rotation()
    np.testing.assert_allclose(
        turned.matrix(), Rotation.from_euler("y", 0.5).as_matrix(), atol=1e-9
    )


def test_tum_rgbd_is_undistorted_grey(tmp_path: Path) -> None:
    path = write_tum_rgbd(tmp_path / "rgbd_dataset_freiburg3_office")
    first = frames_of(open_dataset(path))[0]
    assert first.stamp_ns == 1_305_031_100_000_000_000
    colour = cv2.imread(str(path / "rgb" / "1305031100.000000.png"))
    assert np.max(cv2.absdiff(first.images[0], cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))) <= 1
    path.rename(tmp_path / "rgbd_dataset_freiburg2_xyz")
    other = frames_of(open_dataset(tmp_path / "rgbd_dataset_freiburg2_xyz"))[0].images[0]
    K = np.array([[520.9, 0, 325.1], [0, 521.0, 249.7], [0, 0, 1]])
    plain = cv2.undistort(
        np.asarray(first.images[0]), K, np.array([0.2312, -0.7849, -0.0033, -0.0001, 0.9172])
    )
    assert np.array_equal(other, plain)


def test_tum_rgbd_of_an_unknown_camera_needs_a_calibration(tmp_path: Path) -> None:
    known = write_tum_rgbd(tmp_path / "freiburg1")
    write_kalibr(open_dataset(known).rig, tmp_path / "chain.yaml")
    known.rename(tmp_path / "mine")
    with pytest.raises(DataError, match="--calibration"):
        open_dataset(tmp_path / "mine")
    sequence = open_dataset(tmp_path / "mine", calibration=tmp_path / "chain.yaml")
    assert sequence.info().frames == 6


@pytest.mark.parametrize("write", [write_kitti_odometry, write_tum_rgbd])
def test_a_run_by_an_imu_that_is_not_there_is_refused(tmp_path: Path, write: object) -> None:
    assert callable(write)
    sequence = open_dataset(write(tmp_path / "freiburg1"))
    with pytest.raises(ConfigError, match="no IMU") as error:
        run(sequence, overrides=["backend.dynamics.model=imu"])
    assert "\n" not in str(error.value)


def test_sources_are_refused_where_they_mean_nothing(tmp_path: Path) -> None:
    path = write_kitti_odometry(tmp_path)
    with pytest.raises(DataError, match="imu=/imu0"):
        open_dataset(path, sources={"imu": "/imu0"})
