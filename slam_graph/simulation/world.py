# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The simulated world: rooms made of rectangles (panels), each visible from one side."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.simulation.trajectories import ROOM_PITCH_M

_HEADROOM_M = 1.2
"""Distance of floor and ceiling from a trajectory."""

ROOM_WIDTH_M, ROOM_HEIGHT_M = 7.0, 3.2
DOOR_WIDTH_M, DOOR_HEIGHT_M = 1.8, 2.4


@dataclass(frozen=True, eq=False)
class Panel:
    """A rectangle, visible from the side that its normal points to.

    Attributes:
        corner: (3,) in the world.
        across, along: (3,) orthogonal unit vectors of its sides.
        size: lengths of the sides, m.
        inner: whether it can hide other panels (a wall between rooms).
    """

    corner: FloatArray
    across: FloatArray
    along: FloatArray
    size: tuple[float, float]
    inner: bool = False

    @property
    def normal(self) -> FloatArray:
        """(3,) unit vector towards the visible side."""
        return np.cross(self.across, self.along)

    @property
    def area(self) -> float:
        """In square metres."""
        return self.size[0] * self.size[1]


@dataclass(frozen=True, eq=False)
class World:
    """The static panels.

    Attributes:
        panels: outer and inner walls.
    """

    panels: tuple[Panel, ...]

    def hidden(self, eye: FloatArray, points: FloatArray) -> BoolArray:
        """Which points (N, 3) are hidden from `eye` (3,) by an inner panel: (N,)."""
        hidden = np.zeros(len(points), bool)
        if len(self._inner_normals) == 0:
            return hidden
        rays = points - eye
        height = np.sum(self._inner_normals * (self._inner_corners - eye), axis=1)
        slope = rays @ self._inner_normals.T
        slope = np.where(np.abs(slope) < 1e-12, 1e-12, slope)
        part = height / slope  # (N, K): fraction of the ray at which it meets the plane of a panel
        for k, panel in enumerate(p for p in self.panels if p.inner):
            crossed = np.flatnonzero((part[:, k] > 1e-9) & (part[:, k] < 1.0 - 1e-6))
            place = eye + part[crossed, k, None] * rays[crossed] - panel.corner
            a, b = place @ panel.across, place @ panel.along
            hidden[crossed] |= (a >= 0) & (a <= panel.size[0]) & (b >= 0) & (b <= panel.size[1])
        return hidden

    @cached_property
    def _inner_normals(self) -> FloatArray:
        return np.array([p.normal for p in self.panels if p.inner]).reshape(-1, 3)

    @cached_property
    def _inner_corners(self) -> FloatArray:
        return np.array([p.corner for p in self.panels if p.inner]).reshape(-1, 3)


def box(low: FloatArray, high: FloatArray) -> tuple[Panel, ...]:
    """The six inner sides of a box from `low` (3,) to `high` (3,)."""
    size, eye = high - low, np.eye(3)
    panels = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3  # across x along is the positive axis
        panels.append(Panel(low, eye[a], eye[b], (float(size[a]), float(size[b]))))
        far = low + size * eye[axis]
        panels.append(Panel(far, eye[b], eye[a], (float(size[b]), float(size[a]))))
    return tuple(panels)


def outer_box(low: FloatArray, high: FloatArray) -> tuple[Panel, ...]:
    """The six outer sides of a box from `low` (3,) to `high` (3,), which hide what is behind."""
    return tuple(
        Panel(panel.corner, panel.along, panel.across, panel.size[::-1], inner=True)
        for panel in box(low, high)
    )


def room_around(positions: FloatArray, margin_m: float, reach_m: float = 0.0) -> World:
    """An empty room around a trajectory (N, 3).

    Args:
        positions: of the trajectory.
        margin_m: distance of the walls from it.
        reach_m: how far from it there is something, which walls, floor and ceiling leave room for.
    """
    margin = np.maximum([margin_m, margin_m, _HEADROOM_M], reach_m)
    return World(box(positions.min(axis=0) - margin, positions.max(axis=0) + margin))


def three_rooms() -> World:
    """Three rooms in a row along x with doors between them, for the trajectory `rooms`."""
    half = ROOM_WIDTH_M / 2
    low = np.array([-ROOM_PITCH_M / 2, -half, 0.0])
    high = np.array([2.5 * ROOM_PITCH_M, half, ROOM_HEIGHT_M])
    walls = [*_wall_with_door(0.5 * ROOM_PITCH_M), *_wall_with_door(1.5 * ROOM_PITCH_M)]
    return World((*box(low, high), *walls))


def _wall_with_door(x: float) -> list[Panel]:
    """A thin wall across x, visible from both sides: left and right of the door, and above it."""
    half, door = ROOM_WIDTH_M / 2, DOOR_WIDTH_M / 2
    parts = [
        (-half, -door, 0.0, ROOM_HEIGHT_M),
        (door, half, 0.0, ROOM_HEIGHT_M),
        (-door, door, DOOR_HEIGHT_M, ROOM_HEIGHT_M),
    ]
    y, z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    panels = []
    for left, right, bottom, top in parts:
        corner, width, height = np.array([x, left, bottom]), right - left, top - bottom
        panels.append(Panel(corner, y, z, (width, height), inner=True))
        panels.append(Panel(corner, z, y, (height, width), inner=True))
    return panels
