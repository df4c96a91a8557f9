# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Two maps of the same place made one.

    keyframes of the second → places of the first → sightings → agreement → pose graph → features

The keyframes of the second map are located in the first one as views of a run are. The largest
group of sightings that agree says how the second map lies in the first. A pose graph over the
keyframes of both, with odometry, the links of each map and those between them, then moves both, and
GNC decides once more which of the links are false. Features that are matched become one.

How a map lies in another: keyframes that are recognised there, and the pose they agree on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import gtsam
import numpy as np
from scipy.stats import chi2

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.loop_closure.loop_config import LoopClosureConfig
from slam_graph.loop_closure.loop_pose_graph import corrected, loop_graph
from slam_graph.loop_closure.loop_verification import Loop
from slam_graph.maps.map_building import links_of, together, trained, with_features
from slam_graph.maps.map_config import LocalizationConfig
from slam_graph.maps.map_model import NO_FEATURE, Links, SlamMap
from slam_graph.maps.map_places import MapPlaces, Sighting
from slam_graph.maps.pose_filter import MapPoseFilter, upright
from slam_graph.pose_graph.graph import Poses
from slam_graph.pose_graph.optimize import optimize_pose_graph
from slam_graph.pose_graph.pose_graph_policy import PoseGraphCostPolicy, PoseGraphPolicy
from slam_graph.version import __version__

HYPOTHESES = 50
"""How many sightings are tried as what all others should agree with."""


@dataclass(frozen=True, slots=True, eq=False)
class Recognised:
    """A keyframe of the second map that was located in the first."""

    number: int
    sighting: Sighting


def names(content: SlamMap) -> str:
    """The recordings of a map, for a message."""
    return " + ".join(recording.name for recording in content.recordings)


def recognised(
    first: SlamMap,
    second: SlamMap,
    loops: LoopClosureConfig,
    localization: LocalizationConfig,
    level: bool,
) -> Iterator[Recognised]:
    """Keyframes of the second map that show places of the first.

    Args:
        first: the map that is looked in.
        second: the map of which the keyframes are taken for views.
        loops: how places are verified.
        localization: how many candidates are tried.
        level: whether gravity is known to both.

    Raises:
        DataError: if descriptors are of different kinds.
    """
    for number, recording in enumerate(second.recordings):
        places = MapPlaces(
            first, recording.rig, loops.places, loops.verification, localization.neighbours
        )
        places.check(second.descriptors, names(second))
        for row in np.flatnonzero(second.recording_of == number).tolist():
            view = second.keyframe(row)
            found = [
                sighting
                for place in places.alike(view.descriptors, localization.candidates).tolist()
                if (sighting := places.locate(view, place, level)) is not None
            ]
            if found:
                yield Recognised(row, max(found, key=lambda sighting: sighting.loop.inliers))


def agreement(
    first: SlamMap,
    second: SlamMap,
    seen: list[Recognised],
    config: LocalizationConfig,
    level: bool,
) -> tuple[list[Recognised], gtsam.Pose3]:
    """The largest group of sightings that agree with one of them, and what that one says.

    Two agree if the ways between them in both maps are the same, up to the drift on these ways.

    Args:
        first: the map in which the keyframes were recognised.
        second: the map that they are of.
        seen: what was recognised.
        config: when sightings agree.
        level: whether gravity is known to both.

    Returns:
        The group, and world_T_world: the world of the second map in that of the first.
    """
    bound = float(chi2.ppf(config.confidence, 6))
    best: list[Recognised] = []
    alignment = gtsam.Pose3()
    step = max(len(seen) / HYPOTHESES, 1.0)
    for row in np.arange(0, len(seen), step).astype(int).tolist():
        trial = seen[row]
        body = second.pose(trial.number)
        group = []
        for other in seen:
            filter_ = MapPoseFilter(
                config, level, body, trial.sighting.world_T_body, trial.sighting.covariance, 0
            )
            filter_.move(_apart_ns(first, second, trial, other), second.pose(other.number))
            if filter_.distance(other.sighting.world_T_body, other.sighting.covariance) < bound:
                group.append(other)
        if len(group) > len(best):
            best = group
            placed = trial.sighting.world_T_body
            placed = upright(placed, body) if level else placed
            alignment = placed.compose(body.inverse())
    return best, alignment


def _apart_ns(first: SlamMap, second: SlamMap, one: Recognised, other: Recognised) -> int:
    """How much time odometry had to drift between two sightings, in both maps."""
    ways = (
        (first, one.sighting.place, other.sighting.place),
        (second, one.number, other.number),
    )
    return sum(abs(int(content.stamps_ns[a]) - int(content.stamps_ns[b])) for content, a, b in ways)


MIN_LINKS = 5
"""So many keyframes of one map must be recognised in the other, and agree."""


@dataclass(frozen=True, slots=True)
class MergeSummary:
    """How two maps fitted.

    Attributes:
        verified: keyframes of the second map that were located in the first.
        agreeing: how many of these agree with each other.
        accepted: how many of these the pose graph did not reject.
        fused: features of the second map that are now one with some of the first.
        link_rmse_m: root mean square of what is left of the links between the maps.
        link_rmse_deg: the same of their orientation.
        first_moved_m: how far keyframes of the first map were moved, on average.
    """

    verified: int
    agreeing: int
    accepted: int
    fused: int
    link_rmse_m: float
    link_rmse_deg: float
    first_moved_m: float


@dataclass(frozen=True, slots=True, eq=False)
class MergedMaps:
    """The map that came of two, in the world of the first, and how they fitted."""

    content: SlamMap
    summary: MergeSummary


def merge_maps(
    first: SlamMap,
    second: SlamMap,
    loops: LoopClosureConfig,
    localization: LocalizationConfig,
    seed: int = 0,
) -> MergedMaps:
    """One map of two.

    Args:
        first: its first keyframe stays where it is.
        second: of the same place; its world may be any other.
        loops: how places are verified, and how much odometry drifts.
        localization: how many candidates are tried, and when sightings agree.
        seed: of the training of the new vocabulary.

    Raises:
        DataError: if descriptors are of different kinds.
        EstimationError: if they share no place.
    """
    level = first.gravity_aligned and second.gravity_aligned
    seen = list(recognised(first, second, loops, localization, level))
    agreeing, first_T_second = agreement(first, second, seen, localization, level)
    if len(agreeing) < MIN_LINKS:
        raise EstimationError(
            f"the maps of {names(first)} and {names(second)} share no place: {len(seen)} of "
            f"{len(second)} keyframes were recognised, of which {len(agreeing)} agree, and "
            f"{MIN_LINKS} must; are they of the same place, seen by cameras held alike? Maps with "
            "more keyframes (loop_closure.keyframes.distance_m and angle_rad) overlap more"
        )
    joined = _side_by_side(first, second, first_T_second, level)
    links = [_link(one, len(first)) for one in agreeing]
    poses, held = _solved(joined, links, loops, level)
    accepted = [one for one, good in zip(agreeing, held, strict=True) if good]
    if len(accepted) < MIN_LINKS:
        raise EstimationError(
            f"the maps of {names(first)} and {names(second)} cannot be laid on each other: only "
            f"{len(accepted)} of {len(agreeing)} links between them hold"
        )
    body_points = _body_points(joined)
    features, fused = _fused(first, second, accepted)
    moved = replace(
        joined,
        poses=poses,
        links=_chained(joined.links, links_of([_link(one, len(first)) for one in accepted])),
        vocabulary=trained(
            [joined.descriptors_of(n) for n in range(len(joined))], loops.places, seed
        ),
    )
    error_px = 2.0 * loops.verification.max_error_px  # the maps do not fit as well as one does
    content = with_features(moved, features, body_points, error_px)
    rmse_m, rmse_deg = _left(content, len(accepted))
    shift = poses.translations[: len(first)] - first.poses.translations
    return MergedMaps(
        content,
        MergeSummary(
            len(seen),
            len(agreeing),
            len(accepted),
            fused,
            rmse_m,
            rmse_deg,
            float(np.linalg.norm(shift, axis=1).mean()),
        ),
    )


def _link(one: Recognised, offset: int) -> Loop:
    """The sighting as a loop closure of the joined map."""
    return replace(one.sighting.loop, first=one.sighting.place, second=offset + one.number)


def _side_by_side(
    first: SlamMap, second: SlamMap, first_T_second: gtsam.Pose3, level: bool
) -> SlamMap:
    """Both in one map, none of the features fused."""
    R, t = first_T_second.rotation().matrix(), first_T_second.translation()
    turned = Poses(
        R @ second.poses.rotations,
        second.poses.translations @ R.T + t,
    )
    features = second.features + np.where(second.features >= 0, len(first.points), 0)
    links = replace(second.links, ends=second.links.ends + len(first))

    def both(name: str) -> FloatArray:
        return np.concatenate([getattr(first, name), getattr(second, name)])

    return SlamMap(
        first.recordings + second.recordings,
        datetime.now(UTC).isoformat(timespec="seconds"),
        __version__,
        level,
        np.concatenate([first.recording_of, second.recording_of + len(first.recordings)]),
        np.concatenate([first.stamps_ns, second.stamps_ns]),
        _stacked(first.poses, turned),
        np.concatenate([first.points, second.points @ R.T + t]),
        np.concatenate([first.feature_descriptors, second.feature_descriptors]),
        np.concatenate([first.offsets, second.offsets[1:] + first.offsets[-1]]),
        np.concatenate([first.features, features]),
        both("normalized"),
        np.concatenate([first.descriptors, second.descriptors]),
        _chained(first.links, links),
        first.vocabulary,
    )


def _stacked(first: Poses, second: Poses) -> Poses:
    """Poses behind one another."""
    return Poses(
        np.concatenate([first.rotations, second.rotations]),
        np.concatenate([first.translations, second.translations]),
    )


def _chained(first: Links, second: Links) -> Links:
    """Links behind one another."""
    return Links(
        np.concatenate([first.ends, second.ends]),
        _stacked(first.measured, second.measured),
        np.concatenate([first.covariances, second.covariances]),
    )


def _solved(
    joined: SlamMap, between: list[Loop], config: LoopClosureConfig, level: bool
) -> tuple[Poses, list[bool]]:
    """Poses of all keyframes, and whether each link between the maps holds."""
    own, none = joined.links, np.zeros((0, 2), np.int64)
    inner = [
        Loop(
            int(ends[0]),
            int(ends[1]),
            gtsam.Pose3(gtsam.Rot3(own.measured.rotations[n]), own.measured.translations[n]),
            own.covariances[n],
            0,
            0,
            none,
        )
        for n, ends in enumerate(own.ends)
    ]
    # an edge to the next number counts as odometry, which is above suspicion
    usable = [abs(loop.first - loop.second) > 1 for loop in between]
    loops = inner + [loop for loop, good in zip(between, usable, strict=True) if good]
    # two recordings have no common clock, by which a drift could be learned
    update = {"degrees_of_freedom": 4 if level else 6, "learn_drift": False}
    settings = config.model_copy(update=update)
    graph = loop_graph(joined.stamps_ns, joined.poses, loops, settings, joined.recording_of)
    policy = PoseGraphPolicy(cost=PoseGraphCostPolicy(robust="gnc", initialization="file"))
    solution = optimize_pose_graph(replace(graph, name="merged maps"), policy, Diagnostics())
    poses = corrected(graph, solution.poses, joined.poses, settings.degrees_of_freedom)
    weights = iter(solution.weights[len(solution.weights) - sum(usable) :].tolist())
    return poses, [good and next(weights) > 0.5 for good in usable]


def _body_points(content: SlamMap) -> FloatArray:
    """(N, 3) the feature of each observation in its body frame; NaN where there is none."""
    points = np.full((len(content.features), 3), np.nan)
    known = np.flatnonzero(content.features >= 0)
    at = content.keyframe_of[known]
    away = content.points[content.features[known]] - content.poses.translations[at]
    points[known] = np.einsum("nji,nj->ni", content.poses.rotations[at], away)
    return points


def _fused(first: SlamMap, second: SlamMap, accepted: list[Recognised]) -> tuple[IntArray, int]:
    """(N,) feature of each observation of both maps, and how many of the second's were fused."""
    offset = len(first.points)
    other = second.features.copy()
    other[other >= 0] += offset
    pairs = []
    for one in accepted:
        rows = second.offsets[one.number] + one.sighting.loop.pairs[:, 1]
        unknown = other[rows] == NO_FEATURE
        other[rows[unknown]] = one.sighting.features[unknown]
        pairs.append(np.column_stack([one.sighting.features, other[rows]]))
    same = np.concatenate(pairs)
    groups = together(offset + len(second.points), same)
    features = np.concatenate([first.features, other])
    known = features >= 0
    features[known] = groups[features[known]]
    fused = np.unique(same[:, 1][same[:, 1] >= offset])
    return features, len(fused)


def _left(content: SlamMap, count: int) -> tuple[float, float]:
    """Root mean square of what the last links leave: metres and degrees."""
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
