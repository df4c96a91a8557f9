# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the camera models: inverses, derivatives, agreement with GTSAM's calibrations."""

from dataclasses import replace

import cv2
import gtsam
import numpy as np
import pytest
from fov_camera import FOV, FieldOfView

from slam_graph.backend.gtsam_smoothers.smoother_features import calibration
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.image_frontend import ImageFrontend
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.camera_model import CAMERA_MODELS, MAX_TANGENT, register_camera_model
from slam_graph.sensors.measurements import CameraFrame
from slam_graph.sensors.rig import Rig, RigCamera

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
MEI = Camera(
    1335.6, 1334.2, 716.9, 705.7, "mei", (2.213, 0.0166, 1.6548, 4.2e-4, 4.2e-4), 1400, 1400
)
SPHERES = Camera(157.3, 157.2, 255.1, 256.8, "double_sphere", (-0.179, 0.5916), 512, 512)
NARROW = Camera(313.2, 313.2, 638.7, 514.4, "double_sphere", (-0.1834, 0.5931), 1280, 1024)
ALL = [PINHOLE, RADTAN, EQUIDISTANT, WIDE, MEI, SPHERES, NARROW, FOV]
NAMES = ["none", "radtan", "equidistant", "wide", "mei", "double_sphere", "narrow", "atan_fov"]
each_camera = pytest.mark.parametrize("camera", ALL, ids=NAMES)


def image_grid(camera: Camera) -> np.ndarray:
    """Pixels all over the image."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 41), np.linspace(0, camera.height - 1, 31))
    return np.column_stack([u.ravel(), v.ravel()])


def pixel_grid(camera: Camera) -> np.ndarray:
    """Pixels all over the image; of a wide lens those that are less than 80° off its axis."""
    pixels = image_grid(camera)
    return pixels[camera.visible(pixels)[1]] if camera.model.sees_sideways else pixels


def test_every_model_is_tested() -> None:
    assert {camera.distortion for camera in ALL} == set(CAMERA_MODELS)


@each_camera
def test_distort_inverts_undistort_over_the_whole_image(camera: Camera) -> None:
    pixels = pixel_grid(camera)
    again, _ = camera.distort(camera.undistort(pixels))
    np.testing.assert_allclose(again, pixels, atol=1e-7)


@each_camera
def test_undistort_inverts_distort(camera: Camera) -> None:
    m = camera.undistort(pixel_grid(camera))
    np.testing.assert_allclose(camera.undistort(camera.distort(m)[0]), m, atol=1e-8)


def test_coefficients_may_be_a_list_and_points_of_a_model_in_any_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = Camera(458.0, 457.0, 367.0, 248.0, "radtan", [-0.28, 0.07, 1e-4, 1e-5], 752, 480)  # type: ignore[arg-type]
    same = replace(given, coefficients=(-0.28, 0.07, 1e-4, 1e-5))
    pixels = pixel_grid(given)
    np.testing.assert_array_equal(given.undistort(pixels), same.undistort(pixels))
    assert given == same
    plain, pixels = FieldOfView.undistort, pixel_grid(FOV)
    expected = FOV.undistort(pixels)
    monkeypatch.setattr(
        FieldOfView, "undistort", lambda *given: np.asfortranarray(plain(*given))
    )  # as `np.stack([x, y]).T` is
    found = FOV.undistort(pixels)
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(found, expected)


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
def test_derivatives_by_the_parameters_match_numerical_ones(camera: Camera) -> None:
    m = np.concatenate([camera.undistort(pixel_grid(camera)), np.zeros((1, 2))])
    values = np.array([*camera.intrinsics, *camera.coefficients])
    analytical = np.concatenate([camera.by_intrinsics(m), camera.by_coefficients(m)], axis=2)
    assert analytical.shape == (len(m), 2, len(values))
    for k, h in enumerate([1e-3] * 4 + [1e-6] * len(camera.coefficients)):
        ends = []
        for sign in (1.0, -1.0):
            fx, fy, cx, cy, *coefficients = values + sign * h * np.eye(len(values))[k]
            changed = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(coefficients))
            ends.append(changed.distort(m)[0])
        numerical = (ends[0] - ends[1]) / (2 * h)
        np.testing.assert_allclose(analytical[:, :, k], numerical, rtol=1e-5, atol=1e-4)


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


def test_mei_agrees_with_gtsam() -> None:
    oracle = MEI.gtsam_calibration()
    assert oracle is not None
    m = MEI.undistort(pixel_grid(MEI))
    assert len(m) > 500
    np.testing.assert_allclose(MEI.distort(m)[0], [oracle.uncalibrate(p) for p in m], atol=1e-8)


@each_camera
def test_gtsam_has_the_same_camera_or_none(camera: Camera) -> None:
    """Projection and both derivatives of GTSAM's calibration are ours."""
    if camera.gtsam_calibration() is None:
        with pytest.raises(ConfigError, match=f"distortion '{camera.distortion}'"):
            calibration(camera)
        return
    oracle, factor = calibration(camera)
    m = camera.undistort(pixel_grid(camera))[::13]
    pixels, jacobian = camera.distort(m)
    assert len(m) > 40
    np.testing.assert_allclose(pixels, [oracle.uncalibrate(p) for p in m], atol=1e-8)
    noise = gtsam.noiseModel.Unit.Create(2)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3())
    for row, point in enumerate(m):
        values.insert(row + 1, np.append(point, 1.0))
        linear = factor(pixels[row], noise, 0, row + 1, oracle).linearize(values)
        A, b = linear.jacobian()
        np.testing.assert_allclose(A[:, 6:8], jacobian[row], rtol=1e-7, atol=1e-5)
        np.testing.assert_allclose(b, 0.0, atol=1e-8)


@each_camera
def test_the_valid_field_of_view_is_one_to_one(camera: Camera) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for share in (0.2, 0.6, 0.97):
        m = share * camera.max_tangent * rays
        np.testing.assert_allclose(camera.visible(camera.distort(m)[0])[0], m, atol=1e-6)


def test_points_beyond_the_fold_of_a_polynomial_are_not_visible() -> None:
    """r (1 - 0.4 r²) is largest at r = 0.913; further points come back into the image."""
    folding = replace(RADTAN, coefficients=(-0.4, 0.0, 0.0, 0.0))
    assert folding.max_tangent == pytest.approx(np.sqrt(1.0 / 1.2), abs=0.03)
    inside, beyond = folding.distort(np.array([[0.8, 0.0], [1.2, 0.0]]))[0]
    assert folding.visible(np.array([inside]))[1].all()
    assert not folding.visible(np.array([beyond]))[1].any() or np.all(
        np.abs(folding.visible(np.array([beyond]))[0]) < folding.max_tangent
    )
    assert RADTAN.max_tangent == MAX_TANGENT


def test_a_name_is_given_to_one_model_only() -> None:
    assert register_camera_model(FieldOfView) is FieldOfView  # again is no fault

    class Other(FieldOfView):
        """Another model of the same name."""

    with pytest.raises(ConfigError, match="camera model 'atan_fov' is registered already"):
        register_camera_model(Other)
    assert CAMERA_MODELS["atan_fov"] is FieldOfView


@pytest.mark.parametrize("camera", [SPHERES, NARROW], ids=["wide", "narrow"])
def test_double_sphere_is_what_its_paper_says(camera: Camera) -> None:
    xi, alpha = camera.coefficients
    points = np.random.default_rng(0).uniform([-3, -3, 0.6], [3, 3, 5], (200, 3))
    x, y, z = points.T
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    depth = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    expected = np.stack([camera.fx * x, camera.fy * y], axis=1) / depth[:, None]
    expected += np.array([camera.cx, camera.cy])
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


@each_camera
def test_every_pixel_is_a_point_or_said_not_to_be(camera: Camera) -> None:
    """Over the whole image: what is seen less than 85° off the axis is found again."""
    pixels = image_grid(camera)
    plane, visible = camera.visible(pixels)
    assert np.all(np.isfinite(plane))
    np.testing.assert_allclose(camera.distort(plane[visible])[0], pixels[visible], atol=1e-7)
    radius = np.linalg.norm(pixels - (camera.cx, camera.cy), axis=1)
    edge = camera.project(np.array([[np.tan(np.deg2rad(85)), 0.0, 1.0]]))[0, 0] - camera.cx
    if camera.model.sees_sideways:
        assert np.all(visible[radius < 0.98 * edge])
        assert not np.any(visible[radius > 1.02 * edge])
    else:
        assert np.all(visible)


def test_a_front_end_leaves_out_what_a_fisheye_sees_sideways() -> None:
    rng = np.random.default_rng(3)
    image = cv2.resize(rng.integers(0, 255, (128, 128), dtype=np.uint8), (512, 512))
    rig = Rig((RigCamera(WIDE, gtsam.Pose3()),))
    tracker = ImageFrontend(rig, FrontendConfig(max_features=400), 0, Diagnostics())
    features = tracker.track(CameraFrame(0, (np.asarray(image, np.uint8),))).cameras[0]
    length = np.linalg.norm(features.normalized, axis=1)
    assert len(features) > 100
    assert np.tan(np.deg2rad(75)) < np.max(length) < np.tan(np.deg2rad(85.1))


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
        ({"distortion": "spherical"}, "unknown camera model 'spherical'"),
        ({"coefficients": (0.1, 0.2)}, "has 4 coefficients, got 2"),
        ({"fx": 0.0}, "focal lengths must be positive"),
    ],
)
def test_refuses_a_wrong_calibration(change: dict[str, object], message: str) -> None:
    fields = {name: getattr(RADTAN, name) for name in RADTAN.__dataclass_fields__}
    with pytest.raises(DataError, match=message):
        Camera(**{**fields, **change})


def test_whole_numbers_are_taken_for_parameters() -> None:
    camera = Camera(458, 457, 367, 248, "radtan", (0, 0, 0, 0), 752, 480)
    points = np.array([[0.1, -0.2], [0.0, 0.3]])
    np.testing.assert_allclose(camera.undistort(camera.distort(points)[0]), points, atol=1e-12)
