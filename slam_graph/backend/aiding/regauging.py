# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A window in a world that is moved: to where fixes say that it is, at first and from then on.

The prior ‖R δ - d‖² is relative to the first state. A world that is moved by an error g of the
gauge moves all variables by N g, with N the directions that no image measures. So the prior of the
moved variables is min over g of ‖R (δ - N g) - d‖² + ‖Γ^-½ g‖², by a QR whose columns begin with g.
Lever arm and clock of the fixes, where they are variables, enter with it: Γ is then the joint
covariance of the gauge and of them. Where images have not told the unit of length either, the
window is first put in metres (`rescaling.py`), and the scale is one more direction.

Later fixes move the world further. A step along straight tangents stretches what it turns, by half
of the squared angle, which the dynamics contradict; so where steps are judged by the cost and
damped (Levenberg-Marquardt), the world would stay where it is while its covariance shrinks. What is
left of such a step along N is taken as the motion that it stands for, under which images and
dynamics stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.rescaling import rescaled
from slam_graph.backend.aiding.world_alignment import WorldAlignment
from slam_graph.backend.cost.unit_of_length import scale_direction
from slam_graph.backend.initialization.segment_joint import moved, turned
from slam_graph.backend.marginalization.landmark_store import LandmarkStore
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.state import dims_of, letter_and_index
from slam_graph.backend.window import Window
from slam_graph.backend.world_gauge import turned_axes

LEAST_GAIN = 1.0
"""Least decrease of the squared errors for which the world is moved again."""


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
    covariance, centre, camera = found.covariance, found.centre, found.scaled_camera
    there = moved(rescaled(window, found.scale, camera), found.motion)
    prior, first = there.prior, there.state.first
    N = gauge_directions(first, prior.layout, centre, level=len(covariance) == 4)
    if camera is not None:
        scaling = scale_direction(first, prior.layout, centre, camera.translation())
        N = np.column_stack([N, scaling])
    store = LandmarkStore()
    store.open = window.lost_features.open
    if calibration is not None:
        covariance = found.joint_covariance
        there.state.insert(calibration)
        there.state.freeze(keys)
    return replace(
        there,
        prior=with_free_gauge(prior, N, covariance, keys),
        calibration=(*window.calibration, *keys),
        lost_features=store,
    )


def left_of_gauge(window: Window, known: SquareRootInformation, level: bool) -> FloatArray | None:
    """How far (4 or 6: m, rad) a step has left the world from where its cost is least.

    All else is held: only the motion of the world is asked for.

    Args:
        window: after the step.
        known: posterior of its variables, over an increment of the estimates.
        level: whether gravity is measured.

    Returns:
        Shift and turn about the current body; None if the cost would hardly fall.
    """
    centre = window.state.frames.atPose3(X(window.frame)).translation()
    by_gauge = known.R @ gauge_directions(window.state.first, known.layout, centre, level)
    g = np.linalg.lstsq(by_gauge, known.d, rcond=None)[0]
    gain = known.d @ known.d - np.sum((known.d - by_gauge @ g) ** 2)
    return np.asarray(g) if gain >= LEAST_GAIN else None


def moved_by_gauge(
    window: Window, known: SquareRootInformation, g: FloatArray
) -> tuple[Window, SquareRootInformation, gtsam.Pose3]:
    """A window in a world that is moved; what is known of its place stays.

    Factors of fixes stay as they are: they measure in the world that does not move. Features that
    are not tracked any more are forgotten.

    Args:
        window: between two steps.
        known: posterior of its variables, over an increment of the estimates.
        g: (4 or 6,) shift (m) and turn (rad) about the current body.

    Returns:
        The window, the posterior there, and the motion new_T_old.
    """
    level, centre = len(g) == 4, window.state.frames.atPose3(X(window.frame)).translation()
    motion = gauge_motion(g, centre, level)
    there = moved(window, motion)

    def shifted(information: SquareRootInformation) -> SquareRootInformation:
        layout = information.layout
        N = gauge_directions(there.state.first, layout, centre + g[:3], level)
        return information.shifted(N @ g)

    store = LandmarkStore()
    store.open = window.lost_features.open
    there = replace(there, prior=shifted(there.prior), lost_features=store)
    return there, shifted(turned(known, motion.rotation().matrix())), motion


def gauge_motion(g: FloatArray, centre: FloatArray, level: bool) -> gtsam.Pose3:
    """The motion new_T_old of a world that shifts and turns about a point.

    Args:
        g: (4 or more,) shift (m) and turn (rad); what follows is not used.
        centre: (3,) the point, in the world before.
        level: whether it turns about the vertical only.
    """
    axes = turned_axes(level)
    turn = gtsam.Rot3.Expmap(axes.T @ g[3 : 3 + len(axes)])
    return gtsam.Pose3(turn, centre + g[:3] - turn.rotate(centre))


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
    at_points: list[int] = []
    points: list[FloatArray] = []
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
            at_points.append(columns.start)
            points.append(values.atPoint3(key))
    if points:
        rows = np.array(at_points)[:, None] + np.arange(3)
        directions[rows, :3] = np.eye(3)
        arms = np.array(points)[:, None] - centre
        directions[rows, 3:] = np.cross(axes, arms).transpose(0, 2, 1)
    return directions
