# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Small made-up videos and image folders, with and without times and an IMU."""

import os
from pathlib import Path

import cv2
import numpy as np
from recordings import FRAME_PERIOD_NS, IMU_PERIOD_NS, SIZE, START_NS, write_lines

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # FFmpeg would read it once, on first use

CHAIN = """cam0:
  T_cam_imu: [[0, 1, 0, 0.5], [0, 0, 1, 0.25], [1, 0, 0, -0.125], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [50.0, 51.0, 32.5, 23.5]
  distortion_model: radtan
  distortion_coeffs: [-0.28, 0.07, 2.0e-4, 1.7e-05]
  resolution: [64, 48]
imu0: {accelerometer_noise_density: 2.0e-3, accelerometer_random_walk: 3.0e-3,
       gyroscope_noise_density: 1.6968e-4, gyroscope_random_walk: 1.9393e-5, update_rate: 200}
"""

STAMPS_NS = [START_NS + k * FRAME_PERIOD_NS for k in range(8)]


def pictures(count: int = 8) -> list[np.ndarray]:
    rng = np.random.default_rng(4)
    return [rng.integers(0, 255, (SIZE[1], SIZE[0]), dtype=np.uint8) for _ in range(count)]


def seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def write_times(path: Path, in_seconds: bool = False, count: int = 8) -> Path:
    times = [START_NS + k * FRAME_PERIOD_NS for k in range(count)]
    write_lines(path, ["#time", *(seconds(t) if in_seconds else str(t) for t in times)])
    return path


def write_inertial(path: Path, in_seconds: bool = False) -> Path:
    """An IMU at rest, from 0.1 s before the first frame to 0.02 s after the last."""
    noise = np.random.default_rng(2).normal(0.0, 1e-3, (95, 6))
    noise[:, 5] += 9.81
    lines = ["#time,wx,wy,wz,ax,ay,az"]
    for k, row in enumerate(noise.tolist()):
        stamp = START_NS + (k - 20) * IMU_PERIOD_NS
        lines.append(f"{seconds(stamp) if in_seconds else stamp},{','.join(map(repr, row))}")
    write_lines(path, lines)
    return path


def write_video(
    folder: Path,
    name: str = "flight.mkv",
    codec: str = "FFV1",
    images: list[np.ndarray] | None = None,
) -> Path:
    """A video, without loss if nothing else is asked for, with nothing but a calibration."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    fourcc = cv2.VideoWriter.fourcc(*codec)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, 20.0, SIZE, True)
    assert writer.isOpened()
    for picture in pictures() if images is None else images:
        writer.write(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    writer.release()
    path.with_suffix(".yaml").write_text(CHAIN)
    return path


def write_flight_video(folder: Path, images: list[np.ndarray] | None = None) -> Path:
    """A video with times and an IMU beside it."""
    path = write_video(folder, images=images)
    write_times(path.with_suffix(".csv"), count=8 if images is None else len(images))
    write_inertial(path.with_suffix(".imu.csv"))
    return path


def write_image_folder(folder: Path, inertial: bool = True, count: int = 8) -> Path:
    """Numbered images, their times in a table without names."""
    (folder / "images").mkdir(parents=True)
    for k, picture in enumerate(pictures(count)):
        cv2.imwrite(str(folder / "images" / f"frame{k + 6}.png"), picture)
    write_times(folder / "timestamps.csv", in_seconds=True, count=count)
    (folder / "calibration.yaml").write_text(CHAIN)
    if inertial:
        write_inertial(folder / "imu.csv", in_seconds=True)
    return folder
