# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A world in another unit of length: one camera whose path fixes have told the scale of.

Images see the camera, whose place in the body is in metres. So it is the path of the camera that is
scaled, with its velocity and all features, and the body follows: with the camera at c in the body,
a pose (R, p) becomes (R, s (p + R c) - R c), and the velocity s v + (s - 1) R (ω × c). That is a
change of variables y = S(x). Tangents of poses and features change linearly, those of velocities to
first order; with T the derivative, a prior ‖R δ - d‖² is ‖R T⁻¹ δ' - d‖² of the new ones.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.posed_frame import PosedFrame, rescaled_motion
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.state import State, dims_of, letter_and_index
from slam_graph.backend.window import Window
from slam_graph.geometry import NavState

_ROTATION, _POSITION, _VELOCITY, _RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(12, 15)


def rescaled(window: Window, scale: float, camera: gtsam.Pose3 | None) -> Window:
    """The same window in another unit of length.

    Its factors stay: they are dynamics, whose noise is as configured in either unit.

    Args:
        window: between two steps.
        scale: new units of length per old one.
        camera: body_T_camera; None where lengths are in metres already.
    """
    if camera is None:
        return window
    arm, state = np.asarray(camera.translation()), window.state
    layout = Layout(dims_of(state.variables()))
    first, frozen = gtsam.Values(state.first_frames), state.frozen
    for key in state.first_frames.keys():  # noqa: SIM118 (not a dict)
        kind, frame = letter_and_index(key)
        if kind == "x":
            first.update(key, PosedFrame.rescaled_pose(first.atPose3(key), scale, camera))
        elif kind == "v":
            rate = -first.atConstantBias(B(frame)).gyroscope()
            turning = first.atPose3(X(frame)).rotation().rotate(np.cross(rate, arm))
            first.update(key, scale * first.atVector(key) + (scale - 1.0) * turning)
    offset = tangents(state.first, layout, scale, arm) @ state.offset(layout)
    there = State()
    there.insert(first)
    there.insert_points(state.points.ids, scale * state.points.first)
    there.update(layout, offset)
    there.freeze(frozen)
    there.motions = {i: rescaled_motion(motion, scale, arm) for i, motion in state.motions.items()}
    T = tangents(state.first, window.prior.layout, scale, arm)
    Rd = np.array(window.prior.Rd)
    Rd[:-1, :-1] = np.linalg.solve(T.T, window.prior.R.T).T
    (kept, at_kept), (last, at_last) = window.kept_points, window.last_points
    return replace(
        window,
        state=there,
        prior=SquareRootInformation(window.prior.layout, triangularize(Rd)),
        kept_points=(kept, scale * at_kept),
        last_points=(last, scale * at_last),
    )


def tangents(values: gtsam.Values, layout: Layout, scale: float, arm: FloatArray) -> FloatArray:
    """Derivative T (n, n) of the variables in the new unit by those in the old one.

    Args:
        values: of the variables in the old unit, with the negative angular rate as the bias of a
            gyroscope.
        layout: their columns.
        scale: new units of length per old one.
        arm: (3,) position of the camera in the body.
    """
    T = np.eye(layout.size)
    for key, columns in layout.columns.items():
        kind, frame = letter_and_index(key)
        own = T[columns, columns]
        if kind == "x":
            own[3:, 3:] *= scale
            own[3:, :3] = (1.0 - scale) * _cross(arm)
        elif kind == "v":
            own *= scale
            R = values.atPose3(X(frame)).rotation().matrix()
            rate = -values.atConstantBias(B(frame)).gyroscope()
            by_turn, by_rate = _of_turning(R, rate, scale, arm)
            if X(frame) in layout:
                T[columns, layout.columns[X(frame)]][:, :3] = by_turn
            if B(frame) in layout:
                T[columns, layout.columns[B(frame)]][:, 3:] = by_rate
        elif kind == "l":
            own *= scale
    return T


def rescaled_states(
    states: list[NavState], scale: float, camera: gtsam.Pose3 | None
) -> list[NavState]:
    """States in another unit of length, with their covariances; see `rescaled`.

    Args:
        states: in the order of time; the angular rate is taken from their rotations.
        scale: new units of length per old one.
        camera: body_T_camera; None where lengths are in metres already.
    """
    if camera is None or not states:
        return states
    arm, found = np.asarray(camera.translation()), []
    for state, rate in zip(states, _rates(states), strict=True):
        R = state.world_T_body.rotation().matrix()
        T = np.eye(len(NavState.COMPONENTS))
        T[_POSITION, _POSITION] *= scale
        T[_POSITION, _ROTATION] = (1.0 - scale) * _cross(arm)
        T[_VELOCITY, _VELOCITY] *= scale
        T[_VELOCITY, _ROTATION], T[_VELOCITY, _RATE] = _of_turning(R, rate, scale, arm)
        known = state.covariance
        there = replace(
            state,
            world_T_body=PosedFrame.rescaled_pose(state.world_T_body, scale, camera),
            velocity=scale * state.velocity + (scale - 1.0) * R @ np.cross(rate, arm),
            covariance=None if known is None else T @ known @ T.T,
        )
        found.append(there)
    return found


def _of_turning(
    R: FloatArray, rate: FloatArray, scale: float, arm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (3, 3) of the new velocity by rotation and by the bias -ω of a gyroscope."""
    factor = scale - 1.0
    return -factor * R @ _cross(np.cross(rate, arm)), factor * R @ _cross(arm)


def _rates(states: list[NavState]) -> FloatArray:
    """Angular rates (N, 3) of the body, rad/s, from its neighbours; zero of one alone."""
    if len(states) < 2:
        return np.zeros((len(states), 3))
    steps = [
        gtsam.Rot3.Logmap(a.world_T_body.rotation().between(b.world_T_body.rotation()))
        / ((b.stamp_ns - a.stamp_ns) * 1e-9)
        for a, b in pairwise(states)
    ]
    around: FloatArray = np.array([steps[0], *steps, steps[-1]])
    return 0.5 * (around[:-1] + around[1:])


def _cross(vector: FloatArray) -> FloatArray:
    """(3, 3) of the cross product with a vector (3,) from the left."""
    return np.asarray(gtsam.Rot3.Hat(vector))
