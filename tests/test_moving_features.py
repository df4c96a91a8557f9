# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features that move: apart from the others as long as they do, and only then."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from flight import Flight
from images import CONFIG, MONO, painted, shift, view

from slam_graph.backend import ObjectFrame
from slam_graph.frontend import Feedback, FrontendConfig, build_frontend
from slam_graph.frontend.extraction import FeatureExtractor
from slam_graph.frontend.moving_tracks import MOST, MovingTracks
from slam_graph.pipeline import run
from slam_graph.pipeline.observers import NullViewer
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.sensors import CameraFrame, FeatureObservations
from slam_graph.simulation.simulator import simulate


def test_moving_features_are_apart_and_not_too_many() -> None:
    moving = MovingTracks(wanted=True)
    seen = [FeatureObservations(np.arange(10), np.zeros((10, 2)), np.zeros((10, 2)))]
    moving.add(np.array([3, 7]))
    moving.remove(np.array([7]))
    static, apart = moving.apart(seen)
    assert apart[0].ids.tolist() == [3]
    assert 3 not in static[0].ids
    moving.add(np.arange(1000))
    assert len(moving.surplus(np.arange(500))) == 500 - MOST
    assert len(moving.ids) == MOST


def test_an_outlier_is_apart_for_a_frame_and_what_moves_until_it_is_static() -> None:
    moving = MovingTracks(wanted=True)
    moving.add(np.array([3]))
    moving.suspect(np.array([5, 8]))
    assert moving.ids.tolist() == [3, 5, 8]
    moving.next_frame()
    assert moving.ids.tolist() == [3]
    moving.suspect(np.array([5]))
    moving.remove(np.array([3, 5]))
    assert len(moving.ids) == 0


def test_moving_features_do_not_take_the_place_of_static_ones() -> None:
    """With a third of the view full of features that move, there are as many others as else."""
    extractor = FeatureExtractor(FrontendConfig(max_features=96), 640, 480, None)
    image = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), np.uint8)
    everywhere = extractor.extract(image, np.zeros((0, 2), np.float32)).points
    moving, static = (everywhere[rows] for rows in (everywhere[:, 0] < 213, everywhere[:, 0] > 213))
    assert len(moving) > 10
    extractor.count_apart(moving)
    new = extractor.extract(image, everywhere).points
    assert len(static) + len(new) == 96
    assert np.mean(new[:, 0] > 160.0) > 0.9, "few where most features move"


def test_without_objects_nothing_is_kept() -> None:
    moving = MovingTracks(wanted=False)
    moving.add(np.arange(5))
    assert len(moving.ids) == 0
    assert moving.apart([])[1] == ()


@pytest.mark.parametrize("method", ["klt", "orb", "sift"])
def test_what_is_found_on_an_object_is_followed(method: str) -> None:
    """Corners within the hull of an object live on, whatever finds them again."""
    texture, hull = painted(), np.array([[120.0, 80], [360, 80], [360, 240], [120, 240]])
    config = CONFIG.model_copy(update={"method": method, "keep_moving": True})
    frontend, ids = build_frontend(MONO, config), []
    for k in range(5):
        image = view(texture, shift(2.0 * k, 0.0))
        frame = frontend.track(CameraFrame(k * 50_000_000, (image,)))
        ids.append(frame.moving[0].ids)
        state = Flight().nav_state(0.05 * k)
        frontend.receive_feedback(Feedback(state, moving=ids[-1], hulls=((hull, 40),)))
    followed = [np.isin(before, after).mean() for before, after in pairwise(ids[1:])]
    assert min(map(len, ids[1:])) > 10
    assert min(followed) > 0.6


class Kept(NullViewer):
    """Keeps what was found in each frame."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, ObjectFrame]] = []

    def show(self, frame: EstimatedFrame, estimator: object) -> None:
        assert frame.objects is not None
        self.frames.append((frame.features.stamp_ns, frame.objects))


def test_features_of_an_object_that_stops_are_given_back() -> None:
    """And taken again when it goes on; both within half a second."""
    sequence = simulate(
        duration_s=6.0,
        rate_hz=10.0,
        seed=1,
        tracks={"pixel_sigma": 0.5},
        objects={"count": 1, "motion": "stop_and_go"},
    )
    changes = {"objects.enabled": True, "backend.noise.pixel_sigma": 0.5}
    kept = Kept()
    run(sequence, overrides={**changes, "final_ba.enabled": False}, viewer=kept)
    (body,) = sequence.bodies
    standing, moving = [], []
    for stamp_ns, found in kept.frames[10:]:
        members = np.array(list(found.members), np.int64)
        assert not np.isin(found.static, found.moving).any()
        then = body.standing(round(stamp_ns - 0.5e9)), body.standing(stamp_ns)
        if len(members) and then == (True, True):
            standing.append(float(np.isin(members, found.static).mean()))
        if len(members) and then == (False, False):
            moving.append(float(np.isin(members, found.moving).mean()))
    assert len(standing) > 8
    assert len(moving) > 20
    assert min(standing) == 1.0
    assert np.mean(np.array(moving) == 1.0) > 0.9
