# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The points that cameras see: on the walls, at random depths ahead, or on a box that moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.simulation.motion import Motion
from slam_graph.simulation.simulation_config import LandmarkConfig
from slam_graph.simulation.views import View
from slam_graph.simulation.world import World

LOOK_PERIOD_S = 0.5
"""How often it is looked whether there are enough points ahead."""

BOX_M = 0.8
"""Edge of the box that moves."""


@dataclass(frozen=True, eq=False)
class MovingBox:
    """A box that flies to and fro, with points on its sides.

    Attributes:
        points: (M, 3) in the frame of the box.
        middle: (3,) around which it flies.
        swing: (3,) how far it flies on each axis, m.
        rates: (3,) rad/s of the sinusoids of each axis.
        start_ns: when it is in the middle.
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


@dataclass(frozen=True, eq=False)
class Landmarks:
    """All points of a world.

    Attributes:
        points: (P, 3) that stand still, in random order.
        normals: (P, 3) of the walls that they are on, zero where there is none.
        box: points that move; they are numbered from P on. Or None.
    """

    points: FloatArray
    normals: FloatArray
    box: MovingBox | None = None

    def __len__(self) -> int:
        return len(self.points) + (0 if self.box is None else len(self.box.points))

    def at(self, index: IntArray, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Positions and normals (N, 3) of points by their numbers (N,)."""
        if self.box is None:
            return self.points[index], self.normals[index]
        count, moving = len(self.points), index >= len(self.points)
        still = np.where(moving, 0, index)
        points, normals = self.points[still], self.normals[still]
        points[moving] = self.box.at(stamp_ns)[index[moving] - count]
        normals[moving] = 0.0
        return points, normals


def on_walls(world: World, density: float, rng: np.random.Generator) -> Landmarks:
    """Points spread evenly over all panels, so many on a square metre."""
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
    config: LandmarkConfig,
    rng: np.random.Generator,
) -> Landmarks:
    """Points at random pixels and depths, added along a motion wherever too few are in sight.

    Args:
        motion: of the platform.
        leaders: the cameras that must see enough.
        features: how many each must see.
        config: range of depths.
        rng: draws pixels and depths.
    """
    stamps = np.arange(motion.start_ns, motion.end_ns, round(LOOK_PERIOD_S * 1e9), dtype=np.int64)
    rotations, positions = motion.rotations(stamps).as_matrix(), motion.positions(stamps)
    points, empty = np.zeros((0, 3)), World(())
    for R, p in zip(rotations, positions, strict=True):
        for view in leaders:
            seen, _ = view.see(R, p, points, np.zeros_like(points), empty)
            if len(seen) < features:
                points = np.concatenate([points, _scatter(view, R, p, features, config, rng)])
    points = points[rng.permutation(len(points))]
    return Landmarks(points, np.zeros_like(points))


def _scatter(
    view: View,
    world_R_body: FloatArray,
    position: FloatArray,
    count: int,
    config: LandmarkConfig,
    rng: np.random.Generator,
) -> FloatArray:
    """Points (at most count, 3) in sight of a camera."""
    size = np.array([view.camera.width - 1, view.camera.height - 1])
    plane, usable = view.camera.visible(rng.uniform(0.0, 1.0, (count, 2)) * size)
    rays, count = plane[usable], int(np.sum(usable))
    depth = rng.uniform(*config.ahead_depth_m, (count, 1))
    R, eye = view.pose(world_R_body, position)
    return eye + (np.column_stack([rays, np.ones(count)]) * depth) @ R.T


def moving_box(
    positions: FloatArray, start_ns: int, count: int, rng: np.random.Generator
) -> MovingBox:
    """A box that flies around where the platform does, with points on its sides.

    Args:
        positions: (N, 3) of the platform.
        start_ns: when the motion of the platform begins.
        count: number of points.
        rng: draws points and rates.
    """
    points: NDArray[np.float64] = rng.uniform(-0.5, 0.5, (count, 3)) * BOX_M
    side = rng.integers(0, 3, count)
    points[np.arange(count), side] = 0.5 * BOX_M * rng.choice([-1.0, 1.0], count)
    low, high = positions.min(axis=0), positions.max(axis=0)
    swing = np.maximum(0.5 * (high - low), 0.5)
    return MovingBox(points, 0.5 * (low + high), swing, rng.uniform(0.2, 0.5, 3), start_ns)
