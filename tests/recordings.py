# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Small made-up recordings on disk, for tests that break them."""

from pathlib import Path

import cv2
import numpy as np

START_NS = 1_403_636_579_763_555_584
IMU_PERIOD_NS = 5_000_000
FRAME_PERIOD_NS = 50_000_000
SIZE = (64, 48)

CAMERA_YAML = """%YAML:1.0
# a camera
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, 0.0, 1.0, 0.1,
         1.0, 0.0, 0.0, {y},
         0.0, 1.0, 0.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50.0, 51.0, 32.5, 23.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 2e-4, 1.7e-05]
"""

IMU_YAML = """sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2e-3
accelerometer_random_walk: 3.0000e-3
"""


def write_euroc(
    root: Path, frames: int = 8, cameras: int = 2, skew_ns: int = 300, imu_lead: int = 20
) -> Path:
    """An EuRoC folder; the IMU starts `imu_lead` samples before the first frame."""
    mav0 = root / "mav0"
    rng = np.random.default_rng(1)
    for c in range(cameras):
        (mav0 / f"cam{c}" / "data").mkdir(parents=True)
        (mav0 / f"cam{c}" / "sensor.yaml").write_text(CAMERA_YAML.format(y=0.1 * c))
        lines = ["#timestamp [ns],filename"]
        for k in range(frames):
            stamp = START_NS + k * FRAME_PERIOD_NS + c * skew_ns
            image = rng.integers(0, 255, (SIZE[1], SIZE[0]), dtype=np.uint8)
            cv2.imwrite(str(mav0 / f"cam{c}" / "data" / f"{stamp}.png"), image)
            lines.append(f"{stamp},{stamp}.png")
        write_lines(mav0 / f"cam{c}" / "data.csv", lines)
    count = imu_lead + (frames - 1) * FRAME_PERIOD_NS // IMU_PERIOD_NS + 5
    write_imu(mav0, START_NS - imu_lead * IMU_PERIOD_NS, count)
    write_groundtruth(mav0, 7, count)
    return root


def write_imu(mav0: Path, start_ns: int, count: int) -> None:
    """An IMU at rest, with a little noise."""
    (mav0 / "imu0").mkdir(parents=True, exist_ok=True)
    (mav0 / "imu0" / "sensor.yaml").write_text(IMU_YAML)
    noise = np.random.default_rng(2).normal(0.0, 1e-3, (count, 6))
    lines = ["#timestamp [ns],wx,wy,wz,ax,ay,az"]
    for k, (wx, wy, wz, ax, ay, az) in enumerate(noise.tolist()):
        lines.append(f"{start_ns + k * IMU_PERIOD_NS},{wx},{wy},{wz},{ax},{ay},{az + 9.81}")
    write_lines(mav0 / "imu0" / "data.csv", lines)


def write_groundtruth(mav0: Path, columns: int, count: int, start_ns: int = START_NS) -> None:
    """Ground truth with 7, 10 or 16 values after the time stamp."""
    folder = mav0 / "state_groundtruth_estimate0"
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["#timestamp,p,q wxyz,…"]
    for k in range(count):
        row = [0.01 * k, 0.2, 0.3, 0.5, 0.5, -0.5, 0.5000001, *np.arange(9) * 0.1][:columns]
        lines.append(",".join(map(str, [start_ns + k * IMU_PERIOD_NS, *row])))
    write_lines(folder / "data.csv", lines)


def write_openvins(folder: Path, frames: int = 6, features: int = 12, cameras: int = 2) -> Path:
    """A folder like the simulation dumped from OpenVINS."""
    folder.mkdir(parents=True)
    (folder / "calib.yaml").write_text(
        "imu: {rate_hz: 200, gyro_noise_density: 0.00017, gyro_random_walk: 0.00002,\n"
        "  accel_noise_density: 0.002, accel_random_walk: 0.003}\n"
        "cam_imu_time_offset_s: 0\ncameras:\n"
        + "".join(
            f"  - id: {c}\n    model: pinhole\n    distortion: radtan\n    resolution: [752, 480]\n"
            "    intrinsics: [458.6, 457.2, 367.2, 248.3]\n"
            "    distortion_coeffs: [-0.283, 0.0739, 0.00019, 1.76e-05]\n"
            f"    T_imu_cam: [[0, 0, 1, {0.1 * c}], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]\n"
            for c in range(cameras)
        )
    )
    rng = np.random.default_rng(3)
    tracks = ["#t[s],cam_id,feature_id,u_px,v_px"]
    for k in range(frames):
        for c in range(cameras):
            pixels = rng.uniform((10, 10), (740, 470), (features, 2)).tolist()
            tracks += [
                f"{100 + k // 10}.{k % 10}00000001,{c},{7 * i},{u},{v}"
                for i, (u, v) in enumerate(pixels)
            ]
    write_lines(folder / "tracks.csv", tracks)
    imu = ["#t[s],w,a"]
    imu += [f"{t // 200}.{t % 200 * 5:03d}000000,0.1,0,0,0,0,9.81" for t in range(19980, 20200)]
    write_lines(folder / "imu.csv", imu)
    state = "1,2,3,0,0,0.6,0.8,0.1,0.2,0.3,0.01,0.02,0.03,0.04,0.05,0.06"
    write_lines(folder / "groundtruth.csv", ["#t", f"99.900000000,{state}", f"100.9,{state}"])
    header = "#t - (prior sigma: q 0.02 rad, p 0.5 m, v 1e-3 m/s, bg 0.03, ba 0.04)"
    write_lines(folder / "init_state.csv", [header, f"99.900000000,{state}"])
    return folder


def write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n")


def edit_line(path: Path, number: int, text: str | None) -> None:
    """Replace one line (counted from 1), or remove it."""
    lines = path.read_text().splitlines()
    lines[number - 1 : number] = [] if text is None else [text]
    write_lines(path, lines)


def edit_text(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
