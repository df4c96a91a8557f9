# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Maps for tests: a small one that is made up, and those of simulated flights."""

import gtsam
import numpy as np

from slam_graph.loop_closure.loop_config import LoopClosureConfig, PlaceConfig
from slam_graph.loop_closure.loop_keyframes import Keyframe
from slam_graph.maps.map_building import build_map
from slam_graph.maps.map_model import MapRecording, SlamMap
from slam_graph.pose_graph.graph import Poses
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulation_config import LandmarkConfig, SimulationConfig, TrackConfig
from slam_graph.simulation.simulator import euroc_rig, simulate

CONFIG = LoopClosureConfig(places=PlaceConfig(words=50))
SPACING_M = 0.5


class World:
    """A wall of points with random descriptors, and views of it.

    Args:
        seed: of everything.
        points: how many there are.
    """

    def __init__(self, seed: int = 0, points: int = 120) -> None:
        rng = np.random.default_rng(seed)
        self.rig: Rig = euroc_rig()
        self.points = rng.uniform([4.0, -4.0, -2.0], [8.0, 8.0, 2.0], (points, 3))
        self.descriptors = rng.integers(0, 256, (points, 32), dtype=np.uint8)

    def pose(self, number: int) -> gtsam.Pose3:
        """world_T_body of a view: the camera looks along world x, and goes to the side."""
        mount = self.rig.cameras[0].body_T_camera.rotation()
        forward = gtsam.Rot3(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
        position = np.array([0.0, SPACING_M * number, 0.1 * number])
        return gtsam.Pose3(forward.compose(mount.inverse()), position)

    def view(self, number: int, world_T_body: gtsam.Pose3 | None = None) -> Keyframe:
        """What is seen there; its own idea of where it is may be another."""
        pose, mount = self.pose(number), self.rig.cameras[0].body_T_camera
        body = (self.points - pose.translation()) @ pose.rotation().matrix()
        local = (body - mount.translation()) @ mount.rotation().matrix()
        rays = local[:, :2] / local[:, 2:]
        seen = np.flatnonzero((local[:, 2] > 0.5) & (np.abs(rays) < [0.8, 0.5]).all(axis=1))
        return Keyframe(
            10**9 * (number + 1),
            world_T_body or pose,
            seen,
            rays[seen],
            self.descriptors[seen],
            body[seen],
        )

    def map(self, views: range = range(5)) -> SlamMap:
        """The map of some views."""
        keyframes = [self.view(number) for number in views]
        return build_map(
            keyframes,
            Poses.from_gtsam([k.world_T_body for k in keyframes]),
            MapRecording("wall", "causal", self.rig),
            [],
            CONFIG,
        )


def rooms(seed: int, duration_s: float, rate_hz: float = 5.0) -> SimulatedSequence:
    """A tour through three rooms, of which each lap takes 40 s."""
    return simulate(
        SimulationConfig(
            trajectory="rooms",
            duration_s=duration_s,
            rate_hz=rate_hz,
            seed=seed,
            landmarks=LandmarkConfig(density=4.0),
            tracks=TrackConfig(features=80, loss=0.02, outliers=0.01, descriptors=True),
        )
    )
