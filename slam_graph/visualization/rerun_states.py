# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The states of a run in Rerun: the pose of the body, its uncertainty, and the path that grows."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.geometry import NavState
from slam_graph.visualization.rerun_palette import YELLOW
from slam_graph.visualization.rerun_stream import RerunStream

_ROWS_IN_FILES = 4000
"""States that are sent together where nobody waits for them; else each is sent at once."""


class StateRows:
    """Sends states.

    Args:
        stream: where they go.
        world: entity of the world of the run.
    """

    def __init__(self, stream: RerunStream, world: str) -> None:
        self._stream, self._world = stream, world
        self._most = _ROWS_IN_FILES if stream.saves else 1
        self._last: FloatArray | None = None
        self._clear()
        style_ellipsoids(stream, f"{world}/body/position_sigma")

    def _clear(self) -> None:
        self._times: list[tuple[int, int]] = []
        self._poses: list[FloatArray] = []
        self._pieces: list[FloatArray] = []
        self._ellipsoids: list[tuple[FloatArray, FloatArray]] = []

    def add(self, number: int, stamp_ns: int, state: NavState) -> None:
        """Add the state of a frame."""
        pose = state.world_T_body
        position = np.asarray(pose.translation())
        self._times.append((number, stamp_ns))
        self._poses.append(np.concatenate([position, _quaternion(pose.rotation())]))
        self._pieces.append(np.array([position if self._last is None else self._last, position]))
        self._last = position
        self._ellipsoids.append(_ellipsoid(state.covariance))
        if len(self._times) >= self._most:
            self.flush()

    def flush(self) -> None:
        """Send the states that are kept."""
        if not self._times:
            return
        rr, body = self._stream.rr, f"{self._world}/body"
        frames, stamps_ns = np.array(self._times, np.int64).T
        poses = np.array(self._poses)
        sizes = np.concatenate([size for size, _ in self._ellipsoids])
        axes = np.repeat([axis for _, axis in self._ellipsoids], 2, axis=0)
        ellipsoids = rr.Ellipsoids3D.columns(half_sizes=sizes, quaternions=axes)
        columns = {
            body: rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, 3:]),
            f"{self._world}/path/causal": rr.LineStrips3D.columns(strips=self._pieces),
            f"{body}/position_sigma": ellipsoids.partition([2] * len(poses)),
        }
        for entity, column in columns.items():
            self._stream.send_columns(entity, frames, stamps_ns, column)
        self._clear()


def style_ellipsoids(stream: RerunStream, entity: str) -> None:
    """Say how two ellipsoids look, 1σ and 3σ."""
    ellipsoids = stream.rr.Ellipsoids3D.from_fields(
        colors=[(*YELLOW, 255), (*YELLOW, 120)], line_radii=[-0.6], fill_mode="majorwireframe"
    )
    stream.log(entity, ellipsoids, static=True)


def _ellipsoid(covariance: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Half sizes (2, 3) of 1σ and 3σ of the position, m, and the rotation to their axes."""
    if covariance is None:
        return np.zeros((2, 3)), np.array([0.0, 0.0, 0.0, 1.0])
    sigmas, quaternion = ellipsoid_axes(covariance[3:6, 3:6])
    return np.array([sigmas, 3 * sigmas]), quaternion


def ellipsoid_axes(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Standard deviations (3,) along the axes of a covariance (3, 3), and the rotation to them."""
    values, vectors = np.linalg.eigh(covariance)
    vectors[:, 0] *= np.sign(np.linalg.det(vectors))
    return np.sqrt(np.maximum(values, 0.0)), _quaternion(gtsam.Rot3(vectors))


def _quaternion(rotation: gtsam.Rot3) -> FloatArray:
    """A rotation as a quaternion (x, y, z, w)."""
    quaternion: Any = rotation.toQuaternion()  # unknown to the stubs
    return np.asarray(quaternion.coeffs())
