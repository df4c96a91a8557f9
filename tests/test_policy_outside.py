# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Policies of one's own are treated by what they say of themselves, not by their names."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from flight import rig
from pydantic import ValidationError

from slam_graph.arrays import BoolArray
from slam_graph.backend import FEATURE_POLICIES, POSE_SELECTIONS, FeaturePolicy, PoseSelection
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.selection_policies import WaitingTracks, evenly_spaced, most_recent
from slam_graph.backend.policies import CostPolicy
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import State
from slam_graph.backend.window import Window


def all_poses(window: Window, policy: CostPolicy, rig: RigProjection) -> PoseSelection:
    """Keeps every pose, whatever `max_past_poses` says."""
    return PoseSelection(list(window.past))


def none_due(tracks: WaitingTracks) -> BoolArray:
    return np.zeros(len(tracks.ids), np.bool_)


def all_due(tracks: WaitingTracks) -> BoolArray:
    return np.ones(len(tracks.ids), np.bool_)


@pytest.fixture(autouse=True)
def outside() -> Iterator[None]:
    with (
        POSE_SELECTIONS.registered("all", all_poses),
        FEATURE_POLICIES.registered(
            "state_and_wait", FeaturePolicy(none_due, drops_ended=True, uses_tracks=False)
        ),
        FEATURE_POLICIES.registered("anew", FeaturePolicy(all_due, relinearized=True)),
    ):
        yield


@pytest.mark.parametrize("features", ["state", "state_and_wait"])
def test_settings_of_tracks_are_refused_where_none_are_used(features: str) -> None:
    assert CostPolicy(features=features).features == features
    with pytest.raises(ValidationError, match="uses no features outside the state"):
        CostPolicy(features=features, max_features_per_step=7)
    with pytest.raises(ValidationError, match=f"{features} measures only features of the state"):
        CostPolicy(features=features, max_state_features=0)


@pytest.mark.parametrize("features", ["once", "every_step", "anew"])
def test_settings_of_tracks_are_accepted_where_some_are_used(features: str) -> None:
    assert CostPolicy(features=features, max_features_per_step=7).max_features_per_step == 7
    assert CostPolicy(features=features, max_state_features=0).max_state_features == 0


@pytest.mark.parametrize("features", ["every_step", "anew"])
@pytest.mark.parametrize("held", [0, 40])
def test_features_that_stay_are_refused_where_their_observations_are_dropped(
    features: str, held: int
) -> None:
    with pytest.raises(ValidationError, match=f"{features} makes a feature part of the prior"):
        CostPolicy(past_poses="evenly_spaced", features=features, max_state_features=held)


@pytest.mark.parametrize("past_poses", ["most_recent", "evenly_spaced"])
def test_no_more_poses_are_kept_than_are_allowed(past_poses: str) -> None:
    window = Window(0, 0, State(), SquareRootInformation.empty())
    policy = CostPolicy(past_poses=past_poses, max_past_poses=4, recent_frames=3)
    select = {"most_recent": most_recent, "evenly_spaced": evenly_spaced}[past_poses]
    for frame in range(40):
        window.past.append(frame)
        window.past_stamps_ns[frame] = frame * 10**9
        window.past = select(window, policy, RigProjection(rig(2))).kept
        assert len(window.past) <= 4
    assert len(window.past) > 2
    if past_poses == "evenly_spaced":
        with pytest.raises(ValidationError, match="must be larger than recent_frames"):
            CostPolicy(past_poses=past_poses, max_past_poses=4, recent_frames=4)


@pytest.mark.parametrize("past_poses", ["most_recent", "evenly_spaced", "keyframes"])
def test_a_track_longer_than_the_poses_is_refused(past_poses: str) -> None:
    longest = CostPolicy(past_poses=past_poses, max_past_poses=3, state_feature_frames=5)
    assert longest.frames_before_state == 5
    with pytest.raises(ValidationError, match="a feature waits over 5 frames at most"):
        CostPolicy(past_poses=past_poses, max_past_poses=3, state_feature_frames=6)


def test_how_long_a_track_is_under_poses_from_outside_is_not_known() -> None:
    policy = CostPolicy(past_poses="all", max_past_poses=3, state_feature_frames=20)
    assert policy.frames_before_state == 20


@pytest.mark.parametrize("recent_frames", [1, 3])
@pytest.mark.parametrize(
    ("spacing_s", "cameras", "imu", "rate_hz", "every"),
    [
        (None, 1, True, 60, 3),
        (None, 1, True, 30, 2),
        (None, 1, True, 25, 1),
        (None, 1, True, 20, 1),
        (None, 2, True, 60, 1),
        (None, 1, False, 60, 1),
        (0.03, 2, True, 60, 2),
    ],
)
def test_poses_of_one_fast_camera_are_kept_apart_in_time(
    spacing_s: float | None,
    cameras: int,
    imu: bool,
    rate_hz: int,
    every: int,
    recent_frames: int,
) -> None:
    policy = CostPolicy(max_past_poses=6, recent_frames=recent_frames, pose_spacing_s=spacing_s)
    projection = RigProjection(replace(rig(cameras), has_imu=imu))
    window = Window(0, 0, State(), SquareRootInformation.empty())
    for frame in range(40):
        window.past.append(frame)
        window.past_stamps_ns[frame] = round(frame * 1e9 / rate_hz)
        selected = most_recent(window, policy, projection)
        dropped = selected.dropped
        assert recent_frames == 1 or frame in selected.kept
        assert dropped.issubset(window.past)
        assert not dropped.intersection(selected.kept)
        assert window.past[0] not in dropped, "what the oldest pose saw is used"
        window.past = selected.kept
    older = selected.kept[: len(selected.kept) - (recent_frames - 1)]
    assert np.diff(older).tolist() == [every] * (len(older) - 1)
    assert len(selected.kept) == policy.max_past_poses


@pytest.mark.parametrize(("rate_hz", "apart_ns"), [(60, 50_000_000), (20, 50_000_000)])
def test_poses_that_are_thinned_are_apart_in_time_too(rate_hz: int, apart_ns: int) -> None:
    policy, projection = CostPolicy(max_past_poses=6), RigProjection(rig(1))
    window = Window(0, 0, State(), SquareRootInformation.empty())
    for frame in range(40):
        window.past.append(frame)
        window.past_stamps_ns[frame] = round(frame * 1e9 / rate_hz)
        window.past = evenly_spaced(window, policy, projection).kept
    gaps = np.diff([window.past_stamps_ns[i] for i in window.past])
    assert np.min(gaps) >= apart_ns - 2
    assert np.max(gaps) > 2 * apart_ns
    assert window.past[0] == 0


def test_jitter_of_some_milliseconds_costs_no_pose() -> None:
    policy, projection = CostPolicy(max_past_poses=30), RigProjection(rig(1))
    window, rng = Window(0, 0, State(), SquareRootInformation.empty()), np.random.default_rng(0)
    for frame in range(30):
        window.past.append(frame)
        window.past_stamps_ns[frame] = round(frame * 5e7 + rng.uniform(-6e6, 6e6))
    assert most_recent(window, policy, projection).kept == window.past


def test_the_spacing_of_poses_is_refused_where_it_has_no_effect() -> None:
    with pytest.raises(ValidationError, match="keeps no poses by their time"):
        CostPolicy(past_poses="keyframes", pose_spacing_s=0.1)
