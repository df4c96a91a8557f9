# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of a map: all its keyframes and features, from what its first camera has seen.

A map becomes a problem in BAL's form with a camera for each keyframe, and the solver is that of BAL
problems. What images of a few keyframes do not know, scale and gravity above all, is known from the
visual-inertial estimate that the map was made with: it is a prior on all poses and points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.bundle_adjustment.bal_policy import BalSolution
from slam_graph.bundle_adjustment.bal_problem import BalEstimates, BalPrior, BalProblem, rays_of
from slam_graph.bundle_adjustment.bal_solve import adjust_bundle
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.maps.map_config import MapBalPolicy, MapPriorPolicy
from slam_graph.maps.map_model import SlamMap
from slam_graph.pose_graph.graph import Poses

FLIP = np.array([1.0, -1.0, -1.0])
"""From the frame of a camera to that of BAL's, which looks along -z and has y up; and back."""


@dataclass(frozen=True, slots=True, eq=False)
class MapAdjustment:
    """What came of the bundle adjustment of a map.

    Attributes:
        before: the map as it was.
        after: the map with the estimates.
        solution: of the problem that it was made.
    """

    before: SlamMap
    after: SlamMap
    solution: BalSolution


def adjust_map(
    content: SlamMap,
    policy: MapBalPolicy | None = None,
    diagnostics: Diagnostics | None = None,
    name: str = "map",
) -> MapAdjustment:
    """Estimate all keyframes and features of a map.

    Links and descriptors stay. If intrinsics are estimated, where features are seen on the plane
    z = 1 is corrected by them; the calibration that the map tells of stays.

    Args:
        content: the map.
        policy: how; the defaults if not said.
        diagnostics: counts what is left out, and what did not go as asked.
        name: of the map, for messages.

    Raises:
        DataError: if no feature is observed in the map.
        EstimationError: if the cost cannot be minimised.
    """
    policy, diagnostics = policy or MapBalPolicy(), diagnostics or Diagnostics()
    if any(recording.poses == "adjusted" for recording in content.recordings):
        diagnostics.warn(
            "map_adjusted_before",
            f"{name}: was adjusted before: its observations count twice; take the map of the run",
        )
    problem = bundle_of(content, policy.prior, name)
    solution = adjust_bundle(problem, policy, diagnostics)
    return MapAdjustment(content, _with_estimates(content, solution.estimates, problem), solution)


def bundle_of(content: SlamMap, prior: MapPriorPolicy, name: str = "map") -> BalProblem:
    """A map as a problem in BAL's form, in the same world.

    Pixels are those of one focal length for all keyframes, the mean of the calibrated ones.

    Args:
        content: the map, of which K keyframes become cameras.
        prior: how far its poses and points may be wrong.
        name: of the problem.

    Raises:
        DataError: if no feature is observed.
    """
    known = np.flatnonzero(content.features >= 0)
    if len(known) == 0:
        raise DataError(f"{name}: none of the map's features was seen by a keyframe; make it again")
    mounts, logs = _mounts(content), _log_focals(content)
    world_R_camera = content.poses.rotations @ mounts.rotations
    centres = content.poses.translations + np.einsum(
        "kij,kj->ki", content.poses.rotations, mounts.translations
    )
    rotations = FLIP[:, None] * world_R_camera.transpose(0, 2, 1)
    focal = float(np.exp(np.mean(logs)))
    estimates = BalEstimates(
        rotations,
        -np.einsum("kij,kj->ki", rotations, centres),
        np.tile([focal, 0.0, 0.0], (len(content), 1)),
        content.points,
    )
    camera, point = content.keyframe_of[known], content.features[known]
    nearest = np.full(len(content.points), np.inf)
    away = np.linalg.norm(content.points[point] - centres[camera], axis=1)
    np.minimum.at(nearest, point, away)
    held = BalPrior(
        rotations,
        centres,
        content.points,
        prior.rotation_sigma,
        prior.position_sigma,
        prior.point_sigma * nearest,
    )
    pixels = focal * FLIP[:2] * content.normalized[known]
    return BalProblem(estimates, camera, point, pixels, name, held, content.recording_of)


def _with_estimates(content: SlamMap, found: BalEstimates, problem: BalProblem) -> SlamMap:
    """The map with the estimates of a problem that was made of it; its rays by their intrinsics."""
    mounts = _mounts(content)
    world_R_camera = (FLIP[:, None] * found.rotations).transpose(0, 2, 1)
    rotations = world_R_camera @ mounts.rotations.transpose(0, 2, 1)
    positions = found.centres() - np.einsum("kij,kj->ki", rotations, mounts.translations)
    before, after = problem.estimates.intrinsics, found.intrinsics
    normalized = content.normalized
    if not np.array_equal(before, after):
        at = content.keyframe_of
        normalized = rays_of(before[at, :1] * normalized, after[at])
    return replace(
        content,
        recordings=tuple(replace(r, poses="adjusted") for r in content.recordings),
        poses=Poses(rotations, positions),
        points=found.points,
        normalized=normalized,
    )


def _mounts(content: SlamMap) -> Poses:
    """K poses body_T_camera of the first camera."""
    mounts = [r.rig.cameras[0].body_T_camera.matrix() for r in content.recordings]
    of_keyframes = np.array(mounts)[content.recording_of]
    return Poses(of_keyframes[:, :3, :3], of_keyframes[:, :3, 3])


def _log_focals(content: SlamMap) -> FloatArray:
    """(K,) logarithms of the calibrated focal lengths in pixels."""
    cameras = [r.rig.cameras[0].camera for r in content.recordings]
    logs = np.array([0.5 * np.log(camera.fx * camera.fy) for camera in cameras])
    return np.asarray(logs[content.recording_of])
