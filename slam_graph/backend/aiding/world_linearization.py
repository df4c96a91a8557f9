# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A step that turns the world turns it as one body, its linearisation points with it.

First-estimates Jacobians keep the linearisation point x̄ of every variable, so that what no image
measures stays unmeasured: with the directions N of the gauge, R N(x̄) = 0. Fixes measure the gauge.
A step N(x̄) g is a motion of the world for variables that are at x̄ only. A feature whose first
estimate is metres off does not turn with the cameras that see it; the next frame takes that for an
error of its images, and corrects what was right. And where estimates turn and x̄ stays, new frames,
which begin at the estimates, are turned against the old ones in every Jacobian.

So the part N g of a step is replaced by the motion M(g) that it stands for, and the linearisation
points become M x̄. The prior ‖R δ - d‖² becomes one with R' = R T⁻¹, where T turns the axes of
velocities and features, so that R' N(M x̄) = R N(x̄). Where steps are repeated until the cost falls
no more, estimates stay where they are, and only x̄ moves.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.regauging import gauge_directions, gauge_motion
from slam_graph.backend.aiding.rescaling import rescaled
from slam_graph.backend.cost.unit_of_length import scale_direction
from slam_graph.backend.initialization.segment_joint import moved
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import State, dims_of, letter_and_index
from slam_graph.backend.window import Window

_LEAST_CHANGE = 1e-4
"""Turn of the world (rad), or change of the logarithm of its scale, from which points are moved."""
_LEAST_SHIFT_M = 1e-3
"""The same for a shift of the world."""
_SIGNIFICANT = 3.0
"""Where a change of the scale is below this many of its σ, by how well a motion of the world
explains what a step did to the poses, there is none: over a short baseline it would be noise."""


def moved_with_world(
    window: Window,
    before: State,
    level: bool,
    scaled_camera: gtsam.Pose3 | None,
    linear: bool,
) -> Window:
    """The window after a step, with the motion of its world that of one body.

    Args:
        window: between two steps, in the world of the fixes.
        before: its variables before the last step.
        level: whether gravity is measured.
        scaled_camera: body_T_camera of a camera whose unit of length only fixes tell; None where
            other sensors measure it.
        linear: whether the estimates are where one step along straight tangents has led.
    """
    gauge = _Gauge(window, level, scaled_camera)
    g = gauge.of_step(before)
    growth = float(g[-1]) if scaled_camera is not None else 0.0
    change = max(float(np.linalg.norm(g[3 : 4 if level else 6])), abs(growth))
    if change < _LEAST_CHANGE and float(np.linalg.norm(g[:3])) < _LEAST_SHIFT_M:
        return window
    state, known = window.state, window.prior.layout
    layout = Layout(dims_of(state.variables()))
    step = gauge.directions(state.first, layout) @ g
    without = state.copy()
    without.update(layout, -step)
    of_prior = step[layout.indices(known.dims)]
    about = replace(window, state=without, prior=window.prior.shifted(of_prior))
    grown = rescaled(about, float(np.exp(growth)), scaled_camera)
    # `rescaled` leaves the origin where it is, the gauge its centre
    back = gtsam.Pose3(gtsam.Rot3(), (1.0 - np.exp(growth)) * gauge.centre)
    motion = gauge_motion(g, gauge.centre, level).compose(back)
    there = moved(grown, motion)
    if not linear:
        linearised = _with_estimates(there.state, state)
        off = linearised.offset(known) - there.state.offset(known)
        there = replace(there, state=linearised, prior=there.prior.shifted(-off))
    if scaled_camera is None:
        increments = {key: step[columns] for key, columns in layout.columns.items()}
        window.lost_features.follow_world(motion, gauge.centre, increments)
    else:
        window.lost_features.forget()
    # points outside the state have moved with the step
    return replace(there, kept_points=window.kept_points, last_points=window.last_points)


class _Gauge:
    """The directions in which nothing but fixes measures a window.

    Numbers g along them are a shift (m), a turn (rad), and the logarithm of the scale if that is
    unknown: 4 to 7 of them.

    Attributes:
        centre: (3,) the point about which its world turns and is scaled.
    """

    def __init__(self, window: Window, level: bool, scaled_camera: gtsam.Pose3 | None) -> None:
        self._window, self._level, self._camera = window, level, scaled_camera
        self.centre = window.state.first_frames.atPose3(X(window.frame)).translation()

    def directions(self, values: gtsam.Values, layout: Layout) -> FloatArray:
        """Tangents (n, 4 to 7) of variables.

        Args:
            values: of the variables.
            layout: their columns.
        """
        N = gauge_directions(values, layout, self.centre, self._level)
        if self._camera is None:
            return N
        arm = np.asarray(self._camera.translation())
        return np.column_stack([N, scale_direction(values, layout, self.centre, arm)])

    def of_step(self, before: State) -> FloatArray:
        """The motion g of the world that is nearest to what a step did to the poses.

        Args:
            before: the variables before the step.
        """
        state, known = self._window.state, self._window.prior.layout
        poses = [key for key in known.dims if letter_and_index(key)[0] == "x"]
        layout = Layout(dims_of(key for key in poses if before.frames.exists(key)))
        N = self.directions(state.first_frames, layout)
        moves = [
            before.frames.atPose3(key).localCoordinates(state.frames.atPose3(key))
            for key in layout.dims
        ]
        step = np.concatenate([np.zeros(0), *moves])  # of no poses: nothing
        g = np.asarray(np.linalg.lstsq(N, step, rcond=None)[0])
        if self._camera is not None and not _is_significant(N, step, g):
            g[:-1] = np.linalg.lstsq(N[:, :-1], step, rcond=None)[0]
            g[-1] = 0.0
        return g


def _is_significant(N: FloatArray, step: FloatArray, g: FloatArray) -> bool:
    """Whether the last of some numbers g (k,), step (n,) ≈ N (n, k) g, is more than noise."""
    free = len(step) - len(g)
    information = N.T @ N
    if free <= 0 or np.linalg.cond(information) > 1.0 / np.finfo(np.float64).eps:
        return False
    variance = np.sum((step - N @ g) ** 2) / free
    sigma = np.sqrt(variance * np.linalg.inv(information)[-1, -1])
    return bool(abs(g[-1]) > _SIGNIFICANT * sigma)


def _with_estimates(points: State, estimates: State) -> State:
    """A state with the linearisation points of one, and the estimates of another one.

    Args:
        points: of the same variables.
        estimates: in the same world.
    """
    there, layout = State(), Layout(dims_of(estimates.variables()))
    there.insert(points.first_frames)
    there.insert_points(points.points.ids, points.points.first)
    tangents = points.first_frames.localCoordinates(estimates.frames)
    offset = np.zeros(layout.size)
    places = dict(zip(points.points.ids.tolist(), range(len(points.points.ids)), strict=True))
    apart = estimates.points.estimate - points.points.first
    for key, columns in layout.columns.items():
        kind, index = letter_and_index(key)
        offset[columns] = apart[places[index]] if kind == "l" else tangents.at(key)
    there.update(layout, offset)
    there.freeze(estimates.frozen)
    there.motions = dict(estimates.motions)
    return there
