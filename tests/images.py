# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Images whose motion is known exactly: views of a smooth texture, for tests of the front end."""

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.frontend_protocol import Frontend
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame, FeatureObservations
from slam_graph.sensors.rig import Rig, RigCamera

Image = NDArray[np.uint8]
Spline = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 480, 320, 300.0, 0.1
CAMERA = Camera(FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, "none", (), WIDTH, HEIGHT)
MONO = Rig((RigCamera(CAMERA, gtsam.Pose3(), name="left"),))
STEREO = Rig(
    (
        RigCamera(CAMERA, gtsam.Pose3(), name="left"),
        RigCamera(CAMERA, gtsam.Pose3(gtsam.Rot3(), [BASELINE_M, 0, 0]), name="right"),
    )
)
CONFIG = FrontendConfig(max_features=120, grid=(6, 4))


def painted(seed: int = 3) -> Spline:
    """A smooth random texture, larger than the images, as coefficients of a cubic spline."""
    rng = np.random.default_rng(seed)
    smooth = ndimage.gaussian_filter(rng.normal(size=(HEIGHT + 200, WIDTH + 200)), 3.0)
    return ndimage.spline_filter(np.clip(128 + 45 * smooth / np.std(smooth), 5, 250))


def view(texture: Spline, H: NDArray[np.float64] | None = None) -> Image:
    """The image in which the point of the texture's middle part at p appears at H(p).

    Interpolated by splines, because OpenCV's warps round positions to 1/32 px and more.
    """
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    source = pixels if H is None else transfer(np.linalg.inv(H), pixels)
    values = ndimage.map_coordinates(texture, source[:, ::-1].T + 100, order=3, prefilter=False)
    return np.rint(values.clip(0, 255)).astype(np.uint8).reshape(HEIGHT, WIDTH)


def shift(du: float, dv: float) -> NDArray[np.float64]:
    return np.array([[1, 0, du], [0, 1, dv], [0, 0, 1.0]])


def rotation(angles_rad: list[float]) -> NDArray[np.float64]:
    """The homography of a pure rotation of the camera."""
    return CAMERA.K @ gtsam.Rot3.Expmap(np.array(angles_rad)).matrix() @ np.linalg.inv(CAMERA.K)


def transfer(H: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    return cv2.perspectiveTransform(pixels[:, None], H)[:, 0]


def common(
    a: FeatureObservations, b: FeatureObservations
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    return in_a, in_b


def feed(frontend: Frontend, *images: tuple[Image | None, ...]) -> list[FeatureFrame]:
    return [frontend.track(CameraFrame(k, pair)) for k, pair in enumerate(images)]
