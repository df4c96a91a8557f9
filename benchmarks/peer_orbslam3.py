# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""ORB-SLAM3, two cameras and IMU: runs in an environment that has `pyorbslam3`.

python -m benchmarks.peer_orbslam3 RECORDING FOLDER IMAGES…

Its vocabulary is the file that `PYORBSLAM3_VOCAB` names, as for the package itself. Without it a
small one is trained on the folders IMAGES.
"""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

import numpy as np

from benchmarks.peer_clip import FINAL_FILE, Array, Clip, Costs, prepare, rotation, write_tum
from benchmarks.peer_vocabulary import train

VOCABULARY_VARIABLE = "PYORBSLAM3_VOCAB"
TRAIN_ON_EVERY = 2
"""One of so many images of a folder is enough."""

ORB = {"nFeatures": 1200, "scaleFactor": 1.2, "nLevels": 8, "iniThFAST": 20, "minThFAST": 7}
"""What its authors use for EuRoC."""
CLOSE_DEPTH = 60.0
"""In baselines; theirs too."""

VIEWER = (
    "KeyFrameSize",
    "KeyFrameLineWidth",
    "GraphLineWidth",
    "PointSize",
    "CameraSize",
    "CameraLineWidth",
    "ViewpointX",
    "ViewpointY",
    "ViewpointZ",
    "ViewpointF",
)
"""It wants these even where there is no viewer."""


def main(recording: str, folder: str, *images: str) -> None:
    """Run over a clip; write costs, the poses it gave frame by frame, and those at its end."""
    prepare()
    package = importlib.import_module("pyorbslam3")
    clip, costs, out = Clip.read(Path(recording)), Costs(), Path(folder)
    vocabulary = Path(os.environ.get(VOCABULARY_VARIABLE, out / "vocabulary.txt"))
    if VOCABULARY_VARIABLE not in os.environ:
        files = [path for name in images for path in sorted(Path(name).glob("*.*g"))]
        train(files[::TRAIN_ON_EVERY], vocabulary)
    settings = out / "settings.yaml"
    settings.write_text(settings_of(clip), encoding="utf-8")
    slam = package.Slam(vocabulary, settings, package.Sensor.IMU_STEREO)
    camera_T_body = np.linalg.inv(clip.cameras[0].body_T_camera)
    for frame in costs.play(clip, paced=True):
        found = slam.track_stereo(frame.left, frame.right, frame.stamp_ns * 1e-9, imu=frame.imu)
        # until its map is aligned with gravity, poses are in another world frame
        if found.pose_valid and slam.imu_initialized():
            frame.world_T_body = np.asarray(found.pose_wc, np.float64) @ camera_T_body
    slam.shutdown()
    costs.write(out)
    saved = out / "saved.txt"
    slam.save_trajectory_euroc(str(saved))
    write_tum(out / FINAL_FILE, saved_poses(saved, clip))


def settings_of(clip: Clip) -> str:
    """The settings file of a clip."""
    left, right = clip.cameras
    lines = ["%YAML:1.0", 'File.version: "1.0"', 'Camera.type: "PinHole"']
    for name, camera in (("Camera1", left), ("Camera2", right)):
        values = (*camera.intrinsics, *camera.distortion)
        keys = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
        lines += [f"{name}.{key}: {value:.12f}" for key, value in zip(keys, values, strict=True)]
    noise = clip.imu_noise
    rate = 1e9 / float(np.median(np.diff(clip.imu_stamps_ns)))
    left_T_right = np.linalg.inv(left.body_T_camera) @ right.body_T_camera
    lines += [
        f"Camera.width: {left.size[0]}",
        f"Camera.height: {left.size[1]}",
        f"Camera.fps: {round(1e9 / float(np.median(np.diff(clip.stamps_ns))))}",
        "Camera.RGB: 1",
        f"Stereo.ThDepth: {CLOSE_DEPTH:.1f}",
        *matrix_lines("Stereo.T_c1_c2", left_T_right),
        *matrix_lines("IMU.T_b_c1", left.body_T_camera),
        f"IMU.NoiseGyro: {noise['gyroscope_noise_density']:.9f}",
        f"IMU.NoiseAcc: {noise['accelerometer_noise_density']:.9f}",
        f"IMU.GyroWalk: {noise['gyroscope_random_walk']:.9f}",
        f"IMU.AccWalk: {noise['accelerometer_random_walk']:.9f}",
        f"IMU.Frequency: {rate:.1f}",
        *(f"ORBextractor.{key}: {value}" for key, value in ORB.items()),
        *(f"Viewer.{key}: 1.0" for key in VIEWER),
    ]
    return "\n".join(lines) + "\n"


def matrix_lines(name: str, T: Array) -> list[str]:
    """A matrix (4, 4) as OpenCV writes it."""
    data = ", ".join(f"{value:.12f}" for value in T.ravel())
    return [f"{name}: !!opencv-matrix", "  rows: 4", "  cols: 4", "  dt: f", f"  data: [{data}]"]


def saved_poses(file: Path, clip: Clip) -> list[tuple[int, Array]]:
    """Poses of the body at the stamps of frames; the file has rounded these to parts of 1 µs."""
    poses = []
    for line in file.read_text(encoding="utf-8").splitlines():
        values = np.array([float(word) for word in line.split()])
        stamp = clip.stamps_ns[np.argmin(np.abs(clip.stamps_ns - values[0]))]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation(values[4:] / np.linalg.norm(values[4:])), values[1:4]
        poses.append((int(stamp), T))
    return poses


if __name__ == "__main__":
    main(*sys.argv[1:])
