# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the camera models: inverses, derivatives, agreement with GTSAM's calibrations."""

import gtsam
import numpy as np
import pytest

from slam_graph.errors import DataError
from slam_graph.sensors.camera import Camera

PINHOLE = Camera(458.654, 457.296, 367.215, 248.375, "none", (), 752, 480)
RADTAN = Camera(
    458.654,
    457.296,
    367.215,
    248.375,
    "radtan",
    (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
    752,
    480,
)
EQUIDISTANT = Camera(
    461.5, 460.3, 363.0, 248.1, "equidistant", (-0.0027, 0.0242, -0.0432, 0.0331), 752, 480
)
WIDE = Camera(
    190.98, 190.97, 254.93, 256.90, "equidistant", (0.0034, 0.00072, -0.00205, 0.0002), 512, 512
)
ALL = [PINHOLE, RADTAN, EQUIDISTANT, WIDE]
each_camera = pytest.mark.parametrize("camera", ALL, ids=["none", "radtan", "equidistant", "wide"])


def pixel_grid(camera: Camera) -> np.ndarray:
    """Pixels all over the image; of a fisheye those that are less than 75° off its axis."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 41), np.linspace(0, camera.height - 1, 31))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    angle = np.hypot(*((pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T)
    return pixels[angle < np.deg2rad(75)] if camera is WIDE else pixels


@each_camera
def test_distort_inverts_undistort_over_the_whole_image(camera: Camera) -> None:
    pixels = pixel_grid(camera)
    again, _ = camera.distort(camera.undistort(pixels))
    np.testing.assert_allclose(again, pixels, atol=1e-7)


@each_camera
def test_undistort_inverts_distort(camera: Camera) -> None:
    m = camera.undistort(pixel_grid(camera))
    np.testing.assert_allclose(camera.undistort(camera.distort(m)[0]), m, atol=1e-8)


@each_camera
def test_jacobian_matches_numerical_derivative(camera: Camera) -> None:
    m = np.concatenate([camera.undistort(pixel_grid(camera)), np.zeros((1, 2)), [[1e-7, -1e-7]]])
    _, jacobian = camera.distort(m)
    h = 1e-6
    numerical = np.stack(
        [(camera.distort(m + d)[0] - camera.distort(m - d)[0]) / (2 * h) for d in h * np.eye(2)],
        axis=2,
    )
    np.testing.assert_allclose(jacobian, numerical, rtol=1e-6, atol=1e-4)


@each_camera
def test_projection_depends_on_the_ray_only(camera: Camera) -> None:
    m = camera.undistort(pixel_grid(camera))
    rays = np.column_stack([m, np.ones(len(m))])
    near, far = camera.project(0.3 * rays), camera.project(40.0 * rays)
    np.testing.assert_allclose(near, far, atol=1e-9)
    np.testing.assert_allclose(near, pixel_grid(camera), atol=1e-7)


def test_radtan_agrees_with_gtsam() -> None:
    oracle = gtsam.Cal3DS2(RADTAN.fx, RADTAN.fy, 0.0, RADTAN.cx, RADTAN.cy, *RADTAN.coefficients)
    m = RADTAN.undistort(pixel_grid(RADTAN))
    np.testing.assert_allclose(RADTAN.distort(m)[0], [oracle.uncalibrate(p) for p in m], atol=1e-9)


@pytest.mark.parametrize("camera", [EQUIDISTANT, WIDE], ids=["equidistant", "wide"])
def test_equidistant_agrees_with_gtsam(camera: Camera) -> None:
    oracle = gtsam.Cal3Fisheye(
        camera.fx, camera.fy, 0.0, camera.cx, camera.cy, *camera.coefficients
    )
    m = camera.undistort(pixel_grid(camera))
    np.testing.assert_allclose(camera.distort(m)[0], [oracle.uncalibrate(p) for p in m], atol=1e-8)


def test_calibration_matrix_projects_undistorted_points() -> None:
    m = np.array([[0.1, -0.2], [0.0, 0.0], [-0.7, 0.4]])
    homogeneous = np.column_stack([m, np.ones(3)]) @ PINHOLE.K.T
    np.testing.assert_allclose(PINHOLE.distort(m)[0], homogeneous[:, :2], atol=1e-12)


@each_camera
def test_no_points_in_no_points_out(camera: Camera) -> None:
    nothing = np.zeros((0, 2))
    assert camera.undistort(nothing).shape == (0, 2)
    pixels, jacobian = camera.distort(nothing)
    assert pixels.shape == (0, 2)
    assert jacobian.shape == (0, 2, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distortion": "spherical"}, "unknown distortion model 'spherical'"),
        ({"coefficients": (0.1, 0.2)}, "has 4 coefficients, got 2"),
        ({"fx": 0.0}, "focal lengths must be positive"),
    ],
)
def test_refuses_a_wrong_calibration(change: dict[str, object], message: str) -> None:
    fields = {name: getattr(RADTAN, name) for name in RADTAN.__dataclass_fields__}
    with pytest.raises(DataError, match=message):
        Camera(**{**fields, **change})
