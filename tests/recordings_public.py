# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Small made-up recordings in the formats of public benchmarks."""

from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from recordings import SIZE, write_euroc, write_lines
from scipy.spatial.transform import Rotation

from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.formats.euroc import EurocSequence

LATITUDE, LONGITUDE = 49.011212804408, 8.4228850417969
KITTI_START_NS = 1_317_042_145_964_389_445

R_RECT = Rotation.from_euler("xyz", [0.01, -0.02, 0.015]).as_matrix()
CAM_R_VELO = Rotation.from_euler("xyz", [0.02, 0.01, -0.01]).as_matrix() @ np.array(
    [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
)
VELO_R_IMU = Rotation.from_euler("xyz", [0.002, -0.001, 0.015]).as_matrix()
CAM_T_VELO, VELO_T_IMU = np.array([-0.004, -0.076, -0.27]), np.array([-0.81, 0.32, -0.8])
TAKEN = (70, 52)
K_TAKEN = np.array([[50.0, 0.0, 34.0], [0.0, 51.0, 25.0], [0.0, 0.0, 1.0]])
D_TAKEN = np.array([-0.37, 0.2, 0.001, 0.001, -0.07])
P_RECT = {
    "00": np.array([[42.0, 0, 31.0, 0], [0, 42.0, 24.0, 0], [0, 0, 1, 0]]),
    "01": np.array([[42.0, 0, 31.0, -42.0 * 0.54], [0, 42.0, 24.0, 0], [0, 0, 1, 0]]),
}


def random_image(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    shape = (size[1], size[0])
    return np.random.default_rng(seed).integers(0, 255, shape, dtype=np.uint8)


def write_tum_vi(root: Path) -> Path:
    """An EuRoC folder whose calibration is where TUM-VI keeps it, and whose images have 16 bits."""
    return as_tum_vi(write_euroc(root))


def as_tum_vi(root: Path) -> Path:
    """Turn an EuRoC folder into one of TUM-VI, in place."""
    (root / "dso").mkdir()
    write_kalibr(EurocSequence(root).rig, root / "dso" / "camchain.yaml")
    chain = root / "dso" / "camchain.yaml"
    text = chain.read_text()
    chain.write_text(text[: text.index("imu0:")])
    (root / "dso" / "imu_config.yaml").write_text(
        "gyroscope_noise_density: 0.00016\ngyroscope_random_walk: 0.000022\n"
        "accelerometer_noise_density: 0.0028\naccelerometer_random_walk: 0.00086\n"
        "update_rate: 200.0\n"
    )
    for file in (root / "mav0").rglob("sensor.yaml"):
        file.unlink()
    (root / "mav0" / "state_groundtruth_estimate0").rename(root / "mav0" / "mocap0")
    for file in (root / "mav0").rglob("*.png"):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE).astype(np.uint16)
        cv2.imwrite(str(file), image * 256 + 200)
    return root


def date(stamp_ns: int) -> str:
    seconds = datetime.fromtimestamp(stamp_ns // 10**9, UTC)
    return f"{seconds:%Y-%m-%d %H:%M:%S}.{stamp_ns % 10**9:09d}"


def write_kitti_day(day: Path) -> None:
    """The three calibration files of a day."""
    day.mkdir(parents=True, exist_ok=True)

    def text(values: np.ndarray) -> str:
        return " ".join(f"{v:.12e}" for v in np.ravel(values))

    stamp = "calib_time: 09-Jan-2012 13:57:47"
    lines = [stamp, "corner_dist: 9.950000e-02"]
    for camera, projection in P_RECT.items():
        lines += [
            f"S_{camera}: {text(np.array(TAKEN))}",
            f"K_{camera}: {text(K_TAKEN)}",
            f"D_{camera}: {text(D_TAKEN)}",
            f"S_rect_{camera}: {text(np.array(SIZE))}",
            f"R_rect_{camera}: {text(R_RECT)}",
            f"P_rect_{camera}: {text(projection)}",
        ]
    write_lines(day / "calib_cam_to_cam.txt", lines)
    imu = [stamp, f"R: {text(VELO_R_IMU)}", f"T: {text(VELO_T_IMU)}"]
    write_lines(day / "calib_imu_to_velo.txt", imu)
    velo = [stamp, f"R: {text(CAM_R_VELO)}", f"T: {text(CAM_T_VELO)}", "delta_f: 0 0"]
    write_lines(day / "calib_velo_to_cam.txt", velo)


def write_oxts(folder: Path, count: int, period_ns: int) -> None:
    """A car that drives east at 10 m/s and turns slowly to the left, climbing a little."""
    (folder / "data").mkdir(parents=True)
    stamps = [KITTI_START_NS - 10 * period_ns + k * period_ns for k in range(count)]
    write_lines(folder / "timestamps.txt", [date(stamp) for stamp in stamps])
    for k in range(count):
        time = k * period_ns * 1e-9
        longitude = LONGITUDE + np.degrees(
            10.0 * time / (6_378_137.0 * np.cos(np.radians(LATITUDE)))
        )
        numbers = np.zeros(30)
        numbers[:6] = [LATITUDE, longitude, 112.0 + time, 0.02, -0.05, 0.1 * time]
        numbers[6:11] = [0.0, 10.0, 10.0, 0.0, 1.0]
        numbers[11:14] = [0.5, 0.1, 9.81]
        numbers[17:20] = [0.01, 0.02, 0.1]
        numbers[23] = 0.05  # accuracy of the position
        (folder / "data" / f"{k:010d}.txt").write_text(" ".join(map(repr, numbers.tolist())))


def write_kitti_raw(day: Path, frames: int = 6, extract: bool = True) -> Path:
    """A drive in both forms; of the unsynchronised one only the navigation unit."""
    write_kitti_day(day)
    drive = day / "2011_09_26_drive_0001_sync"
    for c, camera in enumerate(P_RECT):
        folder = drive / f"image_{camera}"
        (folder / "data").mkdir(parents=True)
        stamps = [KITTI_START_NS + 100_000_000 * k + 400_000 * c for k in range(frames)]
        write_lines(folder / "timestamps.txt", [date(stamp) for stamp in stamps])
        for k in range(frames):
            cv2.imwrite(str(folder / "data" / f"{k:010d}.png"), random_image(2 * k + c))
    write_oxts(drive / "oxts", frames + 10, 100_000_000)
    if extract:
        write_oxts(day / "2011_09_26_drive_0001_extract" / "oxts", 10 * frames + 12, 10_000_000)
    return drive


def write_kitti_odometry(root: Path, frames: int = 6, number: str = "03") -> Path:
    sequence = root / "sequences" / number
    lines, times, poses = [], [], []
    for k, camera in enumerate(P_RECT):
        (sequence / f"image_{k}").mkdir(parents=True)
        lines.append(f"P{k}: " + " ".join(f"{v:.12e}" for v in P_RECT[camera].ravel()))
        for frame in range(frames):
            file = sequence / f"image_{k}" / f"{frame:06d}.png"
            cv2.imwrite(str(file), random_image(2 * frame + k))
    for frame in range(frames):
        times.append(f"{0.1036224 * frame:.6e}")
        pose = np.eye(4)[:3]
        pose[:, :3] = Rotation.from_euler("y", 0.1 * frame).as_matrix()
        pose[:, 3] = [0.1 * frame, -0.02 * frame, 0.8 * frame]
        poses.append(" ".join(f"{v:.9e}" for v in pose.ravel()))
    write_lines(sequence / "calib.txt", lines)
    write_lines(sequence / "times.txt", times)
    (root / "poses").mkdir()
    write_lines(root / "poses" / f"{number}.txt", poses)
    return sequence


def write_tum_rgbd(folder: Path, frames: int = 6, size: tuple[int, int] = (640, 480)) -> Path:
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
        lines = [f"# {kind} images", "# file: 'a.bag'", "# timestamp filename"]
        for k in range(frames):
            stamp = f"13050311{k // 30:02d}.{k % 30 * 33333:06d}"
            rows = size[::-1]
            shape, kind_of = ((*rows, 3), np.uint8) if kind == "rgb" else (rows, np.uint16)
            pixels = np.random.default_rng(0).integers(0, 255, shape, dtype=kind_of)
            if kind == "depth":
                pixels += 10_000  # about 2 m
            else:  # a textured wall, along which the camera moves
                pixels = np.roll(cv2.GaussianBlur(pixels, (0, 0), 2.0), 2 * k, axis=1)
            cv2.imwrite(str(folder / kind / f"{stamp}.png"), pixels)
            lines.append(f"{stamp} {kind}/{stamp}.png")
        write_lines(folder / f"{kind}.txt", lines)
    write_lines(folder / "accelerometer.txt", ["# t ax ay az", "1305031100.0 0 9.8 0"])
    truth = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    truth += [f"13050311{k:02d}.0000 {k} 0.6 1.6 0.5 0.5 -0.5 0.5" for k in range(3)]
    write_lines(folder / "groundtruth.txt", truth)
    return folder
