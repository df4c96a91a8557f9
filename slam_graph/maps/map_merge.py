# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Merging of two maps of the same place.

    keyframes of the second → places of the first → matches → consistency → pose graph → features

The keyframes of the second map are localized in the first, as the frames of a run are. The largest
group of matches that are consistent with one of them aligns the second map with the first. A pose
graph over the keyframes of both, with odometry, the links of each map and the matches, then moves
both, and GNC rejects false links. Matched features become one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import gtsam
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.errors import EstimationError
from slam_graph.loop_closure import Loop, LoopClosureConfig, Vocabulary, correct_keyframes
from slam_graph.maps.map_building import (
    links_of,
    merged_groups,
    with_points,
)
from slam_graph.maps.map_config import LocalizationConfig
from slam_graph.maps.map_localization import (
    CONSISTENT_CHI2,
    MapPoseFilter,
    with_roll_and_pitch,
)
from slam_graph.maps.map_model import NO_FEATURE, SlamMap
from slam_graph.maps.map_places import MapPlaces, PlaceMatch
from slam_graph.pose_graph import Poses
from slam_graph.version import __version__

MIN_LINKS = 5
"""Least number of consistent matches between two maps."""
_HYPOTHESES = 50
"""Number of matches that are tried as the alignment of the maps."""


@dataclass(frozen=True, slots=True)
class MergeSummary:
    """How well two maps fit.

    Attributes:
        verified: keyframes of the second map that were localized in the first.
        consistent: number of these that are consistent with each other.
        accepted: number of these that the pose graph kept.
        fused: features of the second map that were merged with features of the first.
        link_rmse_m: root-mean-square residual of the links between the maps.
        link_rmse_deg: the same of their orientation.
        first_moved_m: mean displacement of the keyframes of the first map.
    """

    verified: int
    consistent: int
    accepted: int
    fused: int
    link_rmse_m: float
    link_rmse_deg: float
    first_moved_m: float


@dataclass(frozen=True, slots=True, eq=False)
class MergedMaps:
    """The merged map, in the world of the first, and how well the maps fit."""

    content: SlamMap
    summary: MergeSummary


def merge_maps(
    first: SlamMap,
    second: SlamMap,
    loops: LoopClosureConfig | None = None,
    localization: LocalizationConfig | None = None,
    seed: int = 0,
) -> MergedMaps:
    """Merge two maps.

    Args:
        first: its first keyframe keeps its pose.
        second: of the same place; its world may be any other.
        loops: settings of verification, and the drift of odometry; defaults if not given.
        localization: settings of matching; defaults if not given.
        seed: of the training of the new vocabulary.

    Raises:
        DataError: if the maps have different kinds of descriptors.
        EstimationError: if they share no place.
    """
    loops, localization = loops or LoopClosureConfig(), localization or LocalizationConfig()
    level = first.gravity_aligned and second.gravity_aligned
    found = list(_matched(first, second, loops, localization, level))
    consistent, first_T_second = _aligned(first, second, found, localization, level)
    if len(consistent) < MIN_LINKS:
        raise EstimationError(
            f"the maps of {_names(first)} and {_names(second)} share no place: {len(found)} of "
            f"{len(second)} keyframes were recognised, {len(consistent)} of them consistently, and "
            f"{MIN_LINKS} are needed; are they of the same place, seen from similar directions? "
            "Maps with denser keyframes (loop_closure.keyframes.distance_m and angle_rad) overlap "
            "more"
        )
    joined = _side_by_side(first, second, first_T_second, level)
    links = [_link(one, len(first)) for one in consistent]
    poses, kept = _solved(joined, links, loops, level)
    accepted = [one for one, good in zip(consistent, kept, strict=True) if good]
    if len(accepted) < MIN_LINKS:
        raise EstimationError(
            f"the maps of {_names(first)} and {_names(second)} cannot be aligned: only "
            f"{len(accepted)} of {len(consistent)} links between them are consistent"
        )
    body_points = _body_points(joined)
    features, fused = _fused(first, second, accepted)
    moved = replace(
        joined,
        poses=poses,
        links=joined.links.concatenated(links_of([_link(one, len(first)) for one in accepted])),
        vocabulary=Vocabulary.train(
            [joined.descriptors_of(n) for n in range(len(joined))],
            loops.places.words,
            np.random.default_rng(seed),
        ),
    )
    error_px = 2.0 * loops.verification.max_error_px  # two maps do not fit as well as one
    content = with_points(moved, features, body_points, error_px)
    rmse_m, rmse_deg = _link_residuals(content, len(accepted))
    shift = poses.translations[: len(first)] - first.poses.translations
    return MergedMaps(
        content,
        MergeSummary(
            len(found),
            len(consistent),
            len(accepted),
            fused,
            rmse_m,
            rmse_deg,
            float(np.linalg.norm(shift, axis=1).mean()),
        ),
    )


def _link(one: _Matched, offset: int) -> Loop:
    """The match as a loop closure of the joined map."""
    return replace(one.match.loop, first=one.match.place, second=offset + one.number)


def _side_by_side(
    first: SlamMap, second: SlamMap, first_T_second: gtsam.Pose3, level: bool
) -> SlamMap:
    """Both maps in one, without merged features."""
    R, t = first_T_second.rotation().matrix(), first_T_second.translation()
    aligned = Poses(R @ second.poses.rotations, second.poses.translations @ R.T + t)
    features = second.features + np.where(second.features >= 0, len(first.points), 0)
    links = replace(second.links, ends=second.links.ends + len(first))

    return SlamMap(
        first.recordings + second.recordings,
        datetime.now(UTC).isoformat(timespec="seconds"),
        __version__,
        level,
        np.concatenate([first.recording_of, second.recording_of + len(first.recordings)]),
        np.concatenate([first.stamps_ns, second.stamps_ns]),
        first.poses.concatenated(aligned),
        np.concatenate([first.points, second.points @ R.T + t]),
        np.concatenate([first.feature_descriptors, second.feature_descriptors]),
        np.concatenate([first.offsets, second.offsets[1:] + first.offsets[-1]]),
        np.concatenate([first.features, features]),
        np.concatenate([first.normalized, second.normalized]),
        np.concatenate([first.descriptors, second.descriptors]),
        first.links.concatenated(links),
        first.vocabulary,
    )


def _solved(
    joined: SlamMap, between: list[Loop], config: LoopClosureConfig, level: bool
) -> tuple[Poses, list[bool]]:
    """Poses of all keyframes, and whether each link between the maps is kept."""
    own, none = joined.links, np.zeros((0, 2), np.int64)
    inner = [
        Loop(
            int(ends[0]),
            int(ends[1]),
            own.measured.pose3(n),
            own.covariances[n],
            0,
            0,
            none,
        )
        for n, ends in enumerate(own.ends)
    ]
    poses, inliers, _ = correct_keyframes(
        joined.stamps_ns,
        joined.poses,
        inner + between,
        config,
        level,
        recording_of=joined.recording_of,
    )
    return poses, inliers[len(inner) :].tolist()


def _body_points(content: SlamMap) -> FloatArray:
    """(N, 3) the point of each observation in its body frame; NaN without one."""
    points = np.full((len(content.features), 3), np.nan)
    known = np.flatnonzero(content.features >= 0)
    at = content.keyframe_of[known]
    away = content.points[content.features[known]] - content.poses.translations[at]
    points[known] = np.einsum("nji,nj->ni", content.poses.rotations[at], away)
    return points


def _fused(first: SlamMap, second: SlamMap, accepted: list[_Matched]) -> tuple[IntArray, int]:
    """(N,) feature of each observation of both maps, and the number of features merged."""
    offset = len(first.points)
    other = second.features.copy()
    other[other >= 0] += offset
    pairs = []
    for one in accepted:
        rows = second.offsets[one.number] + one.match.loop.pairs[:, 1]
        unknown = other[rows] == NO_FEATURE
        other[rows[unknown]] = one.match.features[unknown]
        pairs.append(np.column_stack([one.match.features, other[rows]]))
    same = np.concatenate(pairs)
    groups = merged_groups(offset + len(second.points), same)
    features = np.concatenate([first.features, other])
    known = features >= 0
    features[known] = groups[features[known]]
    fused = np.unique(same[:, 1][same[:, 1] >= offset])
    return features, len(fused)


def _link_residuals(content: SlamMap, count: int) -> tuple[float, float]:
    """Root-mean-square residuals of the last links: metres and degrees."""
    links = content.links
    i, j = links.ends[-count:].T
    found = content.poses.select(i).inverse().compose(content.poses.select(j))
    rows = np.arange(len(links) - count, len(links))
    off = links.measured.select(rows).inverse().compose(found)
    metres = np.linalg.norm(off.translations, axis=1)
    return (
        float(np.sqrt(np.mean(metres**2))),
        float(np.degrees(np.sqrt(np.mean(off.angles() ** 2)))),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Matched:
    """A keyframe of the second map that was localized in the first."""

    number: int
    match: PlaceMatch


def _names(content: SlamMap) -> str:
    """The recordings of a map, for messages."""
    return " + ".join(recording.name for recording in content.recordings)


def _matched(
    first: SlamMap,
    second: SlamMap,
    loops: LoopClosureConfig,
    localization: LocalizationConfig,
    level: bool,
) -> Iterator[_Matched]:
    """Keyframes of the second map that match places of the first.

    Args:
        first: the map that is searched.
        second: the map whose keyframes are the views.
        loops: settings of verification.
        localization: number of candidates.
        level: whether gravity is known to both.

    Raises:
        DataError: if the maps have different kinds of descriptors.
    """
    for number, recording in enumerate(second.recordings):
        places = MapPlaces(first, recording.rig, loops, localization.neighbours)
        places.check(second.descriptors, _names(second))
        for row in np.flatnonzero(second.recording_of == number).tolist():
            view = second.keyframe(row)
            found = [
                match
                for place in places.similar(view.descriptors, localization.candidates).tolist()
                if (match := places.locate(view, place, level)) is not None
            ]
            if found:
                yield _Matched(row, max(found, key=lambda match: match.loop.inliers))


def _aligned(
    first: SlamMap,
    second: SlamMap,
    matches: list[_Matched],
    config: LocalizationConfig,
    level: bool,
) -> tuple[list[_Matched], gtsam.Pose3]:
    """The largest group of matches that are consistent with one of them, and its alignment.

    Two matches are consistent if the relative poses between them in both maps are the same, up to
    the drift in between.

    Args:
        first: the map in which the keyframes were localized.
        second: the map of the keyframes.
        matches: between them.
        config: standard deviations of map and odometry.
        level: whether gravity is known to both.

    Returns:
        The group, and first_T_second: the world of the second map in that of the first.
    """
    best: list[_Matched] = []
    alignment = gtsam.Pose3()
    ways = _ways(first), _ways(second)
    step = max(len(matches) / _HYPOTHESES, 1.0)
    for row in np.arange(0, len(matches), step).astype(int).tolist():
        trial = matches[row]
        body = second.pose(trial.number)
        ends = trial.match.place, trial.number
        past_ns = [
            dijkstra(way, directed=False, indices=end) for way, end in zip(ways, ends, strict=True)
        ]
        group = []
        for other in matches:
            apart_ns = past_ns[0][other.match.place] + past_ns[1][other.number]
            if not np.isfinite(apart_ns):
                continue
            filter_ = MapPoseFilter(
                config, level, body, trial.match.world_T_body, trial.match.covariance, 0
            )
            filter_.move(round(apart_ns), second.pose(other.number))
            if filter_.distance(other.match.world_T_body, other.match.covariance) < CONSISTENT_CHI2:
                group.append(other)
        if len(group) > len(best):
            best = group
            placed = trial.match.world_T_body
            placed = with_roll_and_pitch(placed, body) if level else placed
            alignment = placed.compose(body.inverse())
    return best, alignment


def _ways(content: SlamMap) -> csr_matrix:
    """(K, K) time in ns during which odometry drifts from one keyframe of a map to another.

    Those of one recording are joined in the order of time, and those of different recordings, whose
    clocks have nothing in common, by the links between them, along which nothing drifts.
    """
    count, recording_of = len(content.stamps_ns), content.recording_of
    before = np.flatnonzero(np.diff(recording_of) == 0)
    across = content.links.ends[np.diff(recording_of[content.links.ends])[:, 0] != 0]
    ends = np.concatenate([np.column_stack([before, before + 1]), across])
    times = np.maximum(np.diff(content.stamps_ns)[before], 1)
    values = np.concatenate([times, np.ones(len(across))])  # 0 would be none
    return csr_matrix((values, tuple(ends.T)), shape=(count, count))
