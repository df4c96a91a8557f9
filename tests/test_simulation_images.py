# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of rendered images: geometry to a fraction of a pixel, exposure, blur and noise."""

from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from flight import FISHEYE
from numpy.typing import NDArray

from slam_graph.sensors.measurements import CameraFrame
from slam_graph.sensors.rig import Rig, RigCamera
from slam_graph.simulation.rendering import Renderer, cast
from slam_graph.simulation.simulated_sequence import SimulatedImages
from slam_graph.simulation.simulation_config import ImageConfig, SimulationConfig
from slam_graph.simulation.simulator import simulate
from slam_graph.simulation.textures import paint

Floats = NDArray[np.float64]

SHARP: dict[str, Any] = {"noise_sigma": 0.0}


def images(trajectory: str = "figure8", **options: Any) -> SimulatedImages:
    config = SimulationConfig(
        kind="images", trajectory=trajectory, duration_s=12.0, images=SHARP | options
    )
    sequence = simulate(config)
    assert isinstance(sequence, SimulatedImages)
    return sequence


@pytest.fixture(scope="module", params=["figure8", "rooms"])
def sequence(request: pytest.FixtureRequest) -> SimulatedImages:
    return images(request.param)


def shot(sequence: SimulatedImages, index: int) -> CameraFrame:
    flight = sequence.flight
    return sequence.renderer.frame(flight.motion, int(flight.exposures_ns[index]))


def camera_pose(sequence: SimulatedImages, index: int, camera: int) -> tuple[Floats, Floats]:
    """world_R_camera and position of a camera at a frame."""
    at = sequence.flight.exposures_ns[index : index + 1]
    motion, mounted = sequence.flight.motion, sequence.rig.cameras[camera].body_T_camera
    pose = gtsam.Pose3(gtsam.Rot3(motion.rotations(at).as_matrix()[0]), motion.positions(at)[0])
    there = pose.compose(mounted)
    return there.rotation().matrix(), np.asarray(there.translation())


def transfer(
    sequence: SimulatedImages, pixels: Floats, start: tuple[int, int], end: tuple[int, int]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Where the walls seen at pixels of one (frame, camera) are seen in another one."""
    R, eye = camera_pose(sequence, *start)
    rays = np.column_stack(
        [sequence.rig.cameras[start[1]].camera.undistort(pixels), np.ones(len(pixels))]
    )
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ R.T
    hits = cast(sequence.flight.world, eye, rays.astype(np.float32))
    points = eye + rays * hits.distance[:, None].astype(np.float64)
    R, eye = camera_pose(sequence, *end)
    there = (points - eye) @ R
    camera = sequence.rig.cameras[end[1]].camera
    seen = camera.project(np.where(there[:, 2:] > 0.3, there, [0.0, 0.0, 1.0]))
    inside = np.all((seen > 15) & (seen < (camera.width - 15, camera.height - 15)), axis=1)
    return seen, inside & (there[:, 2] > 0.3) & ~sequence.flight.world.hidden(eye, points)


def track_error(sequence: SimulatedImages, start: tuple[int, int], end: tuple[int, int]) -> Floats:
    """How far corners tracked between two images are from where geometry puts them (N, 2)."""
    first, second = shot(sequence, start[0]), shot(sequence, end[0])
    a, b = first.images[start[1]], second.images[end[1]]
    assert a is not None
    assert b is not None
    corners = cv2.goodFeaturesToTrack(a, 250, 0.01, 12)[:, 0].astype(np.float64)
    expected, inside = transfer(sequence, corners, start, end)
    guess = expected[inside].astype(np.float32)[:, None]
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        a,
        b,
        corners[inside].astype(np.float32)[:, None],
        guess + np.float32(0.7),  # away from the truth: it must be found
        winSize=(15, 15),
        maxLevel=1,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3),
    )
    good = status[:, 0] == 1
    assert np.sum(good) > 120
    return np.asarray((found[:, 0] - expected[inside])[good])


@pytest.mark.parametrize(
    ("start", "end"), [((100, 0), (101, 0)), ((60, 1), (61, 1)), ((150, 0), (150, 1))]
)
def test_corners_are_tracked_to_where_geometry_puts_them(
    sequence: SimulatedImages, start: tuple[int, int], end: tuple[int, int]
) -> None:
    error = track_error(sequence, start, end)
    assert np.median(np.linalg.norm(error, axis=1)) < 0.1
    assert np.abs(np.median(error, axis=0)).max() < 0.02


def test_walls_are_closed_and_textured(sequence: SimulatedImages) -> None:
    for index in (0, 77, 200):
        for image in shot(sequence, index).images:
            assert image is not None
            assert image.shape == (480, 752)
            assert image.min() > 5  # every ray hits a wall, and none is black
            assert image.max() < 250
            assert image.std() > 15
            assert len(cv2.goodFeaturesToTrack(image, 500, 0.01, 10)) > 200


def test_points_hidden_for_tracks_are_hidden_in_images(sequence: SimulatedImages) -> None:
    _, eye = camera_pose(sequence, 120, 0)
    rng = np.random.default_rng(1)
    rays = rng.normal(size=(500, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    hits = cast(sequence.flight.world, eye, rays.astype(np.float32))
    assert np.all(hits.distance < 30.0)
    points = eye + rays * hits.distance[:, None].astype(np.float64)
    assert not sequence.flight.world.hidden(eye, points - 1e-4 * rays).any()


def test_exposure_changes_the_brightness_and_nothing_else() -> None:
    plain, changing = images(), images(exposure_change=0.3, exposure_period_s=4.0)
    ratios = []
    for index in range(20, 120, 25):
        a, b = shot(plain, index).images[0], shot(changing, index).images[0]
        assert a is not None
        assert b is not None
        ratio = b.astype(float) / a
        ratios.append(np.median(ratio))
        assert np.percentile(np.abs(ratio - ratios[-1]), 95) < 0.02
    assert min(ratios) < 0.8
    assert max(ratios) > 1.2


def test_noise_is_of_the_size_that_is_asked_for() -> None:
    plain, noisy = images(), images(noise_sigma=3.0)
    a, b = shot(plain, 50).images[0], shot(noisy, 50).images[0]
    assert a is not None
    assert b is not None
    assert np.std(b.astype(float) - a) == pytest.approx(3.0, abs=0.1)
    again = shot(noisy, 50).images[0]
    other = shot(noisy, 51).images[0]
    assert again is not None
    assert other is not None
    np.testing.assert_array_equal(b, again)
    assert np.mean(b == other) < 0.3


def test_motion_blurs_and_standing_still_does_not() -> None:
    sharp, blurred = images(), images(exposure_s=0.03)

    def detail(sequence: SimulatedImages, index: int) -> float:
        image = shot(sequence, index).images[0]
        assert image is not None
        return float(np.var(cv2.Laplacian(image, cv2.CV_64F)))

    assert detail(blurred, 110) < 0.7 * detail(sharp, 110)
    still, blurred_still = shot(sharp, 5).images[0], shot(blurred, 5).images[0]
    assert still is not None
    assert blurred_still is not None
    np.testing.assert_array_equal(still, blurred_still)


def test_what_a_fisheye_sees_beyond_the_camera_model_is_black() -> None:
    flight = images().flight
    rig = Rig((RigCamera(FISHEYE, gtsam.Pose3()),))
    sizes = [panel.size for panel in flight.world.panels]
    atlas = paint(sizes, [0.02] * len(sizes), 0)
    renderer = Renderer(rig, flight.world, atlas, ImageConfig(noise_sigma=0.0), 0)
    image = renderer.frame(flight.motion, int(flight.exposures_ns[100])).images[0]
    assert image is not None
    assert image[0, 0] == 0
    assert image[256, 256] > 0
    assert 0.5 < np.mean(image > 0) < 0.95
