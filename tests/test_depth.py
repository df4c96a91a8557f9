# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Depth: registration, its value at features, its noise in simulations and on a real recording."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import chi2

from slam_graph.datasets import open_dataset
from slam_graph.datasets.streams.depth_images import Registration, nearest_in_time
from slam_graph.datasets.streams.pairing import ABSENT
from slam_graph.errors import DataError
from slam_graph.frontend import build_frontend
from slam_graph.frontend.depth_sampling import sample_depth
from slam_graph.geometry import Trajectory
from slam_graph.sensors import (
    Camera,
    CameraFrame,
    DepthSensor,
    FeatureFrame,
    FeatureObservations,
    Rig,
    RigCamera,
)
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedImages

Floats = NDArray[np.float64]

PINHOLE = Camera(300.0, 310.0, 159.5, 119.5, "none", (), 320, 240)
DEPTH_LENS = Camera(200.0, 200.0, 127.5, 95.5, "none", (), 256, 192)
SENSOR = DepthSensor()
"""Of the default noise."""


def rays_of(camera: Camera) -> Floats:
    """(height, width, 3) on the plane z = 1."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    plane = camera.undistort(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    return np.column_stack([plane, np.ones(len(plane))]).reshape(camera.height, camera.width, 3)


def test_what_is_no_depth_is_never_one() -> None:
    """Neither 0, whatever the range, nor what 16 bits do not hold; all else is kept."""
    sensor = DepthSensor(scale=10_000.0, min_m=0.0, max_m=20.0)
    assert np.isnan(sensor.metres(np.zeros((1, 2), np.uint16))).all()
    assert np.isnan(sensor.metres(np.array([[0.0, -1.0, np.nan, 21.0]], np.float32))).all()
    depth = np.array([[1e-4, 5.0, 6.5535, 6.5537, 9.9, np.inf, np.nan, 1e-6]], np.float32)
    again = sensor.metres(sensor.raw(depth))
    np.testing.assert_allclose(again[0, :3], depth[0, :3], atol=1e-6)
    assert np.isnan(again[0, 3:]).all()


def plane_depth(camera: Camera, normal: Floats, distance: float) -> NDArray[np.float32]:
    """Depth image of the plane normal · x = distance in the frame of a camera."""
    return (distance / (rays_of(camera) @ normal)).astype(np.float32)


# --- registration ---------------------------------------------------------------------------------


def test_registration_to_itself_changes_nothing() -> None:
    depth = plane_depth(PINHOLE, np.array([0.3, -0.2, 0.9]), 2.0)
    depth[50:60, 70:90] = np.nan
    registered = Registration(PINHOLE, PINHOLE, gtsam.Pose3()).register(depth)
    np.testing.assert_allclose(registered, depth, rtol=1e-6)


def test_registered_plane_is_the_plane_seen_by_the_camera() -> None:
    """A wall at a slant, 3 cm and 4° away: no gaps, and as exact as half a pixel of the depth."""
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, 0.07, -0.03), np.array([0.03, -0.01, 0.005]))
    normal, distance = np.array([0.3, -0.2, 0.9]), 2.0
    R, t = pose.rotation().matrix(), pose.translation()
    measured = plane_depth(DEPTH_LENS, R.T @ normal, distance - float(normal @ t))
    registered = Registration(DEPTH_LENS, PINHOLE, pose).register(measured)
    exact = plane_depth(PINHOLE, normal, distance)
    inside = np.isfinite(registered)
    rays = rays_of(PINHOLE)
    back = (rays * exact[:, :, None] - t) @ R
    pixels = back[:, :, :2] / back[:, :, 2:] * DEPTH_LENS.fx + [DEPTH_LENS.cx, DEPTH_LENS.cy]
    covered = np.all((pixels > 1) & (pixels < [DEPTH_LENS.width - 2, DEPTH_LENS.height - 2]), 2)
    assert covered.mean() > 0.5
    assert inside[covered].all()
    slope = np.max(np.abs(np.stack(np.gradient(exact))), axis=0)
    # a point stands for what its own pixel covers, 1.5 pixels of the camera, or half of it
    assert np.all(np.abs(registered - exact)[inside] <= 2.0 * slope[inside] + 1e-6)


def test_the_nearest_surface_hides_the_others() -> None:
    """A board at 1 m in front of a wall at 3 m: at no pixel that the board is seen at, the wall."""
    measured = np.full((DEPTH_LENS.height, DEPTH_LENS.width), 3.0, np.float32)
    measured[60:130, 80:180] = 1.0
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.0]))
    registered = Registration(DEPTH_LENS, PINHOLE, pose).register(measured)
    rays = rays_of(PINHOLE)
    u = (rays[:, :, 0] - 0.1) * DEPTH_LENS.fx + DEPTH_LENS.cx  # of a point at 1 m
    v = rays[:, :, 1] * DEPTH_LENS.fy + DEPTH_LENS.cy
    board = (u > 80) & (u < 179) & (v > 60) & (v < 129)
    assert board.any()
    np.testing.assert_allclose(registered[board], 1.0)
    assert set(np.unique(registered[np.isfinite(registered)]).tolist()) == {1.0, 3.0}


# --- depth at features ----------------------------------------------------------------------------


def test_depth_of_a_plane_is_exact_between_pixels() -> None:
    normal = np.array([0.4, -0.3, 0.8])
    depth = plane_depth(PINHOLE, normal, 2.0)
    places = np.random.default_rng(1).uniform([4, 4], [314, 234], (500, 2))
    found, sigma = sample_depth(places, depth, SENSOR)
    rays = np.column_stack([PINHOLE.undistort(places), np.ones(len(places))])
    np.testing.assert_allclose(found, 2.0 / (rays @ normal), rtol=1e-6)
    assert np.all(sigma >= SENSOR.sigma_m(found))  # the slant adds to the noise


def test_a_wall_ahead_has_the_noise_of_the_sensor() -> None:
    _, sigma = sample_depth(np.array([[100.0, 100.0]]), np.full((240, 320), 2.0, "f4"), SENSOR)
    np.testing.assert_allclose(sigma, SENSOR.sigma_m(np.array([2.0])), rtol=1e-9)


def test_edges_holes_and_borders_have_no_depth() -> None:
    depth = np.full((240, 320), 2.0, np.float32)
    depth[:, 160:] = 1.5
    depth[100:110, 40:50] = np.nan
    around_edge = np.column_stack([np.linspace(158.6, 160.9, 20), np.full(20, 60.3)])
    in_hole = np.array([[44.5, 104.5], [40.0, 104.0], [39.4, 104.0]])
    at_border = np.array([[0.5, 50.0], [319.0, 50.0], [50.0, 238.9], [-3.0, 50.0], [np.nan, 50.0]])
    for places in (around_edge, in_hole, at_border):
        found, sigma = sample_depth(places, depth, SENSOR)
        assert np.isnan(found).all()
        assert np.isnan(sigma).all()
    beside = np.array([[155.0, 60.0], [165.0, 60.0], [30.0, 104.0]])
    np.testing.assert_allclose(sample_depth(beside, depth, SENSOR)[0], [2.0, 1.5, 2.0])


def test_one_wrong_pixel_is_recognised() -> None:
    depth = np.full((240, 320), 2.0, np.float32)
    off = 8.0 * float(SENSOR.sigma_m(np.array([2.0]))[0])
    depth[101, 99] += off
    assert np.isnan(sample_depth(np.array([[100.0, 100.0]]), depth, SENSOR)[0]).all()


def test_features_keep_their_depth() -> None:
    ids = np.arange(4, dtype=np.int64)
    depth = np.array([1.0, np.nan, 2.0, 3.0])
    seen = FeatureObservations(ids, np.ones((4, 2)), np.ones((4, 2)), None, depth, 0.1 * depth)
    frame = FeatureFrame(0, (seen, replace(seen, depth_m=None, depth_sigma_m=None)))
    usable, bad = frame.usable(3)
    assert bad == 0  # a feature without depth is a feature
    for kept, rows in (
        (usable, ids),
        (frame.without(ids[:1]), ids[1:]),
        (frame.only(ids[2:]), ids[2:]),
    ):
        left = kept.cameras[0]
        assert left.depth_m is not None
        assert left.depth_sigma_m is not None
        np.testing.assert_array_equal(left.depth_m, depth[rows])
        np.testing.assert_array_equal(left.depth_sigma_m, 0.1 * depth[rows])
        assert kept.cameras[1].depth_m is None
    broken = replace(seen, pixels=np.array([[1.0, 1.0], [np.nan, 1.0], [1.0, 1.0], [1.0, 1.0]]))
    left = FeatureFrame(0, (broken,)).usable(1)[0].cameras[0]
    assert left.depth_m is not None
    np.testing.assert_array_equal(left.depth_m, depth[[0, 2, 3]])


def test_depth_of_another_size_is_refused() -> None:
    rig = Rig((RigCamera(PINHOLE, gtsam.Pose3()),), has_imu=False, depth=SENSOR)
    image = np.zeros((240, 320), np.uint8)
    frame = CameraFrame(0, (image,), np.ones((120, 160), np.float32))
    with pytest.raises(DataError, match="depth image has shape"):
        build_frontend(rig).track(frame)


# --- pairing --------------------------------------------------------------------------------------


def test_each_depth_image_is_of_its_nearest_frame_only() -> None:
    frames = np.array([0, 33, 66, 100, 133], np.int64) * 1_000_000
    depths = np.array([4, 64, 69, 118], np.int64) * 1_000_000
    index = nearest_in_time(frames, depths)
    # 118 is 18 ms from 100 and 15 ms from 133; 33 has none within 20 ms
    np.testing.assert_array_equal(index, [0, ABSENT, 1, ABSENT, 3])
    assert np.all(nearest_in_time(frames, np.zeros(0, np.int64)) == ABSENT)
    np.testing.assert_array_equal(nearest_in_time(frames[:1], depths[:1]), [0])


# --- simulations ----------------------------------------------------------------------------------


def test_simulated_tracks_measure_the_depth_with_the_noise_they_say() -> None:
    """The same flight with exact and with noisy depth; pixels do not change."""
    common = {"duration_s": 4.0, "with_imu": False, "seed": 3}
    plain = simulate(**common)
    exact = simulate(depth={"sensor": "stereo", "noise_scale": 0.0}, **common)
    noisy = simulate(depth={"sensor": "stereo"}, **common)
    assert not plain.info().has_depth
    assert (noisy.info().has_depth, noisy.info().has_imu, noisy.info().imu_samples) == (
        True,
        False,
        0,
    )
    errors, compared = [], 0
    for packets in zip(plain.packets(), exact.packets(), noisy.packets(), strict=True):
        frames = [packet.frame for packet in packets]
        assert len(packets[2].imu) == 0
        seen = [frame.cameras[0] for frame in frames if isinstance(frame, FeatureFrame)]
        for one in seen[1:]:
            np.testing.assert_array_equal(seen[0].pixels, one.pixels)
        assert seen[0].depth_m is None
        assert seen[1].depth_m is not None
        assert seen[2].depth_m is not None
        assert seen[2].depth_sigma_m is not None
        known = np.isfinite(seen[1].depth_m) & np.isfinite(seen[2].depth_m)
        compared += int(known.sum())
        truth = seen[1].depth_m[known]
        errors.append((seen[2].depth_m[known] - truth) / SENSOR.sigma_m(truth))
    every = np.concatenate(errors)
    assert compared > 5000
    low, high = chi2.ppf([1e-4, 1 - 1e-4], len(every)) / len(every)
    assert low < np.mean(every**2) < high


def test_simulated_depth_is_that_of_the_landmark() -> None:
    """Exact depth and pixel of a landmark give the same point of the world in all frames."""
    sequence = simulate(
        duration_s=2.0,
        depth={"sensor": "kinect", "noise_scale": 0.0},
        tracks={"pixel_sigma": 0.0},
        shutter_readout_s=0.02,
    )
    camera = sequence.rig.cameras[0]
    first: dict[int, Floats] = {}
    for packet in sequence.packets():
        assert isinstance(packet.frame, FeatureFrame)
        seen = packet.frame.cameras[0]
        assert seen.depth_m is not None
        seconds = camera.row_times_s(seen.pixels[:, 1])
        stamps = packet.frame.stamp_ns + np.round(1e9 * seconds).astype(np.int64)
        R = sequence.flight.motion.rotations(stamps).as_matrix()
        p = sequence.flight.motion.positions(stamps)
        local = np.column_stack([seen.normalized, np.ones(len(seen))]) * seen.depth_m[:, None]
        body = local @ camera.body_T_camera.rotation().matrix().T
        body += camera.body_T_camera.translation()
        world = np.einsum("nij,nj->ni", R, body) + p
        for feature, point in zip(seen.ids.tolist(), world, strict=True):
            if np.isfinite(point).all():
                np.testing.assert_allclose(point, first.setdefault(feature, point), atol=2e-3)
    assert len(first) > 150


def rendered(noise_scale: float, seed: int = 0) -> SimulatedImages:
    sequence = simulate(
        kind="images",
        cameras=1,
        duration_s=1.0,
        rate_hz=5.0,
        seed=seed,
        depth={"sensor": "kinect", "noise_scale": noise_scale},
    )
    assert isinstance(sequence, SimulatedImages)
    return sequence


def test_rendered_depth_at_features_has_the_standard_deviation_it_says() -> None:
    """What the front end takes from noisy depth images, against exact ones at the same pixels."""
    errors = []
    for seed in range(2):
        noisy, exact = rendered(1.0, seed), rendered(0.0, seed)
        frontend = build_frontend(noisy.rig)
        assert noisy.rig.depth is not None
        for one, other in zip(noisy.frames(), exact.frames(), strict=True):
            assert isinstance(one, CameraFrame)
            assert isinstance(other, CameraFrame)
            assert other.depth is not None
            seen = frontend.track(one).cameras[0]
            assert seen.depth_m is not None
            assert seen.depth_sigma_m is not None
            truth, _ = sample_depth(seen.pixels, other.depth, noisy.rig.depth)
            known = np.isfinite(truth) & np.isfinite(seen.depth_m)
            assert known.mean() > 0.8
            errors.append((seen.depth_m - truth)[known] / noisy.rig.depth.sigma_m(truth[known]))
    every = np.concatenate(errors)
    assert len(every) > 1000
    assert 0.85 < np.std(every) < 1.05  # interpolation averages four pixels that are alike
    assert abs(np.mean(every)) < 0.2


# --- a real recording -----------------------------------------------------------------------------


def pose_at(truth: Trajectory, stamp_ns: int) -> tuple[Floats, Floats]:
    """Rotation and position of the body, interpolated."""
    k = int(np.clip(np.searchsorted(truth.stamps_ns, stamp_ns), 1, len(truth.stamps_ns) - 1))
    span = truth.stamps_ns[k] - truth.stamps_ns[k - 1]
    part = float((stamp_ns - truth.stamps_ns[k - 1]) / span)
    turn = Slerp([0.0, 1.0], Rotation.from_quat(truth.quaternions[k - 1 : k + 1]))(part)
    return turn.as_matrix(), (1 - part) * truth.positions[k - 1] + part * truth.positions[k]


@pytest.mark.slow
def test_real_depths_and_true_motion_predict_each_other(data_dir: Path) -> None:
    """TUM RGB-D: depths of a feature in two frames agree through the motion-captured path.

    In the median as exactly as their standard deviations say (0.67 of them, Gaussian noise), and
    they are not off as a whole, as they would be with a wrong scale.
    """
    sequence = open_dataset(data_dir / "tum_rgbd" / "freiburg1_rpy_12s")
    truth = sequence.groundtruth()
    assert truth is not None
    assert sequence.info().depth_frames == sequence.info().frames == 180
    frontend = build_frontend(sequence.rig)
    errors, ratios = [], []
    before: tuple[FeatureObservations, Floats, Floats] | None = None
    for packet in sequence.packets():
        seen = frontend.track(packet.frame).cameras[0]
        R, p = pose_at(truth, packet.frame.stamp_ns)
        if before is not None:
            old, old_R, old_p = before
            _, there, here = np.intersect1d(old.ids, seen.ids, return_indices=True)
            assert old.depth_m is not None
            assert old.depth_sigma_m is not None
            assert seen.depth_m is not None
            assert seen.depth_sigma_m is not None
            rays = np.column_stack([old.normalized[there], np.ones(len(there))])
            points = rays * old.depth_m[there, None] @ old_R.T + old_p
            predicted = ((points - p) @ R)[:, 2]
            error = predicted - seen.depth_m[here]
            sigma = np.hypot(old.depth_sigma_m[there], seen.depth_sigma_m[here])
            known = np.isfinite(error)
            errors.append((error / sigma)[known])
            ratios.append((predicted / seen.depth_m[here])[known])
        before = (seen, R, p)
    every = np.concatenate(errors)
    assert len(every) > 5000
    assert 0.5 < np.median(np.abs(every)) < 0.85
    assert abs(np.median(np.concatenate(ratios)) - 1.0) < 1e-3
