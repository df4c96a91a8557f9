# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A textured board that moves in front of the cameras: a dynamic object in rendered images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.simulation.motion import Motion
from slam_graph.simulation.simulation_config import MovingObjectConfig, random_stream
from slam_graph.simulation.world import Panel

_SMOOTHING_NS = 1_000_000_000
"""The path of the board is that of the camera, averaged over this time before and after."""
_SMOOTHING_SAMPLES = 21


@dataclass(frozen=True, eq=False)
class MovingBoard:
    """A rectangle that faces the cameras and moves in the world.

    Its centre is `distance_m` ahead of the smoothed path of a camera, plus a sinusoidal motion to
    either side. Like a vehicle that drives ahead it stays in view, and it moves as far in the world
    as the cameras do.

    Attributes:
        config: size, distance and motion.
        motion: of the platform.
        body_R_camera: (3, 3) of the camera in whose view it stays.
        body_p_camera: (3,) of the same camera.
        began_ns: time of the first frame.
        phase_rad: of the sinusoid, at the first frame.
    """

    config: MovingObjectConfig
    motion: Motion
    body_R_camera: FloatArray
    body_p_camera: FloatArray
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
        R, p = body_T_camera[:3, :3], body_T_camera[:3, 3]
        return MovingBoard(config, motion, R, p, began_ns, phase_rad)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, m."""
        return self.config.width_m, self.config.height_m

    def at(self, stamp_ns: int) -> Panel:
        """The board at a time on the clock of the IMU."""
        eye, right, ahead = self._smooth_view(stamp_ns)
        up = np.cross(right, ahead)
        middle = eye + self.config.distance_m * ahead + self._sideways_m(stamp_ns) * right
        corner = middle - 0.5 * self.size[0] * right - 0.5 * self.size[1] * up
        return Panel(corner, right, up, self.size)

    def _smooth_view(self, stamp_ns: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean position of the camera around a time, and its mean right and viewing directions."""
        around = np.linspace(-_SMOOTHING_NS, _SMOOTHING_NS, _SMOOTHING_SAMPLES).astype(np.int64)
        stamps = np.clip(stamp_ns + around, self.motion.start_ns, self.motion.end_ns)
        world_R_body = self.motion.rotations(stamps).as_matrix()
        eye = (self.motion.positions(stamps) + world_R_body @ self.body_p_camera).mean(axis=0)
        axes = (world_R_body @ self.body_R_camera).mean(axis=0)
        ahead = axes[:, 2] / np.linalg.norm(axes[:, 2])
        right = axes[:, 0] - (axes[:, 0] @ ahead) * ahead
        return eye, right / np.linalg.norm(right), ahead

    def _sideways_m(self, stamp_ns: int) -> float:
        """Displacement to the right, m; until `since_s` it moves in from outside the view."""
        config, t_s = self.config, (stamp_ns - self.began_ns) * 1e-9
        turn = config.speed / config.sway_m * t_s + self.phase_rad
        coming = config.speed * max(config.since_s - t_s, 0.0)
        return config.sway_m * float(np.sin(turn)) + coming
