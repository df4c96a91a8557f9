# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rigid objects that move through the view of the cameras, with their true poses.

The middle of an object follows the smoothed path of the first camera, some metres ahead of it, and
sways; so it stays in view and moves as far in the world as the cameras do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.geometry import Trajectory
from slam_graph.simulation.landmarks import SmoothView
from slam_graph.simulation.simulation_config import SimulatedObjectsConfig, random_stream
from slam_graph.simulation.world import Panel, outer_box

_KINDS = ("straight", "turning", "tumbling", "stop_and_go")
_TURNING, _TUMBLING = 0.4, 0.6
"""Angular rates, rad/s."""
_GOING_S, _STANDING_S = 2.0, 1.5
"""Of `stop_and_go`: it moves so long, and stands so long."""
_PART_SWAY_M, _PART_RATE = 0.08, 3.0
"""Parts of `people` move so much against one another, and at this angular frequency."""
_SPACING = 1.1
"""Middle distance of several objects, in sizes: they pass before one another."""


@dataclass(frozen=True, eq=False)
class MovingBody:
    """An object.

    Attributes:
        number: from 1 on; it is the label of its mask, too.
        config: size, distance, speed.
        view: the smoothed view of the first camera.
        panels: its sides in its own frame, and the part that each is of.
        kind: of its motion.
        axis: (3,) about which it turns.
        phases: (3,) of its sway on the axes of the view, rad.
        began_ns: time of the first frame.
    """

    number: int
    config: SimulatedObjectsConfig
    view: SmoothView
    panels: tuple[tuple[Panel, int], ...]
    kind: str
    axis: FloatArray
    phases: FloatArray
    began_ns: int

    def pose(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """world_R_object (3, 3) and the position (3,) of its middle at a time."""
        config, own_ns = self.config, self._own_time(stamp_ns)
        eye, right, ahead = self.view.at(own_ns)
        up = np.cross(right, ahead)
        t_s = (own_ns - self.began_ns) * 1e-9
        turn = config.speed / config.sway_m * t_s * np.array([1.0, 0.7, 0.5]) + self.phases
        sway = config.sway_m * np.sin(turn) * np.array([1.0, 0.3, 0.3])
        sway[0] += config.speed * max(config.since_s - t_s, 0.0)
        sway[0] += (self.number - 0.5 * (config.count + 1)) * _SPACING * config.size_m
        depth = config.distance_m + 0.5 * (self.number - 1) * config.size_m + sway[2]
        middle = eye + depth * ahead + sway[0] * right + sway[1] * up
        rate = {"turning": _TURNING, "tumbling": _TUMBLING}.get(self.kind, 0.0)
        return Rotation.from_rotvec(self.axis * rate * t_s).as_matrix(), middle

    def _own_time(self, stamp_ns: int) -> int:
        """Time at which it would be where it is, if it never stood."""
        if self.kind != "stop_and_go":
            return stamp_ns
        period = _GOING_S + _STANDING_S
        whole, rest = divmod((stamp_ns - self.began_ns) * 1e-9, period)
        gone = period * _smooth_step(min(rest / _GOING_S, 1.0))
        return self.began_ns + round((whole * period + gone) * 1e9)

    def standing(self, stamp_ns: int) -> bool:
        """Whether it stands still."""
        rest = ((stamp_ns - self.began_ns) * 1e-9) % (_GOING_S + _STANDING_S)
        return self.kind == "stop_and_go" and rest >= _GOING_S

    def at(self, stamp_ns: int) -> tuple[Panel, ...]:
        """Its sides in the world."""
        R, p = self.pose(stamp_ns)
        t_s = (stamp_ns - self.began_ns) * 1e-9
        return tuple(
            replace(
                panel,
                corner=p + R @ (panel.corner + self._shift(part, t_s)),
                across=R @ panel.across,
                along=R @ panel.along,
            )
            for panel, part in self.panels
        )

    def _shift(self, part: int, t_s: float) -> FloatArray:
        """(3,) motion of a part against the whole: parts are those of a walking person."""
        if self.config.shape != "people":
            return np.zeros(3)
        turn = _PART_RATE * t_s + 2.0 * part
        return _PART_SWAY_M * np.array([np.sin(turn), np.cos(1.3 * turn), 0.0])

    def points(self, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
        """Places (N, 2) on its sides, in lengths of them, and the sides (N,), by area."""
        areas = np.array([panel.area for panel, _ in self.panels])
        sides = rng.choice(len(areas), self.config.points, p=areas / areas.sum())
        return rng.uniform(0.02, 0.98, (self.config.points, 2)), sides

    def trajectory(self, stamps_ns: IntArray) -> Trajectory:
        """Its true poses."""
        poses = [self.pose(stamp_ns) for stamp_ns in stamps_ns.tolist()]
        R = np.array([pose[0] for pose in poses]).reshape(-1, 3, 3)
        positions = np.array([pose[1] for pose in poses]).reshape(-1, 3)
        return Trajectory(stamps_ns, positions, Rotation.from_matrix(R).as_quat())


def _smooth_step(part: float) -> float:
    """From 0 to 1 without speed at either end."""
    return part * part * (3.0 - 2.0 * part)


def moving_bodies(
    config: SimulatedObjectsConfig, view: SmoothView, began_ns: int, seed: int
) -> tuple[MovingBody, ...]:
    """The objects of a simulation.

    Args:
        config: how many, and of what kind.
        view: the smoothed view of the first camera.
        began_ns: time of the first frame.
        seed: of the simulation.
    """
    bodies = []
    for number in range(1, config.count + 1):
        rng = np.random.default_rng(random_stream(seed, "bodies", number))
        kind: str = config.motion
        if kind == "mixed":
            kind = _KINDS[(number - 1) % len(_KINDS)]
        axis = np.array([0.0, 0.0, 1.0])
        if kind == "tumbling":
            axis = rng.normal(size=3)
            axis /= np.linalg.norm(axis)
        phases = rng.uniform(0.0, 2.0 * np.pi, 3)
        panels = _shape(config.shape, config.size_m)
        bodies.append(MovingBody(number, config, view, panels, kind, axis, phases, began_ns))
    return tuple(bodies)


def _shape(kind: str, size_m: float) -> tuple[tuple[Panel, int], ...]:
    """The sides of an object in its own frame, and the part that each is of."""
    boxes = {
        "box": [((0.0, 0.0, 0.0), (1.0, 0.8, 0.6))],
        "l_shape": [((0.0, 0.0, -0.2), (1.0, 0.8, 0.3)), ((0.3, 0.0, 0.15), (0.4, 0.8, 0.4))],
        "people": [
            ((0.0, 0.0, 0.35), (0.35, 0.3, 0.3)),
            ((0.0, 0.0, 0.0), (0.5, 0.4, 0.4)),
            ((0.0, 0.0, -0.35), (0.4, 0.35, 0.3)),
        ],
    }
    sides = []
    for part, (middle, lengths) in enumerate(boxes[kind]):
        half = 0.5 * size_m * np.array(lengths)
        low, high = size_m * np.array(middle) - half, size_m * np.array(middle) + half
        sides += [(panel, part) for panel in outer_box(low, high)]
    return tuple(sides)


class LandmarksOnBodies:
    """Landmarks on the sides of moving objects.

    Args:
        bodies: the objects.
        seed: of the places on them.

    Attributes:
        number: (N,) of the object that each is on.
    """

    def __init__(self, bodies: tuple[MovingBody, ...], seed: int) -> None:
        rng = np.random.default_rng(random_stream(seed, "points on bodies"))
        placed = [body.points(rng) for body in bodies]
        self._bodies, self._last = bodies, (-1, (np.zeros((0, 3)), np.zeros((0, 3))))
        self._places = np.concatenate([places for places, _ in placed])
        counts = [len(body.panels) for body in bodies]
        first = np.cumsum([0, *counts[:-1]])
        sides = [start + sides for start, (_, sides) in zip(first, placed, strict=True)]
        self._sides = np.concatenate(sides)
        self.number = np.repeat([b.number for b in bodies], [len(s) for s in sides])

    def __len__(self) -> int:
        return len(self.number)

    def at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Their positions and normals (N, 3) at a time."""
        if self._last[0] != stamp_ns:
            panels = self.panels(stamp_ns)
            corner, across, along = (
                np.array([getattr(panel, name) for panel in panels])[self._sides]
                for name in ("corner", "across", "along")
            )
            place = self._places * np.array([panel.size for panel in panels])[self._sides]
            points = corner + place[:, :1] * across + place[:, 1:] * along
            self._last = stamp_ns, (points, np.cross(across, along))
        return self._last[1]

    def panels(self, stamp_ns: int) -> tuple[Panel, ...]:
        """The sides of all objects at a time."""
        return tuple(panel for body in self._bodies for panel in body.at(stamp_ns))
