# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Merged maps: the worlds agree, features that are the same become one, strangers are refused."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from map_flights import CONFIG, World

from slam_graph.errors import EstimationError
from slam_graph.maps.map_config import LocalizationConfig
from slam_graph.maps.map_merge import MIN_LINKS, _aligned, _matched, merge_maps
from slam_graph.maps.map_model import SlamMap
from slam_graph.pose_graph.graph import Poses

LOOPS, LOCALIZATION = CONFIG, LocalizationConfig()
MOVE = gtsam.Pose3(gtsam.Rot3.Rz(2.5), np.array([20.0, -5.0, 1.0]))


def in_another_world(content: SlamMap, move: gtsam.Pose3 = MOVE) -> SlamMap:
    R, t = move.rotation().matrix(), move.translation()
    poses = Poses(R @ content.poses.rotations, content.poses.translations @ R.T + t)
    return replace(content, poses=poses, points=content.points @ R.T + t)


@pytest.fixture(scope="module")
def world() -> World:
    return World()


def test_maps_of_one_place_become_one(world: World) -> None:
    first, second = world.map(range(8)), in_another_world(world.map(range(3, 11)))
    merged = merge_maps(first, second, LOOPS, LOCALIZATION)
    content, summary = merged.content, merged.summary
    truth = np.array([world.pose(n).translation() for n in [*range(8), *range(3, 11)]])
    np.testing.assert_allclose(content.poses.translations, truth, atol=2e-3)
    assert summary.accepted >= MIN_LINKS
    assert summary.first_moved_m < 1e-6
    assert summary.link_rmse_m < 1e-6
    # every feature of the wall is there once, where it is
    assert len(content.points) <= len(world.points)
    assert summary.fused == len(first.points) + len(second.points) - len(content.points)
    away = np.linalg.norm(content.points[:, None] - world.points, axis=2).min(axis=1)
    assert away.max() < 1e-6
    np.testing.assert_array_equal(content.recording_of, [0] * 8 + [1] * 8)


def test_a_third_map_is_merged_with_two(world: World) -> None:
    """Links of the maps are kept, and the whole still fits."""
    maps = [world.map(range(6)), in_another_world(world.map(range(2, 8)))]
    two = merge_maps(*maps, LOOPS, LOCALIZATION).content
    third = in_another_world(world.map(range(1, 8)), MOVE.inverse())
    for order in ((two, third), (third, two)):
        merged = merge_maps(*order, LOOPS, LOCALIZATION).content
        assert len(merged.recordings) == 3
        assert len(merged.links) > len(two.links)
        assert len(merged.points) <= len(world.points)


def test_without_gravity_the_whole_pose_is_found(world: World) -> None:
    tilted = gtsam.Pose3(gtsam.Rot3.Ypr(1.0, 0.5, -0.7), np.array([1.0, 2.0, 3.0]))
    first = replace(world.map(range(8)), gravity_aligned=False)
    second = in_another_world(world.map(range(8)), tilted)
    content = merge_maps(first, second, LOOPS, LOCALIZATION).content
    assert not content.gravity_aligned
    np.testing.assert_allclose(content.poses.translations[8:], first.poses.translations, atol=2e-3)


def test_maps_of_different_places_are_refused(world: World) -> None:
    with pytest.raises(EstimationError, match="share no place: 0 of 8") as caught:
        merge_maps(world.map(range(8)), World(1).map(range(8)), LOOPS, LOCALIZATION)
    assert "\n" not in str(caught.value)


def test_too_small_an_overlap_is_refused(world: World) -> None:
    with pytest.raises(EstimationError, match="share no place"):
        merge_maps(world.map(range(8)), world.map(range(MIN_LINKS - 1)), LOOPS, LOCALIZATION)


def test_days_between_recordings_are_no_drift(world: World) -> None:
    """False matches with the recording of another day are as inconsistent as on the same day."""
    later, day_ns = world.map(range(3, 11)), 86_400 * 10**9
    for days in (0, 30):
        again = replace(later, stamps_ns=later.stamps_ns + days * day_ns)
        first = merge_maps(world.map(range(8)), again, LOOPS, LOCALIZATION).content
        second = world.map(range(11))
        found = list(_matched(first, second, LOOPS, LOCALIZATION, True))
        assert len(found) == 11
        for k in (8, 9, 10):
            wrong = found[k].match.world_T_body.compose(gtsam.Pose3(gtsam.Rot3(), [2.5, 0.0, k]))
            match = replace(found[k].match, place=8 + 7, world_T_body=wrong)
            found[k] = replace(found[k], match=match)
        group, _ = _aligned(first, second, found, LOCALIZATION, True)
        assert [one.number for one in group] == list(range(8))
