# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""cuVSLAM on the CPU, two cameras without IMU: runs in an environment that has `dim-odom`.

python -m benchmarks.peer_cuvslam RECORDING FOLDER
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clocks import Image
from benchmarks.peer_clip import Array, Clip, Costs, prepare, quaternion, rotation

NAMES = ("cam0", "cam1")
BODY = "body"

Transform = tuple[tuple[float, ...], tuple[float, ...]]
"""Translation, and rotation as x, y, z, w."""


def main(recording: str, folder: str) -> None:
    """Run over a clip; write costs and the poses that it gave frame by frame."""
    prepare()
    package = importlib.import_module("dim_odom")
    clip, costs = Clip.read(Path(recording)), Costs()
    tracker = tracker_of(package, clip)
    for frame in costs.play(clip):
        for name, image in zip(NAMES, (frame.left, frame.right), strict=True):
            estimate = tracker.handle_image(image_of(package, name, frame.stamp_ns, image))
        if estimate is not None:
            frame.world_T_body = matrix(estimate.translation, estimate.rotation_xyzw)
    costs.write(Path(folder))


def tracker_of(package: Any, clip: Clip) -> Any:
    """A tracker that knows both cameras."""
    mounts = dict(zip(NAMES, (transform(c.body_T_camera) for c in clip.cameras), strict=True))
    mounts[BODY] = transform(np.eye(4))
    config = {
        "camera_mode": "stereo",
        "use_gpu": False,
        "output_frame_id": BODY,
        "rig_frame_id": BODY,
        "cameras": [{"frame_id": name, "rectified": False} for name in NAMES],
    }
    tracker = package.CuvslamOdometry(
        config, tf=lambda parent, child: mounts.get(child) if parent == BODY else None
    )
    for name, camera in zip(NAMES, clip.cameras, strict=True):
        fu, fv, cu, cv = map(float, camera.intrinsics)
        tracker.handle_camera_info(
            package.CameraModel(
                timestamp_ns=int(clip.stamps_ns[0]),
                frame_id=name,
                width=camera.size[0],
                height=camera.size[1],
                distortion=[*map(float, camera.distortion), 0.0],
                intrinsics=[fu, 0.0, cu, 0.0, fv, cv, 0.0, 0.0, 1.0],
            )
        )
    return tracker


def image_of(package: Any, name: str, stamp_ns: int, image: Image) -> Any:
    """An image as the tracker takes it."""
    height, width = image.shape
    return package.ImageFrame(stamp_ns, name, width, height, "mono8", width, image.tobytes())


def transform(T: Array) -> Transform:
    """A pose as the tracker takes it."""
    return tuple(map(float, T[:3, 3])), tuple(map(float, quaternion(T[:3, :3])))


def matrix(translation: Any, rotation_xyzw: Any) -> Array:
    """(4, 4) of a pose as the tracker gives it."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation(np.array(rotation_xyzw)), np.array(translation)
    return T


if __name__ == "__main__":
    main(*sys.argv[1:])
