# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a run says of frames that are missing, repeated or empty, while it goes on."""

from collections import Counter

import numpy as np
import pytest

from slam_graph.diagnostics import Diagnostics
from slam_graph.pipeline.frame_watch import FrameWatch
from slam_graph.sensors import CameraFrame, FeatureFrame, FeatureObservations, Rig
from slam_graph.simulation import simulate

PERIOD_NS = 50_000_000


@pytest.fixture(scope="module")
def rig() -> Rig:
    return simulate(duration_s=1.0, cameras=2).rig


def counted(rig: Rig, frames: list[CameraFrame] | list[FeatureFrame]) -> Counter[str]:
    """The kinds that a watch counts in frames."""
    diagnostics = Diagnostics()
    watch = FrameWatch(rig, diagnostics)
    for frame in frames:
        watch.look(frame)
    return diagnostics.counts


def images(count: int, without: set[int] = frozenset(), held: set[int] = frozenset()) -> list:
    """Frames of two cameras, some left out, some with the second image of the one before."""
    rng, frames, last = np.random.default_rng(0), [], None
    for k in range(count):
        first, second = rng.integers(0, 256, (2, 60, 80), np.uint8)
        last = second if last is None or k not in held else last.copy()
        if k not in without:
            frames.append(CameraFrame(k * PERIOD_NS, (first, last)))
    return frames


def tracks(count: int, empty: set[int] = frozenset(), held: set[int] = frozenset()) -> list:
    """Frames of 40 moving features, those of the second camera gone or where they were in some."""
    frames = []
    for k in range(count):
        pixels = np.arange(80.0).reshape(40, 2) + k
        seen = FeatureObservations(np.arange(40), pixels, pixels / 400.0)
        frames.append(FeatureFrame(k * PERIOD_NS, (seen, FeatureObservations.empty())))
        if k not in empty:
            second = frames[-2].cameras[1] if k in held else seen
            frames[-1] = FeatureFrame(k * PERIOD_NS, (seen, second))
    return frames


def test_good_frames_say_nothing(rig: Rig) -> None:
    assert not counted(rig, images(40))
    assert not counted(rig, tracks(40))


def test_each_pause_of_two_frames_or_more_is_counted_once(rig: Rig) -> None:
    lost = {13, 20, 21, 30, 31, 32, 33}
    assert counted(rig, images(40, without=lost)) == {"frame_gap": 2}
    assert counted(rig, images(10)[:3] + images(20)[15:]) == {}, "what is usual is not known yet"


def test_a_rate_that_changes_for_good_is_usual_after_a_while(rig: Rig) -> None:
    every_fourth = set(range(30, 200)) - set(range(30, 200, 4))
    found = counted(rig, images(200, without=every_fourth))
    assert 10 <= found["frame_gap"] <= 20


def test_repeated_images_and_features_are_counted(rig: Rig) -> None:
    assert counted(rig, images(20, held={5, 6, 7})) == {"image_repeated": 3}
    assert counted(rig, tracks(20, held={5, 6})) == {"image_repeated": 2}


def test_features_that_are_few_already_say_nothing(rig: Rig) -> None:
    """Eight of sixteen features go on from frame to frame."""
    frames = []
    for k in range(20):
        pixels = np.arange(32.0).reshape(16, 2) + k
        seen = FeatureObservations(np.arange(16) + 8 * k, pixels, pixels / 400.0)
        frames.append(FeatureFrame(k * PERIOD_NS, (seen, seen)))
    assert not counted(rig, frames)


def test_tracks_that_end_all_at_once_are_counted_once(rig: Rig) -> None:
    assert counted(rig, tracks(20, empty={8, 9, 10, 15})) == {"few_features": 2}
