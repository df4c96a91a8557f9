# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Tracks do not drift where features are placed by the patch in which they were first seen."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.frontend import FrontendConfig
from slam_graph.frontend.extraction import FeatureExtractor
from slam_graph.frontend.keypoints import Image, Pixels, Tracks
from slam_graph.frontend.lucas_kanade import CornerTracking, LucasKanade
from slam_graph.frontend.prediction import Prediction
from slam_graph.frontend.reference_patches import ReferencePatches

WIDTH, HEIGHT = 360, 280
FRAMES, NOISE_GREY = 30, 4.0


def texture() -> FloatArray:
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 3.0)
    low, high = np.min(image), np.max(image)
    return np.asarray(20.0 + 215.0 * (image - low) / (high - low))


def warps() -> list[FloatArray]:
    """(2, 3) affine maps from the first image to each: it turns, grows, shears and moves away."""
    middle = np.array([WIDTH / 2, HEIGHT / 2])
    found: list[FloatArray] = []
    for k in range(FRAMES):
        angle, growth = np.deg2rad(0.6 * k), 1.012**k
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        A = growth * turn @ np.array([[1.0, 0.004 * k], [0.0, 1.0 - 0.004 * k]])
        found.append(np.column_stack([A, middle - A @ middle + [0.7 * k, 0.4 * k]]))
    return found


def images(maps: list[FloatArray]) -> list[Image]:
    """The views, each with noise of its own, and brighter and flatter from one to the next."""
    rng, base = np.random.default_rng(4), texture()
    found = []
    for k, view in enumerate(maps):
        grey = cv2.warpAffine(base, view, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
        grey = (1.0 - 0.01 * k) * grey + 1.5 * k + rng.normal(0.0, NOISE_GREY, grey.shape)
        found.append(np.clip(grey, 0, 255).astype(np.uint8))
    return found


def corners_of(image: Image, count: int) -> Pixels:
    return np.asarray(cv2.goodFeaturesToTrack(image, count, 0.01, 10.0)[:, 0], np.float32)


def errors(reference_patches: bool) -> FloatArray:
    """Distances (N,) of tracks from their points in the last image."""
    maps = warps()
    views = images(maps)
    config = FrontendConfig(reference_patches=reference_patches)
    extractor = FeatureExtractor(config, WIDTH, HEIGHT, None)
    tracking = CornerTracking(extractor, LucasKanade(config, 2), config)
    corners = corners_of(views[0], 150)
    tracks = _tracks(views[0], np.arange(len(corners)), corners)
    first = tracks.pixels.astype(np.float64)
    for view in views[1:]:
        guess = Prediction(tracks.pixels, np.ones(len(tracks), np.bool_))
        found = tracking.follow(tracks, view, guess)
        tracks = _tracks(view, tracks.ids[found.good], found.points[found.good])
    assert len(tracks) > 20
    true = first[tracks.ids] @ maps[-1][:, :2].T + maps[-1][:, 2]
    return np.asarray(np.linalg.norm(tracks.pixels - true, axis=1))


def _tracks(image: Image, ids: IntArray, pixels: Pixels) -> Tracks:
    return Tracks.of(image, 0, ids, pixels, pixels.astype(np.float64))


def test_tracks_do_not_drift_under_noise_change_of_view_and_of_light() -> None:
    drifting, placed = np.median(errors(False)), np.median(errors(True))
    assert placed < 0.2
    assert placed < 0.25 * drifting


def test_a_patch_that_is_not_there_leaves_the_feature_where_it_was_tracked_to() -> None:
    maps = warps()
    before, other = images(maps[:1])[0], np.full((HEIGHT, WIDTH), 128, np.uint8)
    pixels = np.array([[100.0, 90.0], [200.0, 150.0], [3.0, 4.0]], np.float32)
    tracks = _tracks(before, np.arange(3), pixels)
    moved = pixels + np.float32(0.5)
    found = ReferencePatches().placed(tracks, other, moved, np.ones(3, np.bool_))
    np.testing.assert_array_equal(found, moved)


def test_features_that_were_not_tracked_stay() -> None:
    maps = warps()[:2]
    one, two = images(maps)
    corners = corners_of(one, 30)
    tracks = _tracks(one, np.arange(len(corners)), corners)
    good = np.arange(len(corners)) % 2 == 0
    start = (corners @ maps[1][:, :2].T + maps[1][:, 2]).astype(np.float32)
    found = ReferencePatches().placed(tracks, two, start, good)
    np.testing.assert_array_equal(found[~good], start[~good])
    assert np.any(found[good] != start[good])


@pytest.mark.parametrize("count", [3, 40])
def test_patches_are_those_of_the_features_whatever_their_order(count: int) -> None:
    """Features that come, go and come back have their own patch each."""
    views = images([np.eye(2, 3) for _ in range(6)])
    rng = np.random.default_rng(5)
    corners, patches, errors_px = corners_of(views[0], count), ReferencePatches(), []
    for before, now in pairwise(views):
        ids = np.sort(rng.choice(len(corners), max(1, len(corners) // 2), replace=False))
        tracks = _tracks(before, ids, corners[ids])
        off = rng.normal(0.0, 0.3, (len(ids), 2)).astype(np.float32)
        placed = patches.placed(tracks, now, corners[ids] + off, np.ones(len(ids), np.bool_))
        errors_px.append(np.linalg.norm(placed - corners[ids], axis=1))
    assert np.median(np.concatenate(errors_px)) < 0.15


def placed_from(patches: ReferencePatches, tracks: Tracks, image: Image, start: Pixels) -> Pixels:
    """Where patches put features of a frame in an image, from where they are believed to be."""
    return patches.placed(tracks, image, start, np.ones(len(tracks), np.bool_))


def corners_and_image() -> tuple[Tracks, Image]:
    image = images([np.eye(2, 3)])[0]
    corners = corners_of(image, 40)
    within = np.all((corners > 30) & (corners < np.array([WIDTH, HEIGHT]) - 30), axis=1)
    corners = corners[within]
    return _tracks(image, np.arange(len(corners)), corners), image


def test_a_patch_that_is_half_hidden_neither_moves_its_feature_nor_its_warp() -> None:
    tracks, image = corners_and_image()
    hidden = (0.45 * image + 0.55 * image[::-1, ::-1]).astype(np.uint8)  # another place shines in
    patches = ReferencePatches()
    placed_from(patches, tracks, image, tracks.pixels)
    start = tracks.pixels + np.float32(0.5)
    for _ in range(2):
        found = placed_from(patches, tracks, hidden, start)
    assert np.mean(np.any(found != start, axis=1)) < 0.2
    again = placed_from(patches, tracks, image, start)
    assert np.median(np.linalg.norm(again - tracks.pixels, axis=1)) < 0.03


def scaled(image: Image, tracks: Tracks, factors: tuple[float, float]) -> tuple[Image, Pixels]:
    """An image that is stretched about its middle, and where features are in it."""
    middle = np.array([WIDTH / 2, HEIGHT / 2])
    A = np.diag(factors)
    view = np.column_stack([A, middle - A @ middle])
    grey = cv2.warpAffine(image, view, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    return grey, ((tracks.pixels - middle) @ A.T + middle).astype(np.float32)


@pytest.mark.parametrize(
    ("factors", "given_up"),
    [((1.4, 1.4), False), ((1.7, 1.7), True), ((1.25, 0.8), False), ((1.5, 1 / 1.5), True)],
)
def test_a_patch_is_given_up_where_its_area_or_its_shape_changes_too_much(
    factors: tuple[float, float], given_up: bool
) -> None:
    """Step by step a patch follows the change, which one step could not bring about."""
    tracks, image = corners_and_image()
    patches, steps, off = ReferencePatches(), 16, np.float32(0.4)
    for k in range(1, steps + 1):
        share = tuple(factor ** (k / steps) for factor in factors)
        now, true = scaled(image, tracks, (share[0], share[1]))
        placed_from(patches, tracks, now, true)
    # from off its place a feature is moved back by its first patch, and to no other
    again = placed_from(patches, tracks, now, true + off)
    inner = np.all((true > 20) & (true < np.array([WIDTH, HEIGHT]) - 20), axis=1)
    errors_px = np.linalg.norm(again - true, axis=1)[inner]
    assert (np.median(errors_px) > 0.2) == given_up


def test_one_image_without_the_patch_does_not_replace_it_and_three_do() -> None:
    tracks, image = corners_and_image()
    blank = np.full_like(image, 128)
    for images_without, kept in ((1, True), (3, False)):
        patches = ReferencePatches()
        placed_from(patches, tracks, image, tracks.pixels)
        for _ in range(images_without):
            placed_from(patches, tracks, blank, tracks.pixels)
        # a feature that is 1 px off when a new patch is taken stays there
        slid = _tracks(image, tracks.ids, tracks.pixels + np.float32(0.7))
        found = placed_from(patches, slid, image, slid.pixels)
        errors_px = np.linalg.norm(found - tracks.pixels, axis=1)
        assert (np.median(errors_px) < 0.1) == kept


def test_patches_outlast_an_image_with_few_features_and_those_forgotten_do_not() -> None:
    tracks, image = corners_and_image()
    patches = ReferencePatches()
    placed_from(patches, tracks, image, tracks.pixels)
    few = tracks.select(np.arange(len(tracks)) < 2)
    placed_from(patches, few, image, few.pixels)
    patches.forget(tracks.ids[::2])
    slid = _tracks(image, tracks.ids, tracks.pixels + np.float32(0.7))
    errors_px = np.linalg.norm(
        placed_from(patches, slid, image, slid.pixels) - tracks.pixels, axis=1
    )
    assert np.median(errors_px[1::2]) < 0.1
    assert np.median(errors_px[::2]) > 0.5


def test_patches_of_features_that_do_not_come_back_are_dropped() -> None:
    """Without being told: memory of a long run stays what it was."""
    tracks, image = corners_and_image()
    patches = ReferencePatches()
    for k in range(130):
        ids = tracks.ids + k * len(tracks)
        placed_from(patches, _tracks(image, ids, tracks.pixels), image, tracks.pixels)
    assert 95 * len(tracks) < patches.count <= 101 * len(tracks)
