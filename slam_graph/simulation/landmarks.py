# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What is seen: landmarks on walls, at random depths or on a moving box; a moving board."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.simulation.motion import Motion
from slam_graph.simulation.simulation_config import MovingObjectConfig, random_stream
from slam_graph.simulation.views import View
from slam_graph.simulation.world import Panel, World

_CHECK_PERIOD_S = 0.5
"""Time between two checks whether the cameras see enough landmarks ahead."""

AHEAD_DEPTH_M = (2.0, 8.0)
"""Smallest and largest depth of landmarks ahead: those of a large room."""

_BOX_M = 0.8
"""Edge of the moving box."""


@dataclass(frozen=True, eq=False)
class _MovingBox:
    """A box that oscillates through the room, with points on its sides.

    Attributes:
        points: (M, 3) in the frame of the box.
        middle: (3,) centre of its motion.
        swing: (3,) amplitude on each axis, m.
        rates: (3,) angular frequency on each axis, rad/s.
        start_ns: time at which it is at the centre.
    """

    points: FloatArray
    middle: FloatArray
    swing: FloatArray
    rates: FloatArray
    start_ns: int

    def at(self, stamp_ns: int) -> FloatArray:
        """The points (M, 3) in the world at a time."""
        phases = self.rates * ((stamp_ns - self.start_ns) * 1e-9)
        offset: FloatArray = self.swing * np.sin(phases)
        return self.points + self.middle + offset


class BodyLandmarks(Protocol):
    """Landmarks on moving objects.

    Attributes:
        number: (N,) of the object that each is on.
    """

    number: IntArray

    def __len__(self) -> int:
        """How many there are."""
        ...

    def at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Their positions and normals (N, 3) at a time."""
        ...

    def panels(self, stamp_ns: int) -> tuple[Panel, ...]:
        """The sides of all objects at a time."""
        ...


@dataclass(frozen=True, eq=False)
class Landmarks:
    """All landmarks of a world.

    Attributes:
        points: (P, 3) static landmarks, in random order.
        normals: (P, 3) of the walls that they are on, zero where there is none.
        box: dynamic landmarks, numbered from P on; or None.
        reach_m: how far from a place static landmarks are looked for; None for everywhere.
        bodies: landmarks on moving objects, numbered after those; see `moving_bodies.py`.
    """

    points: FloatArray
    normals: FloatArray
    box: _MovingBox | None = None
    reach_m: float | None = None
    bodies: BodyLandmarks | None = None

    def __len__(self) -> int:
        return self.static + (0 if self.bodies is None else len(self.bodies))

    @property
    def static(self) -> int:
        """Number of the landmarks that are not on objects."""
        return len(self.points) + (0 if self.box is None else len(self.box.points))

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points[:, :2])

    def around(self, place: FloatArray) -> IntArray:
        """Numbers (N,) of the static landmarks within reach of a place (3,), in random order."""
        if self.reach_m is None:
            return np.arange(self.static)
        near = self._tree.query_ball_point(place[:2], self.reach_m, return_sorted=True)
        return np.array(near, np.int64)

    def labels(self, index: IntArray) -> IntArray:
        """Number (N,) of the object that landmarks are on; 0 for none."""
        found = np.zeros(len(index), np.int64)
        if self.bodies is not None:
            rows = index >= self.static
            found[rows] = self.bodies.number[index[rows] - self.static]
        return found

    def world_at(self, world: World, stamp_ns: int) -> World:
        """The walls with the sides of the objects at a time."""
        if self.bodies is None:
            return world
        return World((*world.panels, *self.bodies.panels(stamp_ns)))

    def at(self, index: IntArray, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Positions and normals (N, 3) of landmarks by their numbers (N,)."""
        if self.bodies is not None and np.any(index >= self.static):
            return self._with_bodies(self.bodies, index, stamp_ns)
        if self.box is None:
            return self.points[index], self.normals[index]
        count, moving = len(self.points), index >= len(self.points)
        static = np.where(moving, 0, index)
        points, normals = self.points[static], self.normals[static]
        points[moving] = self.box.at(stamp_ns)[index[moving] - count]
        normals[moving] = 0.0
        return points, normals

    def _with_bodies(
        self, bodies: BodyLandmarks, index: IntArray, stamp_ns: int
    ) -> tuple[FloatArray, FloatArray]:
        on_body = index >= self.static
        points, normals = self.at(np.where(on_body, 0, index), stamp_ns)
        rows = index[on_body] - self.static
        places, sides = bodies.at(stamp_ns)
        points[on_body], normals[on_body] = places[rows], sides[rows]
        return points, normals


def on_walls(world: World, density: float, rng: np.random.Generator) -> Landmarks:
    """Landmarks uniformly distributed over all panels, `density` per square metre."""
    points, normals = [], []
    for panel in world.panels:
        place = rng.uniform(0.0, 1.0, (round(density * panel.area), 2)) * panel.size
        points.append(panel.corner + place[:, :1] * panel.across + place[:, 1:] * panel.along)
        normals.append(np.tile(panel.normal, (len(place), 1)))
    order = rng.permutation(sum(len(p) for p in points))
    return Landmarks(np.concatenate(points)[order], np.concatenate(normals)[order])


def ahead(
    motion: Motion,
    leaders: list[View],
    features: int,
    rng: np.random.Generator,
) -> Landmarks:
    """Landmarks at random pixels and depths, added along a motion wherever too few are visible.

    Args:
        motion: of the platform.
        leaders: the cameras that must see enough.
        features: how many each must see.
        rng: random pixels and depths.
    """
    stamps = np.arange(motion.start_ns, motion.end_ns, round(_CHECK_PERIOD_S * 1e9), dtype=np.int64)
    rotations, positions = motion.rotations(stamps).as_matrix(), motion.positions(stamps)
    points, empty = np.zeros((0, 3)), World(())
    for R, p in zip(rotations, positions, strict=True):
        for view in leaders:
            seen, _ = view.see(R, p, points, np.zeros_like(points), empty)
            if len(seen) < features:
                points = np.concatenate([points, _scatter(view, R, p, features, rng)])
    points = points[rng.permutation(len(points))]
    return Landmarks(points, np.zeros_like(points))


def _scatter(
    view: View,
    world_R_body: FloatArray,
    position: FloatArray,
    count: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Points (at most count, 3) visible to a camera."""
    size = np.array([view.camera.width - 1, view.camera.height - 1])
    plane, usable = view.camera.visible(rng.uniform(0.0, 1.0, (count, 2)) * size)
    rays, count = plane[usable], int(np.sum(usable))
    depth = rng.uniform(*AHEAD_DEPTH_M, (count, 1))
    R, eye = view.pose(world_R_body, position)
    return eye + (np.column_stack([rays, np.ones(count)]) * depth) @ R.T


def moving_box(
    positions: FloatArray, start_ns: int, count: int, rng: np.random.Generator
) -> _MovingBox:
    """A box that moves through the space the platform flies in, with points on its sides.

    Args:
        positions: (N, 3) of the platform.
        start_ns: start of the motion of the platform.
        count: number of points.
        rng: random points and frequencies.
    """
    points: NDArray[np.float64] = rng.uniform(-0.5, 0.5, (count, 3)) * _BOX_M
    side = rng.integers(0, 3, count)
    points[np.arange(count), side] = 0.5 * _BOX_M * rng.choice([-1.0, 1.0], count)
    low, high = positions.min(axis=0), positions.max(axis=0)
    swing = np.maximum(0.5 * (high - low), 0.5)
    return _MovingBox(points, 0.5 * (low + high), swing, rng.uniform(0.2, 0.5, 3), start_ns)


_SMOOTHING_NS = 1_000_000_000
"""The path of the board is that of the camera, averaged over this time before and after."""
_SMOOTHING_SAMPLES = 21


@dataclass(frozen=True, eq=False)
class SmoothView:
    """Where a camera is and looks, averaged over some time.

    Attributes:
        motion: of the platform.
        body_R_camera: (3, 3) of the camera.
        body_p_camera: (3,) of the same camera.
    """

    motion: Motion
    body_R_camera: FloatArray
    body_p_camera: FloatArray

    def at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean position of the camera around a time, and its mean right and viewing directions."""
        around = np.linspace(-_SMOOTHING_NS, _SMOOTHING_NS, _SMOOTHING_SAMPLES).astype(np.int64)
        stamps = np.clip(stamp_ns + around, self.motion.start_ns, self.motion.end_ns)
        world_R_body = self.motion.rotations(stamps).as_matrix()
        eye = (self.motion.positions(stamps) + world_R_body @ self.body_p_camera).mean(axis=0)
        axes = (world_R_body @ self.body_R_camera).mean(axis=0)
        ahead = axes[:, 2] / np.linalg.norm(axes[:, 2])
        right = axes[:, 0] - (axes[:, 0] @ ahead) * ahead
        return eye, right / np.linalg.norm(right), ahead


@dataclass(frozen=True, eq=False)
class MovingBoard:
    """A rectangle that faces the cameras and moves in the world.

    Its centre is `distance_m` ahead of the smoothed path of a camera, plus a sinusoidal motion to
    either side. Like a vehicle that drives ahead it stays in view, and it moves as far in the world
    as the cameras do.

    Attributes:
        config: size, distance and motion.
        view: of the camera in front of which it stays.
        began_ns: time of the first frame.
        phase_rad: of the sinusoid, at the first frame.
    """

    config: MovingObjectConfig
    view: SmoothView
    began_ns: int
    phase_rad: float

    @staticmethod
    def ahead_of(
        config: MovingObjectConfig,
        motion: Motion,
        body_T_camera: FloatArray,
        began_ns: int,
        seed: int,
    ) -> MovingBoard:
        """A board in front of the camera mounted at `body_T_camera` (4, 4)."""
        rng = np.random.default_rng(random_stream(seed, "object"))
        phase_rad = float(rng.uniform(0.0, 2.0 * np.pi))
        view = SmoothView(motion, body_T_camera[:3, :3], body_T_camera[:3, 3])
        return MovingBoard(config, view, began_ns, phase_rad)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, m."""
        return self.config.width_m, self.config.height_m

    def at(self, stamp_ns: int) -> Panel:
        """The board at a time on the clock of the IMU."""
        eye, right, ahead = self.view.at(stamp_ns)
        up = np.cross(right, ahead)
        middle = eye + self.config.distance_m * ahead + self._sideways_m(stamp_ns) * right
        corner = middle - 0.5 * self.size[0] * right - 0.5 * self.size[1] * up
        return Panel(corner, right, up, self.size)

    def _sideways_m(self, stamp_ns: int) -> float:
        """Displacement to the right, m; until `since_s` it moves in from outside the view."""
        config, t_s = self.config, (stamp_ns - self.began_ns) * 1e-9
        turn = config.speed / config.sway_m * t_s + self.phase_rad
        coming = config.speed * max(config.since_s - t_s, 0.0)
        return config.sway_m * float(np.sin(turn)) + coming
