# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of matching, prediction and rigs: on descriptors and motions that are known exactly."""

import sys
from dataclasses import replace

import cv2
import gtsam
import numpy as np
import pytest
from flight import Flight
from images import (
    BASELINE_M,
    CAMERA,
    CONFIG,
    FOCAL_PX,
    HEIGHT,
    MONO,
    STEREO,
    WIDTH,
    Spline,
    common,
    feed,
    painted,
    rotation,
    shift,
    transfer,
    view,
)

from slam_graph.errors import ConfigError
from slam_graph.frontend.frontend_config import DESCRIPTORS, FrontendConfig
from slam_graph.frontend.frontend_protocol import Feedback, build_frontend
from slam_graph.frontend.keypoints import Keypoints, spread
from slam_graph.frontend.matching import descriptor_distances, match
from slam_graph.frontend.prediction import ImuMotion
from slam_graph.frontend.stereo import reference_cameras
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import CameraFrame, ImuData
from slam_graph.sensors.rig import ImuNoise, Rig, RigCamera

S = 1_000_000_000


@pytest.fixture(scope="module")
def texture() -> Spline:
    return painted()


# --- matching ------------------------------------------------------------------------------------


def bits(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(0, 256, (count, 32), dtype=np.uint8)


def test_distances_are_those_of_opencv() -> None:
    rng = np.random.default_rng(0)
    a, b = bits(rng, 7), bits(rng, 5)
    expected = [[cv2.norm(x, y, cv2.NORM_HAMMING) for y in b] for x in a]
    np.testing.assert_array_equal(descriptor_distances(a, b), expected)
    a, b = rng.normal(size=(7, 64)).astype(np.float32), rng.normal(size=(5, 64)).astype(np.float32)
    expected = [[cv2.norm(x, y, cv2.NORM_L2) for y in b] for x in a]
    np.testing.assert_allclose(descriptor_distances(a, b), expected, rtol=1e-5)


def test_matches_are_found_in_any_order_and_only_in_the_window() -> None:
    rng = np.random.default_rng(1)
    wanted, places = bits(rng, 100), rng.uniform(0, 500, (100, 2)).astype(np.float32)
    order = rng.permutation(100)
    offered = wanted[order] ^ (rng.random((100, 32)) < 0.03).astype(np.uint8)
    moved = places[order] + np.float32(3.0)
    found = match(wanted, offered, places, moved, 64.0, search_radius_px=10.0)
    np.testing.assert_array_equal(order[found], np.arange(100))
    far = match(wanted, offered, places + np.float32(15.0), moved, 64.0, search_radius_px=10.0)
    assert np.all(far != found)


def test_ambiguous_matches_are_refused_and_no_keypoint_is_given_twice() -> None:
    rng = np.random.default_rng(2)
    one = bits(rng, 1)
    twins = np.concatenate([one, one ^ np.uint8(0)])
    at = np.zeros((2, 2), np.float32)
    apart = np.array([[0, 0], [8, 0]], np.float32)
    assert match(one, twins, at[:1], apart, 64.0, mutual=False)[0] == -1
    # the same corner found twice does not rival itself
    assert match(one, twins, at[:1], at, 64.0, mutual=False)[0] == 0
    other = one.copy()
    other[0, 0] ^= 1
    found = match(np.concatenate([other, one]), one, at, at[:1], 64.0, mutual=False)
    assert found.tolist() == [-1, 0]


@pytest.mark.parametrize("method", sorted(DESCRIPTORS))
@pytest.mark.parametrize("H", [shift(3.3, -2.7), rotation([0.01, -0.02, 0.01])], ids=["shift", "R"])
def test_descriptors_follow_the_known_motion(texture: Spline, method: str, H: np.ndarray) -> None:
    config = CONFIG.model_copy(update={"method": method, "fast_threshold": 10})
    first, second = feed(build_frontend(MONO, config), (view(texture),), (view(texture, H),))
    a, b = common(first.cameras[0], second.cameras[0])
    error = transfer(H, first.cameras[0].pixels[a]) - second.cameras[0].pixels[b]
    assert len(a) > 15
    # mahotas' blobs are found less exactly than the others
    assert np.median(np.linalg.norm(error, axis=1)) < (1.5 if method == "surf" else 1.0)
    assert np.mean(np.linalg.norm(error, axis=1) > 3.0) < 0.1


@pytest.mark.parametrize("method", sorted(DESCRIPTORS))
def test_images_without_keypoints_end_nothing(texture: Spline, method: str) -> None:
    black = np.zeros((HEIGHT, WIDTH), np.uint8)
    config = CONFIG.model_copy(update={"method": method, "fast_threshold": 10})
    images = [view(texture), black, black, view(texture), view(texture)]
    frames = feed(build_frontend(MONO, config), *[(image,) for image in images])
    counts = [len(frame.cameras[0]) for frame in frames]
    assert counts[1] == counts[2] == 0
    assert min(counts[3:]) > 15
    descriptor = DESCRIPTORS[method]()
    image, keypoints = images[0], Keypoints.concatenate([])
    _, none = descriptor.describe(image, keypoints)
    few = Keypoints.of(np.float32([[200.0, 150.0]]), np.ones(1, np.float32), 31.0)
    _, some = descriptor.describe(image, few)
    assert (none.shape, none.dtype) == ((0, some.shape[1]), some.dtype)


def test_a_feature_that_was_hidden_for_two_frames_is_found_again(texture: Spline) -> None:
    images = [view(texture, shift(2.0 * k, 0)) for k in range(6)]
    hidden = [image.copy() for image in images]
    for k in (3, 4):
        hidden[k][:, 160:320] = 128
    frontend = build_frontend(MONO, CONFIG.model_copy(update={"method": "orb"}))
    frames = feed(frontend, *[(image,) for image in hidden])
    assert frontend.frame_stats["recovered"] > 0
    a, b = common(frames[2].cameras[0], frames[5].cameras[0])
    gone = np.isin(frames[2].cameras[0].ids[a], frames[4].cameras[0].ids, invert=True)
    moved = frames[5].cameras[0].pixels[b] - frames[2].cameras[0].pixels[a]
    assert np.count_nonzero(gone) > 3
    assert np.median(np.linalg.norm(moved[gone] - (6.0, 0.0), axis=1)) < 1.0


@pytest.mark.parametrize(
    ("method", "module", "library"),
    [("surf", "mahotas.features.surf", "mahotas"), ("brief", "skimage.feature", "skimage")],
)
def test_a_missing_library_is_named_with_the_command_that_installs_it(
    method: str, module: str, library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigError, match=rf"needs {library}.*pip install 'slam-graph\[descript"):
        build_frontend(MONO, FrontendConfig(method=method))


def test_suppression_keeps_the_first_and_its_distance() -> None:
    pixels = np.random.default_rng(3).uniform(0, 100, (200, 2)).astype(np.float32)
    kept = spread(pixels, 50, 10.0)
    assert kept[0] == 0
    assert np.all(np.diff(kept) > 0)
    distance = np.linalg.norm(pixels[kept][:, None] - pixels[kept][None], axis=2)
    assert np.min(distance + 1e3 * np.eye(len(kept))) >= 10.0
    if len(kept) < 50:  # nothing that is left would have fitted
        all_px = np.linalg.norm(pixels[:, None] - pixels[kept][None], axis=2)
        assert np.max(np.min(all_px, axis=1)) < 10.0


# --- prediction ----------------------------------------------------------------------------------


def test_imu_motion_follows_a_flight() -> None:
    flight = Flight(gyro_bias=np.array([0.01, -0.02, 0.03]), accel_bias=np.array([0.1, 0, -0.1]))
    motion = ImuMotion(ImuNoise(), 9.81)
    motion.add(flight.imu(0.0, 2.0))
    assert motion.pose(S) is None
    motion.state = flight.nav_state(1.0)
    truth, start = flight.nav_state(1.1).world_T_body, flight.nav_state(1.0).world_T_body
    R = motion.rotation(S, round(1.1 * S))
    assert R is not None
    assert np.linalg.norm(R.logmap(start.rotation().between(truth.rotation()))) < 1e-4
    pose = motion.pose(round(1.1 * S))
    assert pose is not None
    assert np.linalg.norm(pose.logmap(truth)) < 1e-3
    assert motion.rotation(S, 3 * S) is None


def test_the_rotation_over_seconds_without_images_is_known() -> None:
    """Samples are kept since the oldest image whose features are looked for, up to a limit."""
    flight, motion = Flight(), ImuMotion(ImuNoise(), 9.81)
    for start_s in np.arange(0.0, 12.0, 0.5):
        motion.add(flight.imu(start_s, start_s + 0.5), min(round(start_s * S), 2 * S))
        assert (motion.rotation(2 * S, round((start_s + 0.5) * S)) is not None) == (start_s >= 2.0)
    start, end = flight.nav_state(2.0).world_T_body, flight.nav_state(12.0).world_T_body
    R = motion.rotation(2 * S, 12 * S)
    assert R is not None
    assert np.linalg.norm(R.logmap(start.rotation().between(end.rotation()))) < 1e-3
    motion.add(flight.imu(12.0, 14.5), 2 * S)
    assert motion.rotation(2 * S, round(14.5 * S)) is None
    motion.add(flight.imu(14.5, 15.0))
    assert motion.rotation(12 * S, 15 * S) is None


@pytest.mark.parametrize("gravity", [9.81, 1.62])
def test_imu_motion_is_the_prediction_of_the_back_end(gravity: float) -> None:
    """Both integrate alike, under the gravity of the settings."""
    flight = Flight(gyro_bias=np.array([0.01, -0.02, 0.03]), accel_bias=np.array([0.1, 0, -0.1]))
    motion, buffer, state = ImuMotion(ImuNoise(), gravity), ImuBuffer(), flight.nav_state(1.0)
    for start_s in (0.0, 0.5, 1.0):
        for taker in (motion, buffer):
            taker.add(flight.imu(start_s, start_s + 0.5))
    motion.state = state
    end_ns = round(1.3 * S)
    bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
    params = ImuNoise().preintegration_params(gravity)
    pim = buffer.between(S, end_ns).preintegrated(bias, params)
    pose, rotation = motion.pose(end_ns), motion.rotation(S, end_ns)
    assert pose is not None
    assert rotation is not None
    predicted = state.predicted(pim, end_ns).world_T_body
    np.testing.assert_array_equal(pose.matrix(), predicted.matrix())
    np.testing.assert_allclose(rotation.matrix(), pim.deltaRij().matrix(), atol=1e-6)
    fallen = flight.nav_state(1.3).world_T_body.translation() - pose.translation()
    np.testing.assert_allclose(fallen, [0, 0, 0.5 * (gravity - 9.81) * 0.3**2], atol=2e-3)


def gyro(rate: list[float], end_s: float) -> ImuData:
    stamps = np.arange(0, round(end_s * S) + 1, 5_000_000, dtype=np.int64)
    rows = np.tile(rate, (len(stamps), 1))
    return ImuData(stamps, rows, np.tile([0.0, 0.0, 9.81], (len(stamps), 1)))


@pytest.mark.parametrize("method", ["klt", "orb"])
def test_the_gyroscope_bridges_a_fast_rotation(texture: Spline, method: str) -> None:
    turn = [0.0, 0.0, 0.4]  # of points in the camera: 0.4 rad in one frame
    images = [view(texture), view(texture, rotation(turn))]
    tracked = {}
    for mode in ("none", "gyroscope"):
        config = CONFIG.model_copy(
            update={"prediction": mode, "method": method, "outliers": "none"}
        )
        frontend = build_frontend(MONO, config)
        samples = gyro([-angle / 0.05 for angle in turn], 0.05)
        first = frontend.track(CameraFrame(0, (images[0],)), samples[:1])
        second = frontend.track(CameraFrame(50_000_000, (images[1],)), samples[1:])
        a, b = common(first.cameras[0], second.cameras[0])
        H = rotation(turn)
        error = transfer(H, first.cameras[0].pixels[a]) - second.cameras[0].pixels[b]
        tracked[mode] = np.count_nonzero(np.linalg.norm(error, axis=1) < 2.0)
    assert tracked["gyroscope"] > 20
    assert tracked["gyroscope"] > 1.5 * tracked["none"]


def test_a_rejected_feature_is_dropped_if_so_configured(texture: Spline) -> None:
    for drop in (False, True):
        config = CONFIG.model_copy(update={"drop_rejected": drop})
        frontend = build_frontend(MONO, config)
        (before,) = feed(frontend, (view(texture),))
        rejected = before.cameras[0].ids[:10]
        frontend.receive_feedback(Feedback(rejected=rejected))
        after = frontend.track(CameraFrame(1, (view(texture, shift(1, 0)),)))
        assert np.any(np.isin(rejected, after.cameras[0].ids)) != drop
        assert frontend.frame_stats["rejected_gate"] == (10 if drop else 0)


def test_features_off_the_map_are_dropped(texture: Spline) -> None:
    config = CONFIG.model_copy(update={"map_check_px": 2.0})
    frontend = build_frontend(MONO, config)
    (first,) = feed(frontend, (view(texture),))
    seen = first.cameras[0]
    # a wall 2 m ahead; the body does not move, so neither does the image
    points = 2.0 * np.column_stack([seen.normalized, np.ones(len(seen))])
    points[:10, 0] += 0.2
    at_rest = Flight(position=np.zeros(3), angles=np.zeros(3))
    imu = at_rest.imu(0.0, 0.1)
    state = at_rest.nav_state(0.0)
    frontend.receive_feedback(Feedback(state, ids=seen.ids, points=points))
    second = frontend.track(CameraFrame(50_000_000, (view(texture),)), imu)
    assert frontend.frame_stats["rejected_map"] == 10
    assert not np.any(np.isin(seen.ids[:10], second.cameras[0].ids))
    assert np.mean(np.isin(seen.ids[10:], second.cameras[0].ids)) > 0.9


# --- rigs ----------------------------------------------------------------------------------------

BACKWARDS = gtsam.Rot3.Ry(np.pi)


def mounted(R: gtsam.Rot3, place: list[float]) -> RigCamera:
    return RigCamera(CAMERA, gtsam.Pose3(R, place))


def test_cameras_are_matched_to_one_that_sees_the_same() -> None:
    front, back = gtsam.Rot3(), BACKWARDS
    assert reference_cameras(STEREO) == (0, 0)
    opposite = Rig((mounted(front, [0, 0, 0]), mounted(back, [0, 0, 0])))
    assert reference_cameras(opposite) == (0, 1)
    two_pairs = Rig(
        (
            mounted(front, [0, 0, 0]),
            mounted(back, [0, 0, 0]),
            mounted(back, [0.1, 0, 0]),
            mounted(front, [0.1, 0, 0]),
        )
    )
    assert reference_cameras(two_pairs) == (0, 1, 1, 0)


def test_matches_come_back_when_the_calibration_is_corrected(texture: Spline) -> None:
    askew = replace(
        STEREO.cameras[1], body_T_camera=gtsam.Pose3(gtsam.Rot3.Rx(0.03), [BASELINE_M, 0, 0])
    )
    frontend = build_frontend(Rig((STEREO.cameras[0], askew)), CONFIG)
    pair = view(texture), view(texture, shift(-FOCAL_PX * BASELINE_M / 2.0, 0))
    wrong = feed(frontend, pair, pair)[-1]
    frontend.receive_feedback(Feedback(rig=STEREO))
    right = feed(frontend, pair, pair)[-1]
    expected = feed(build_frontend(STEREO, CONFIG), pair, pair)[-1]
    assert len(wrong.cameras[1]) < 0.2 * len(expected.cameras[1])
    assert len(right.cameras[1]) > 0.95 * len(expected.cameras[1])


@pytest.mark.parametrize("window_px", [17, 21])
@pytest.mark.parametrize(
    ("scale", "width"), [(0.5, WIDTH), (1.6, WIDTH), (1.0, WIDTH - 40)], ids=["half", "1.6", "cut"]
)
def test_a_camera_of_another_resolution_is_matched_like_one_of_the_same(
    texture: Spline, scale: float, width: int, window_px: int
) -> None:
    disparity_px = FOCAL_PX * BASELINE_M / 2.0
    size = round(scale * width), round(scale * HEIGHT)
    focal_px, middle = scale * FOCAL_PX, [scale * (c + 0.5) - 0.5 for c in (CAMERA.cx, CAMERA.cy)]
    camera = Camera(focal_px, focal_px, *middle, "none", (), *size)
    rig = Rig((STEREO.cameras[0], replace(STEREO.cameras[1], camera=camera)))
    seen = view(texture, shift(-disparity_px, 0))[:, :width]
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    pair = view(texture), seen if scale == 1.0 else cv2.resize(seen, size, interpolation=how)
    frontend = build_frontend(rig, CONFIG.model_copy(update={"window_px": window_px}))
    left, right = feed(frontend, pair, pair)[-1].cameras
    a, b = common(left, right)
    there = left.pixels[:, 0] - disparity_px
    assert len(b) > 0.9 * np.count_nonzero((there > 15) & (there < width - 15))
    error = (left.pixels[a] - (disparity_px, 0) + 0.5) * scale - 0.5 - right.pixels[b]
    assert np.median(np.linalg.norm(error, axis=1)) < 0.1
    np.testing.assert_allclose(right.normalized, camera.undistort(right.pixels), atol=1e-6)


def test_a_camera_that_looks_elsewhere_has_features_of_its_own(texture: Spline) -> None:
    rig = Rig(
        (
            mounted(gtsam.Rot3(), [0, 0, 0]),
            mounted(BACKWARDS, [0, 0, 0]),
            mounted(gtsam.Rot3(), [0.1, 0, 0]),
        )
    )
    other, disparity_px = painted(8), FOCAL_PX * 0.1 / 2.0
    frames = feed(
        build_frontend(rig, CONFIG),
        *[
            (
                view(texture, shift(2.0 * k, 0)),
                view(other, shift(-3.0 * k, 0)),
                view(texture, shift(2.0 * k - disparity_px, 0)),
            )
            for k in range(3)
        ],
    )
    for frame in frames:
        front, back, right = (set(seen.ids.tolist()) for seen in frame.cameras)
        assert min(len(front), len(back)) > 80
        assert not front & back
        assert right <= front
        assert len(right) > 50
    for camera, step in ((0, 4.0), (1, -6.0)):
        a, b = common(frames[0].cameras[camera], frames[2].cameras[camera])
        moved = frames[2].cameras[camera].pixels[b] - frames[0].cameras[camera].pixels[a]
        assert len(a) > 60
        assert np.median(np.linalg.norm(moved - (step, 0.0), axis=1)) < 0.1
