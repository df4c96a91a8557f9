# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A window in a world that is moved, with what is not known of the motion added to its prior.

The prior ‖R δ - d‖² is relative to the first state. A world that is moved by an error g of the
gauge moves all variables by N g, with N the directions that no image measures. So the prior of the
moved variables is min over g of ‖R (δ - N g) - d‖² + ‖Γ^-½ g‖², by a QR whose columns begin with g.
Lever arm and clock of the fixes, where they are variables, enter with it: Γ is then the joint
covariance of the gauge and of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.world_alignment import WorldAlignment
from slam_graph.backend.initialization.segment_joint import moved
from slam_graph.backend.marginalization.landmark_store import LandmarkStore
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.state import dims_of, letter_and_index
from slam_graph.backend.window import Window
from slam_graph.backend.world_gauge import turned_axes


def regauged(
    window: Window,
    found: WorldAlignment,
    keys: tuple[int, ...] = (),
    calibration: gtsam.Values | None = None,
) -> Window:
    """The same window in the world of the fixes.

    Features that are not tracked any more are forgotten.

    Args:
        window: between two steps.
        found: how the worlds are to one another.
        keys: of clock and lever arm of the fixes, as far as they become variables, in the order
            of the joint covariance.
        calibration: their values.
    """
    motion, covariance, centre = found.motion, found.covariance, found.centre
    there = moved(window, motion)
    prior = there.prior
    N = gauge_directions(there.state.first, prior.layout, centre, level=len(covariance) == 4)
    store = LandmarkStore()
    store.open = window.lost_features.open
    if calibration is not None:
        covariance = found.joint_covariance
        there.state.insert_calibration(calibration)
        there.state.freeze(keys)
    return replace(
        there,
        prior=with_free_gauge(prior, N, covariance, keys),
        calibration=(*window.calibration, *keys),
        lost_features=store,
    )


def with_free_gauge(
    prior: SquareRootInformation,
    directions: FloatArray,
    covariance: FloatArray,
    keys: Sequence[int] = (),
) -> SquareRootInformation:
    """A prior with an independent error along some directions added, and variables tied to it.

    Args:
        prior: over n variables.
        directions: (n, k).
        covariance: (k + m, k + m) of the error along them, and of the new variables.
        keys: of the new variables, with m components.
    """
    count, known = directions.shape[1], prior.extended(dims_of(keys))
    size = len(known.Rd)
    rows = np.zeros((size + len(covariance), count + size))
    rows[: len(directions), :count] = -prior.R @ directions
    rows[:size, count:] = known.Rd
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    rows[size:, :count] = root[:, :count]
    rows[size:, count:-1][:, known.layout.indices(keys)] = root[:, count:]
    return SquareRootInformation(known.layout, triangularize(rows)[count:, count:])


def gauge_directions(
    values: gtsam.Values, layout: Layout, centre: FloatArray, level: bool
) -> FloatArray:
    """Tangents (n, 4 or 6) of variables when the world shifts (m) and turns (rad) about a point.

    Args:
        values: of the variables.
        layout: their columns.
        centre: (3,) the point.
        level: whether the world turns about the vertical only.
    """
    axes = turned_axes(level)
    directions = np.zeros((layout.size, 3 + len(axes)))
    for key, columns in layout.columns.items():
        kind, block = letter_and_index(key)[0], directions[columns]
        if kind == "x":
            pose = values.atPose3(key)
            body_R_world = pose.rotation().matrix().T
            block[:3, 3:] = body_R_world @ axes.T
            block[3:, :3] = body_R_world
            block[3:, 3:] = body_R_world @ np.cross(axes, pose.translation() - centre).T
        elif kind == "v":
            block[:, 3:] = np.cross(axes, values.atVector(key)).T
        elif kind == "l":
            block[:, :3] = np.eye(3)
            block[:, 3:] = np.cross(axes, values.atPoint3(key) - centre).T
    return directions
