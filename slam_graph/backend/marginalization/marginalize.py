# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 3, marginalization: variables leave, and the Gaussian prior that they leave behind.

The unobservable directions: global position and heading. Neither cameras nor an IMU measure them,
so a prior must not gain information along these four directions. First-estimates Jacobians prevent
that (`state.py`). Where linearisation points must move after all, `relinearized` changes the prior
by the least that keeps its information along the directions as it was: at the new points the same
as at the old ones (the idea of observability constraints, Huang, Mourikis & Roumeliotis 2010; Hesch
et al. 2014).

min over (x_K, x_M) of c = min over x_K of (min over x_M of c): the inner minimum of the linearised
cost is again a quadratic in x_K, the marginal prior. A QR whose columns begin with x_M gives it
without forming the information matrix (see `SquareRootInformation.marginal`).

Which residuals become part of the prior follows from what the policies keep. A filter (features
used once or in the state, no past IMU states) keeps no residual: all become part of the prior.
Otherwise those do that touch a variable which leaves, and all observations of features of the
state; the others are linearised anew in the next step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.construction import ConstructedCost
from slam_graph.backend.cost.feature_tracks import Outcome
from slam_graph.backend.marginalization.landmark_store import LandmarkStore
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.backend.solve.gauss_newton import Minimum, linearized
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.state import State
from slam_graph.backend.window import Window, no_points

UP = np.array([0.0, 0.0, 1.0])


def unobservable_directions(values: gtsam.Values, layout: Layout) -> FloatArray:
    """Tangents (n, 4) of a shift (m) of the world along x, y, z, and of a turn (rad) about z."""
    directions = np.zeros((layout.size, 4))
    for key, columns in layout.columns.items():
        kind, block = chr(gtsam.Symbol(key).chr()), directions[columns]
        if kind == "x":
            pose = values.atPose3(key)
            body_R_world = pose.rotation().matrix().T
            block[3:, :3] = body_R_world
            block[:3, 3] = body_R_world @ UP
            block[3:, 3] = body_R_world @ np.cross(UP, pose.translation())
        elif kind == "v":
            block[:, 3] = np.cross(UP, values.atVector(key))
        elif kind == "l":
            block[:, :3] = np.eye(3)
            block[:, 3] = np.cross(UP, values.atPoint3(key))
    return directions


def relinearized(prior: SquareRootInformation, state: State) -> SquareRootInformation:
    """Move all linearisation points to the estimates without gaining unobservable information.

    Args:
        prior: over an increment of the current estimates.
        state: its linearisation points move.
    """
    before = unobservable_directions(state.first, prior.layout)
    state.rebase()
    after = unobservable_directions(state.first, prior.layout)
    Rd = prior.Rd.copy()
    correction = np.linalg.solve(after.T @ after, after.T)
    Rd[:-1, :-1] += prior.R @ (before - after) @ correction
    return SquareRootInformation(prior.layout, triangularize(Rd))


def relative_to(
    prior: SquareRootInformation, state: State, pose: int, sigmas: tuple[float, float]
) -> SquareRootInformation:
    """The same prior, but with position and yaw of a pose as what defines the world.

    Position and yaw of the world are set free, which leaves what is known of everything else, and
    then fixed anew (an S-transformation: Baarda 1973).

    Args:
        prior: over offsets from the linearisation points.
        state: the variables.
        pose: key of the pose.
        sigmas: of position (m) and yaw (rad) of the pose from now on.
    """
    count, layout = prior.layout.size, prior.layout
    free = np.zeros((count + 1, 4))
    free[:-1] = prior.R @ unobservable_directions(state.first, layout)
    rest = triangularize(np.hstack([free, prior.Rd]))[4:, 4:]
    fixed, columns = np.zeros((4, count + 1)), layout.indices([pose])
    fixed[:3, columns[3:]] = np.eye(3) / sigmas[0]
    body_R_world = state.first_frames.atPose3(pose).rotation().matrix().T
    fixed[3, columns[:3]] = body_R_world @ UP / sigmas[1]
    fixed[:, -1] = fixed[:, :-1] @ state.offset(layout)
    return SquareRootInformation(layout, triangularize(np.vstack([rest, fixed])))


LinearizationPoints = Literal["first", "current", "corrected"]
"""Where variables of the prior are linearised (see `marginalize`)."""


def marginalize_step(
    window: Window, constructed: ConstructedCost, minimum: Minimum, algorithm: AlgorithmConfig
) -> None:
    """End a step that has succeeded: the window gets the new state and prior, and loses the rest.

    Args:
        window: gets the new state and prior; loses what does not stay.
        constructed: the cost of the step, at its minimum, and what stays.
        minimum: what the steps have come to.
        algorithm: its policies.
    """
    kept = constructed.poses.kept
    keep = window.keys(kept, constructed.moving, constructed.features)
    posterior, factors = minimum.posterior, []
    if algorithm.relinearizes:
        staying = set(keep)
        stays = [staying.issuperset(factor.keys()) for factor in window.factors]
        leaving = [f for f, stay in zip(window.factors, stays, strict=True) if not stay]
        factors = [f for f, stay in zip(window.factors, stays, strict=True) if stay]
        posterior = linearized(constructed.cost.part(leaving, constructed.absorbed))
    points: LinearizationPoints = "current"
    if algorithm.marginalization.first_estimates:
        points = "corrected" if minimum.repeated else "first"
    store = window.lost_features if constructed.keep_lost_features else None
    window.state = constructed.cost.state.copy()
    window.prior = marginalize(posterior, window.state, keep, points, store)
    window.factors, window.state_features = factors, constructed.features
    window.past, window.moving = list(kept), list(constructed.moving)
    window.past_stamps_ns = {i: window.past_stamps_ns[i] for i in kept}
    window.keyframes = set(constructed.poses.keyframes)
    if constructed.uses_images:
        window.images_wait_until_ns = None
    _keep_points(window, constructed)
    _settle_observations(window, constructed)


def _keep_points(window: Window, constructed: ConstructedCost) -> None:
    """Remember where the features are that the step estimated outside the state."""
    tracks = constructed.cost.tracks
    if tracks is None:
        if constructed.predicted is not None:  # images were used, and none of such features
            window.last_points = window.kept_points = no_points()
        return
    again = ~constructed.absorbed
    window.last_points = tracks.obs.ids, tracks.points
    window.kept_points = tracks.obs.ids[again], tracks.points[again]


def _settle_observations(window: Window, constructed: ConstructedCost) -> None:
    """Take away the observations that no longer wait."""
    cost, removals = constructed.cost, constructed.removals
    if cost.landmarks is not None:
        removals.add_features(Outcome.ABSORBED, cost.landmarks.ids)
    removals.add_features(Outcome.ABSORBED, cost.ids_of(constructed.absorbed))
    removals.apply(window.tracks, [*constructed.poses.kept, window.frame])


def marginalize(
    posterior: SquareRootInformation,
    state: State,
    keep: Sequence[int],
    points: LinearizationPoints,
    store: LandmarkStore | None = None,
) -> SquareRootInformation:
    """Eliminate all variables but `keep` and make the rest the prior of the next step.

    Args:
        posterior: over an increment of the current estimates; of the residuals that are to become
            part of the prior.
        state: the variables that leave are removed from it.
        keep: keys that stay, in the order of the new prior's columns; those that the posterior does
            not contain stay free of it.
        points: where the variables that stay are linearised from now on: where the prior was made
            (first-estimates Jacobians), at their estimates, or there without the prior gaining
            information about what no measurement sees.
        store: gets the conditional of the variables that leave, given those that stay.

    Returns:
        The prior as a function of the offsets of the estimates from their linearisation points.
    """
    staying, known = set(keep), posterior.layout.dims
    conditional, prior = posterior.divided([key for key in keep if key in known])
    if store is not None:
        store.put(conditional, state)
    state.remove([key for key in state.variables() if key not in staying])
    if points != "first" and store is not None:
        store.follow(state)
    if points == "current":
        state.rebase()
    elif points == "corrected":
        prior = relinearized(prior, state)
    state.freeze_all_of(prior.layout)  # the steps to come must not move what the prior is about
    return prior.shifted(-state.offset(prior.layout), overwrite=True)
