# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the front end on images whose motion is known exactly."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from images import (
    BASELINE_M,
    CAMERA,
    CONFIG,
    FOCAL_PX,
    HEIGHT,
    MONO,
    STEREO,
    WIDTH,
    Image,
    Spline,
    common,
    feed,
    painted,
    rotation,
    shift,
    transfer,
    view,
)
from numpy.typing import NDArray
from pydantic import ValidationError

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError
from slam_graph.frontend.frontend_config import DETECTORS, FrontendConfig
from slam_graph.frontend.frontend_protocol import build_frontend
from slam_graph.frontend.lucas_kanade import LucasKanade
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.depth import DepthSensor
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame, FeatureObservations, ImuData
from slam_graph.sensors.rig import Rig, RigCamera


@pytest.fixture(scope="module")
def texture() -> Spline:
    return painted()


@pytest.mark.parametrize("detector", sorted(DETECTORS))
@pytest.mark.parametrize(
    "H",
    [shift(0, 0), shift(3.3, -2.7), shift(-17.4, 9.6), rotation([0.01, -0.02, 0.01])],
    ids=["still", "small shift", "large shift", "rotation"],
)
def test_tracked_points_follow_the_known_motion(
    texture: Image, H: NDArray[np.float64], detector: str
) -> None:
    config = CONFIG.model_copy(update={"detector": detector})
    first, second = feed(build_frontend(MONO, config), (view(texture),), (view(texture, H),))
    a, b = common(first.cameras[0], second.cameras[0])
    error = transfer(H, first.cameras[0].pixels[a]) - second.cameras[0].pixels[b]
    distance = np.linalg.norm(error, axis=1)
    assert len(a) > 0.75 * len(first.cameras[0])
    assert np.median(distance) < 0.05
    assert np.max(distance) < 0.5


def test_a_long_track_does_not_drift(texture: Spline) -> None:
    motions = [shift(0.9 * k, -0.4 * k) for k in range(20)]
    frames = feed(build_frontend(MONO, CONFIG), *[(view(texture, H),) for H in motions])
    a, b = common(frames[0].cameras[0], frames[-1].cameras[0])
    error = transfer(motions[-1], frames[0].cameras[0].pixels[a]) - frames[-1].cameras[0].pixels[b]
    assert len(a) > 60
    assert np.median(np.linalg.norm(error, axis=1)) < 0.2


@pytest.mark.parametrize("depth_m", [0.5, 2.0, 20.0])
def test_stereo_finds_the_disparity_of_a_plane(texture: Spline, depth_m: float) -> None:
    disparity_px = FOCAL_PX * BASELINE_M / depth_m
    right = view(texture, shift(-disparity_px, 0))
    (frame,) = feed(build_frontend(STEREO, CONFIG), (view(texture), right))
    left, other = frame.cameras
    a, b = common(left, other)
    assert np.all(np.isin(other.ids, left.ids))
    visible = np.count_nonzero(left.pixels[:, 0] > disparity_px + 15)
    assert len(b) > 0.9 * visible
    error = left.pixels[a] - (disparity_px, 0) - other.pixels[b]
    assert np.median(np.linalg.norm(error, axis=1)) < 0.05


def test_a_rotated_second_camera_is_searched_where_its_calibration_says(texture: Spline) -> None:
    right_R_left = gtsam.Rot3.Expmap(np.array([0.03, -0.1, 0.02]))
    pose = gtsam.Pose3(right_R_left.inverse(), [BASELINE_M, 0, 0])
    rig = Rig((STEREO.cameras[0], RigCamera(CAMERA, pose)))
    # A plane 1 m in front of the left camera, z = 1: H = K (R + t nᵀ) K⁻¹
    t = -right_R_left.matrix() @ [BASELINE_M, 0, 0]
    plane = right_R_left.matrix() + np.outer(t, [0, 0, 1.0])
    H = CAMERA.K @ plane @ np.linalg.inv(CAMERA.K)
    (frame,) = feed(build_frontend(rig, CONFIG), (view(texture), view(texture, H)))
    a, b = common(*frame.cameras)
    assert len(a) > 50
    error = transfer(H, frame.cameras[0].pixels[a]) - frame.cameras[1].pixels[b]
    # The windows of Lucas-Kanade do not deform with the view, which costs a little accuracy
    assert np.median(np.linalg.norm(error, axis=1)) < 0.25


def test_points_that_move_on_their_own_are_rejected(texture: Spline) -> None:
    # Points on two planes that pass by at different speeds, so the epipolar geometry is determined
    first = view(texture)
    second = view(texture, shift(4.0, 0.0))
    second[:, 240:] = view(texture, shift(8.0, 0.0))[:, 240:]
    second[120:200, 100:200] = view(texture, shift(4.0, 7.0))[120:200, 100:200]
    frontend = build_frontend(MONO, CONFIG)
    a, b = feed(frontend, (first,), (second,))
    in_a, in_b = common(a.cameras[0], b.cameras[0])
    motion = b.cameras[0].pixels[in_b] - a.cameras[0].pixels[in_a]
    assert frontend.frame_stats["rejected_ransac"] >= 3
    (outliers,) = b.outliers  # for those who watch
    assert len(outliers) == frontend.frame_stats["rejected_ransac"]
    assert np.isin(outliers.ids, a.cameras[0].ids).all()
    assert not np.isin(outliers.ids, b.cameras[0].ids).any()
    assert np.max(np.abs(motion[:, 1])) < 1.5


@pytest.mark.parametrize("seed", range(4))
def test_no_feature_goes_on_in_another_place(texture: Spline, seed: int) -> None:
    """What seems to is a chance match, and the IMU tells the motion better."""
    images = [*(view(texture, shift(2.0 * k, k)) for k in range(3)), view(painted(seed + 10))]
    kept: dict[bool, list[int]] = {}
    for has_imu in (True, False):
        frontend = build_frontend(replace(MONO, has_imu=has_imu), CONFIG)
        frames = [
            frontend.track(CameraFrame(k * 50_000_000, (image,)), resting((k - 1) * 50_000_000))
            for k, image in enumerate(images)
        ]
        kept[has_imu] = [len(common(a.cameras[0], b.cameras[0])[0]) for a, b in pairwise(frames)]
    assert min(kept[True][:2]) > 60
    assert kept[True][2] == 0 < kept[False][2]


def resting(start_ns: int) -> ImuData:
    """Samples of 50 ms at rest."""
    stamps = start_ns + np.arange(0, 55_000_000, 5_000_000)
    return ImuData(stamps, np.zeros((11, 3)), np.tile([0.0, 0.0, 9.81], (11, 1)))


def test_ids_are_unique_and_never_come_back(texture: Spline) -> None:
    frames = feed(
        build_frontend(MONO, CONFIG), *[(view(texture, shift(6.0 * k, 0)),) for k in range(16)]
    )
    gone: set[int] = set()
    alive: set[int] = set()
    newest = -1
    for frame in frames:
        ids = frame.cameras[0].ids
        assert len(set(ids.tolist())) == len(ids)
        assert np.all(np.diff(ids) > 0)
        assert not gone & set(ids.tolist())
        fresh = [i for i in ids.tolist() if i not in alive]
        assert min(fresh, default=newest + 1) > newest
        newest = max(newest, *ids.tolist())
        gone |= alive - set(ids.tolist())
        alive = set(ids.tolist())
    assert gone


def test_normalized_coordinates_belong_to_the_pixels(texture: Spline) -> None:
    radtan = Camera(300, 301, 240, 160, "radtan", (-0.28, 0.07, 2e-4, 1e-4), WIDTH, HEIGHT)
    rig = Rig((RigCamera(radtan, gtsam.Pose3()),))
    frames = feed(build_frontend(rig, CONFIG), (view(texture),), (view(texture, shift(2, 1)),))
    for frame in frames:
        seen = frame.cameras[0]
        np.testing.assert_allclose(radtan.distort(seen.normalized)[0], seen.pixels, atol=1e-6)


def test_features_spread_over_the_image_and_keep_their_distance(texture: Spline) -> None:
    (frame,) = feed(build_frontend(MONO, CONFIG), (view(texture),))
    pixels = frame.cameras[0].pixels
    assert len(pixels) == CONFIG.max_features
    cells = set(
        zip((pixels[:, 0] // 80).astype(int), (pixels[:, 1] // 80).astype(int), strict=True)
    )
    assert len(cells) == 24
    distance = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    assert np.min(distance + 1e3 * np.eye(len(pixels))) > CONFIG.min_distance_px - 1.0


def test_same_input_and_seed_give_the_same_output(texture: Spline) -> None:
    images = [
        (view(texture, shift(3.0 * k, k)), view(texture, shift(3.0 * k - 20, k))) for k in range(6)
    ]
    one, two = (feed(build_frontend(STEREO, CONFIG, seed=5), *images) for _ in range(2))
    for a, b in zip(one, two, strict=True):
        for seen, again in zip(a.cameras, b.cameras, strict=True):
            np.testing.assert_array_equal(seen.ids, again.ids)
            np.testing.assert_array_equal(seen.pixels, again.pixels)
            np.testing.assert_array_equal(seen.normalized, again.normalized)


def test_a_missing_right_image_costs_no_left_track(texture: Spline) -> None:
    left = [view(texture, shift(2.0 * k, 0)) for k in range(3)]
    right = [view(texture, shift(2.0 * k - 15, 0)) for k in range(3)]
    whole = feed(build_frontend(STEREO, CONFIG), *zip(left, right, strict=True))
    broken = feed(
        build_frontend(STEREO, CONFIG), (left[0], right[0]), (left[1], None), (left[2], right[2])
    )
    assert len(broken[1].cameras[1]) == 0
    for a, b in zip(whole, broken, strict=True):
        np.testing.assert_array_equal(a.cameras[0].ids, b.cameras[0].ids)
    assert len(broken[2].cameras[1]) > 0.95 * len(whole[2].cameras[1])


def test_tracks_survive_a_missing_left_image(texture: Spline) -> None:
    left = [view(texture, shift(2.0 * k, 0)) for k in range(3)]
    right = [view(texture, shift(2.0 * k - 15, 0)) for k in range(3)]
    frames = feed(
        build_frontend(STEREO, CONFIG), (left[0], right[0]), (None, right[1]), (left[2], right[2])
    )
    assert len(frames[1].cameras[0]) == 0
    assert len(frames[1].cameras[1]) > 0.9 * len(frames[0].cameras[1])
    for camera in (0, 1):
        a, b = common(frames[0].cameras[camera], frames[2].cameras[camera])
        assert len(a) > 0.9 * len(frames[0].cameras[camera])
        motion = frames[2].cameras[camera].pixels[b] - frames[0].cameras[camera].pixels[a]
        assert np.median(np.linalg.norm(motion - (4.0, 0.0), axis=1)) < 0.1


def test_a_right_camera_goes_on_alone_when_the_left_one_is_lost(texture: Spline) -> None:
    """It finds features of its own, and leaves them when both have images again."""
    count = 40  # the view moves on by half of the image
    left = [view(texture, shift(-0.0125 * WIDTH * k, 0)) for k in range(count)]
    right = [view(texture, shift(-0.0125 * WIDTH * k - 15, 0)) for k in range(count)]
    lost = range(2, count - 2)
    pairs = [(None if k in lost else left[k], right[k]) for k in range(count)]
    frames = feed(build_frontend(STEREO, CONFIG), *pairs)
    whole = len(frames[1].cameras[0])
    assert all(len(frames[k].cameras[0]) == 0 for k in lost)
    assert min(len(frames[k].cameras[1]) for k in lost[2:]) > 0.8 * whole
    own = {i for k in lost for i in frames[k].cameras[1].ids.tolist()}
    own -= {i for frame in frames[:2] for i in frame.cameras[0].ids.tolist()}
    assert len(frames[-1].cameras[0]) > 0.8 * whole
    for frame in frames[-2:]:
        assert set(frame.cameras[1].ids) <= set(frame.cameras[0].ids)
        assert own.isdisjoint(frame.cameras[0].ids)


def test_a_frame_without_any_image_is_empty_and_harmless(texture: Spline) -> None:
    images = [view(texture, shift(k, 0)) for k in range(3)]
    frames = feed(
        build_frontend(STEREO, CONFIG),
        (None, None),
        (images[0], None),
        (None, None),
        (images[2], None),
    )
    assert [len(frames[k].cameras[0]) for k in (0, 2)] == [0, 0]
    a, _ = common(frames[1].cameras[0], frames[3].cameras[0])
    assert len(a) > 0.9 * len(frames[1].cameras[0])


def test_a_black_image_yields_nothing_and_is_reported(texture: Spline) -> None:
    diagnostics = Diagnostics()
    frontend = build_frontend(MONO, CONFIG, diagnostics=diagnostics)
    black = np.zeros((HEIGHT, WIDTH), np.uint8)
    frames = feed(frontend, (view(texture),), (black,), (view(texture),))
    assert len(frames[1].cameras[0]) == 0
    assert diagnostics.counts["few_features"] == 1
    assert np.min(frames[2].cameras[0].ids) > np.max(frames[0].cameras[0].ids)


def test_no_feature_lies_where_the_mask_is_black(texture: Spline, tmp_path: Path) -> None:
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :200] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    config = CONFIG.model_copy(update={"masks": (tmp_path / "mask.png", None)})
    frontend = build_frontend(STEREO, config)
    motions = [shift(-5.0 * k, 0) for k in range(4)]
    frames = feed(frontend, *[(view(texture, H), view(texture, H)) for H in motions])
    assert all(np.min(frame.cameras[0].pixels[:, 0]) > 199 for frame in frames)
    assert frontend.frame_stats["lost_mask"] > 0


def test_dropped_features_do_not_come_back(texture: Spline) -> None:
    frontend = build_frontend(STEREO, CONFIG)
    images = [(view(texture, shift(k, 0)), view(texture, shift(k - 15, 0))) for k in range(2)]
    before = frontend.track(CameraFrame(0, images[0]))
    rejected = before.cameras[0].ids[::3]
    frontend.drop(rejected)
    after = frontend.track(CameraFrame(1, images[1]))
    for seen in after.cameras:
        assert not np.any(np.isin(seen.ids, rejected))
    assert np.any(np.isin(before.cameras[0].ids, after.cameras[0].ids))


@pytest.mark.parametrize(("equalization", "gain"), [("histogram", 0.5), ("clahe", 1.0)])
def test_equalization_bridges_a_change_of_exposure(
    texture: Spline, equalization: str, gain: float
) -> None:
    # CLAHE limits contrast, so it takes out a change of brightness but not all of one of gain
    dim = (gain * view(texture, shift(2.0, 1.0)).astype(float)).clip(0, 215) + 40
    config = CONFIG.model_copy(update={"equalization": equalization})
    images = (view(texture),), (dim.astype(np.uint8),)
    first, second = feed(build_frontend(MONO, config), *images)
    a, b = common(first.cameras[0], second.cameras[0])
    assert len(a) > 0.75 * len(first.cameras[0])
    motion = second.cameras[0].pixels[b] - first.cameras[0].pixels[a]
    assert np.median(np.linalg.norm(motion - (2.0, 1.0), axis=1)) < 0.15


def test_every_feature_of_a_frame_has_one_fate(texture: Spline) -> None:
    frontend = build_frontend(MONO, CONFIG)
    before = frontend.track(CameraFrame(0, (view(texture),)))
    after = frontend.track(CameraFrame(1, (view(texture, rotation([0.02, 0.05, 0.1])),)))
    stats = frontend.frame_stats
    lost = sum(v for k, v in stats.items() if k.startswith("lost_")) + stats["rejected_ransac"]
    assert stats["tracked"] + lost == len(before.cameras[0])
    assert stats["tracked"] + stats["new"] == len(after.cameras[0])
    assert {"prepare_ms", "temporal_ms", "ransac_ms", "detect_ms"} <= set(stats)


def test_bad_frames_are_refused(texture: Spline) -> None:
    frontend = build_frontend(STEREO, CONFIG)
    with pytest.raises(DataError, match="has 1 images, the rig has 2 cameras"):
        frontend.track(CameraFrame(7, (view(texture),)))
    with pytest.raises(DataError, match="camera 'right' has shape"):
        frontend.track(CameraFrame(7, (view(texture), view(texture)[:100])))
    deep: Any = view(texture).astype(np.uint16)
    with pytest.raises(DataError, match="values of type uint16; convert it to 8 bits"):
        frontend.track(CameraFrame(7, (view(texture), deep)))
    with pytest.raises(DataError, match="holds features, not images"):
        frontend.track(FeatureFrame(7, (FeatureObservations.empty(),) * 2))


def test_bad_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="featurs"):
        FrontendConfig(featurs=100)  # type: ignore[call-arg]
    with pytest.raises(ValidationError, match=r"unknown front end 'magic'; known: sift, .*, klt"):
        FrontendConfig(method="magic")
    with pytest.raises(ValidationError, match="unknown detector 'harriss'; did you mean 'harris'"):
        FrontendConfig(detector="harriss")
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        build_frontend(MONO, FrontendConfig(masks=(tmp_path / "nowhere.png",)))
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((10, 10), np.uint8))
    with pytest.raises(ConfigError, match="mask is 10x10"):
        build_frontend(MONO, FrontendConfig(masks=(tmp_path / "small.png",)))
    with pytest.raises(ConfigError, match="lists 2 masks"):
        build_frontend(MONO, FrontendConfig(masks=(None, None)))


def test_recorded_tracks_are_handed_on() -> None:
    rng = np.random.default_rng(0)
    frontend = build_frontend(MONO, content="tracks")
    for stamp, ids in ((0, np.arange(5)), (1, np.arange(2, 9))):
        seen = FeatureObservations(
            ids, rng.normal(size=(len(ids), 2)), rng.normal(size=(len(ids), 2))
        )
        frame = FeatureFrame(stamp, (seen,))
        assert frontend.track(frame) is frame
    assert frontend.frame_stats["tracked"] == 3
    frontend.drop(np.array([3, 4]))
    assert frontend.track(frame).cameras[0].ids.tolist() == [2, 5, 6, 7, 8]
    with pytest.raises(DataError, match="holds images"):
        frontend.track(CameraFrame(2, (None,)))
    with pytest.raises(DataError, match="features of 2 cameras"):
        frontend.track(FeatureFrame(2, (seen, seen)))


@pytest.mark.parametrize("window_px", [17, 21])
@pytest.mark.parametrize("side", [40, 200])
def test_a_shift_is_found_with_any_window_and_image(window_px: int, side: int) -> None:
    """By the kernel or by OpenCV; a pyramid ends where a window does not fit into its level."""
    noise = np.random.default_rng(0).integers(0, 256, (side, side)).astype(np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 2.0)
    target = cv2.warpAffine(image, np.array([[1.0, 0.0, 1.5], [0.0, 1.0, -1.0]]), (side, side))
    image.flags.writeable = False  # as some readers of recordings return them
    inner = np.linspace(16.0, side - 16.0, 5, dtype=np.float32)
    points = np.stack(np.meshgrid(inner, inner), axis=-1).reshape(-1, 2)
    lucas_kanade = LucasKanade(FrontendConfig(window_px=window_px), images=2)
    flow = lucas_kanade.flow(image, target, points, points, levels=3)
    assert flow.found.all()
    assert np.abs(flow.points - points - (1.5, -1.0)).max() < 0.1
    assert flow.error_px.max() < 0.1


def test_corners_that_were_lost_in_blurred_images_are_found_again(texture: Spline) -> None:
    without_imu = replace(MONO, has_imu=False, depth=DepthSensor())
    H = rotation([0.02, -0.03, 0.01])
    blurred = cv2.GaussianBlur(view(texture, rotation([0.01, -0.015, 0.0])), (0, 0), 12.0)
    frontend = build_frontend(without_imu, CONFIG)
    frames = feed(frontend, (view(texture),), (blurred,), (view(texture, H),))
    first, last = frames[0].cameras[0], frames[2].cameras[0]
    a, b = common(first, last)
    lost = ~np.isin(first.ids[a], frames[1].cameras[0].ids)
    error = np.linalg.norm(transfer(H, first.pixels[a]) - last.pixels[b], axis=1)
    assert np.count_nonzero(lost) > 0.5 * len(first)
    assert np.median(error[lost]) < 0.1
    assert np.max(error[lost]) < 1.0
