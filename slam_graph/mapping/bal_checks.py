# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What of a bundle-adjustment problem can be estimated; all else is left out and counted."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.mapping.bal_problem import BalPart, BalProblem, BoolArray, IntArray
from slam_graph.mapping.bal_projection import project

FEWEST_VIEWS = 2
"""Cameras in which a point must have been seen of which nothing else is known."""


def usable(problem: BalProblem, diagnostics: Diagnostics) -> BalPart:
    """The part of a problem that can be estimated.

    Left out and counted are second observations of a point in a camera, observations of points
    that are not in front of their camera at the start, points that are then seen by fewer than two
    cameras unless there is a prior, and cameras that see none of the others. They keep the
    estimates that they have.

    Raises:
        DataError: if nothing is left.
    """
    kept = _first_of_pair(problem, diagnostics)
    kept = kept[_in_front(problem.keep(kept), diagnostics)]
    if problem.prior is None:
        kept = kept[_seen_twice(problem.keep(kept), diagnostics)]
    for camera in np.setdiff1d(np.arange(problem.cameras), problem.camera[kept]):
        diagnostics.warn(
            "bal_camera_without_observations",
            f"{problem.name}: camera {camera} sees no point that can be used; it stays as it is",
        )
    if len(kept) == 0:
        raise DataError(f"{problem.name}: no point is in front of two cameras that saw it")
    return _renumbered(problem.keep(kept), diagnostics)


def _first_of_pair(problem: BalProblem, diagnostics: Diagnostics) -> IntArray:
    """The first observation of each point in each camera, by camera and then point."""
    pairs = problem.camera * problem.points + problem.point
    _, first = np.unique(pairs, return_index=True)
    for row in np.setdiff1d(np.arange(len(pairs)), first):
        diagnostics.warn(
            "bal_repeated_observation",
            f"{problem.name}: observation {row}: point {problem.point[row]} in camera "
            f"{problem.camera[row]} again; left out",
        )
    return np.asarray(first, dtype=np.int64)


def _in_front(problem: BalProblem, diagnostics: Diagnostics) -> BoolArray:
    """(N,) whether the point of each observation is in front of its camera."""
    pixels, depths = project(problem.estimates, problem.camera, problem.point)
    good = (depths > 0) & np.isfinite(pixels).all(axis=1)
    for row in np.flatnonzero(~good):
        diagnostics.warn(
            "bal_point_behind_camera",
            f"{problem.name}: point {problem.point[row]} is not in front of camera "
            f"{problem.camera[row]}; the observation is left out",
        )
    return good


def _seen_twice(problem: BalProblem, diagnostics: Diagnostics) -> BoolArray:
    """(N,) whether the point of each observation is seen by two cameras or more."""
    views = np.bincount(problem.point, minlength=problem.points)
    for point in np.flatnonzero(views < FEWEST_VIEWS):
        diagnostics.warn(
            "bal_point_seen_once",
            f"{problem.name}: point {point} is seen by {views[point]} cameras; it stays as it is",
        )
    good: BoolArray = views[problem.point] >= FEWEST_VIEWS
    return good


def _renumbered(problem: BalProblem, diagnostics: Diagnostics) -> BalPart:
    """The problem with only the variables that have observations."""
    cameras, camera = np.unique(problem.camera, return_inverse=True)
    points, point = np.unique(problem.point, return_inverse=True)
    estimates = problem.estimates.select(cameras, points)
    prior, lenses = problem.prior, problem.lenses
    prior = None if prior is None else prior.select(cameras, points)
    lenses = None if lenses is None else np.unique(lenses[cameras], return_inverse=True)[1]
    part = BalProblem(estimates, camera, point, problem.pixels, problem.name, prior, lenses)
    groups = _groups(part)
    apart = range(1, int(groups.max()) + 1) if prior is None else range(0)
    for group in apart:
        diagnostics.warn(
            "bal_not_connected",
            f"{problem.name}: {np.count_nonzero(groups == group)} cameras have no point in common "
            "with the first ones; where they are to them stays as it is",
        )
    return BalPart(part, cameras, points, groups)


def _groups(part: BalProblem) -> IntArray:
    """(C,) the number of the group of cameras that each is in, linked by common points."""
    size = part.cameras + part.points
    ends = (part.camera, part.cameras + part.point)
    links = coo_array((np.ones(len(part.camera)), ends), shape=(size, size))
    _, labels = connected_components(links, directed=False)
    _, groups = np.unique(labels[: part.cameras], return_inverse=True)
    return groups.astype(np.int64)
