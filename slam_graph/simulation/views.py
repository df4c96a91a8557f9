# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a camera sees of points: projection, and what is out of sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.rig import Rig, RigCamera
from slam_graph.simulation.simulation_config import TrackConfig
from slam_graph.simulation.world import World

OVERLAP_DEPTH_M = 4.0
"""At this depth it is looked whether two cameras see the same."""


@dataclass(frozen=True, eq=False)
class View:
    """A camera where it is mounted, and what it can see.

    Attributes:
        camera: intrinsics.
        body_R_camera: (3, 3).
        position: (3,) of the camera in the body.
        reach: largest length of a normalised point in the image; beyond it the polynomial of the
            distortion may fold points back into the image.
        config: depth and border limits.
    """

    camera: Camera
    body_R_camera: FloatArray
    position: FloatArray
    reach: float
    config: TrackConfig

    @staticmethod
    def of(mounted: RigCamera, config: TrackConfig) -> View:
        """The view of a camera of a rig."""
        camera, pose = mounted.camera, mounted.body_T_camera
        plane, valid = camera.visible(_border(camera))
        reach = float(np.max(np.linalg.norm(plane[valid], axis=1), initial=0.0))
        reach = reach if valid.all() else camera.max_tangent
        R, p = pose.rotation().matrix(), np.asarray(pose.translation())
        return View(camera, R, p, 1.001 * reach, config)

    def pose(self, world_R_body: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """world_R_camera (3, 3) and position (3,) of the camera, for a pose of the body."""
        return world_R_body @ self.body_R_camera, position + world_R_body @ self.position

    def see(
        self,
        world_R_body: FloatArray,
        position: FloatArray,
        points: FloatArray,
        normals: FloatArray,
        world: World,
    ) -> tuple[IntArray, FloatArray]:
        """Project points.

        Args:
            world_R_body: (3, 3).
            position: (3,) of the body in the world.
            points: (N, 3) in the world.
            normals: (N, 3) of the surfaces that they are on; zero for points seen from anywhere.
            world: hides points.

        Returns:
            indices (K,) of the points in sight, and their pixels (K, 2) without noise.
        """
        R, eye = self.pose(world_R_body, position)
        from_eye = points - eye
        depth = from_eye @ R[:, 2]
        near = np.flatnonzero((depth > self.config.min_depth_m) & (depth < self.config.max_depth_m))
        plane = (from_eye[near] @ R[:, :2]) / depth[near, None]
        inside = np.einsum("ij,ij->i", plane, plane) < self.reach**2
        near, plane = near[inside], plane[inside]
        facing = np.einsum("ij,ij->i", from_eye[near], normals[near]) <= 0.0
        near, plane = near[facing], plane[facing]
        pixels = self.camera.distort(plane)[0]
        low = self.config.border_px
        high = np.array([self.camera.width - 1 - low, self.camera.height - 1 - low])
        inside = np.all((pixels >= low) & (pixels <= high), axis=1)
        near, pixels = near[inside], pixels[inside]
        clear = ~world.hidden(eye, points[near])
        return near[clear], pixels[clear]


def _border(camera: Camera) -> FloatArray:
    """Pixels (N, 2) around the border of the image."""
    u, v = np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 33)
    rows = [np.column_stack([u, np.full(33, y)]) for y in (v[0], v[-1])]
    columns = [np.column_stack([np.full(33, x), v]) for x in (u[0], u[-1])]
    return np.concatenate(rows + columns)


def camera_groups(rig: Rig, views: list[View]) -> list[list[int]]:
    """Cameras that look at the same: each group is led by its first camera.

    A camera joins the first group whose leader's image it sees more than half of.
    """
    everywhere = World(())
    groups: list[list[int]] = []
    for index, view in enumerate(views):
        for group in groups:
            leader = views[group[0]]
            points = _points_before(leader)
            none = np.zeros_like(points)
            seen, _ = view.see(np.eye(3), np.zeros(3), points, none, everywhere)
            if len(seen) > 0.5 * len(points):
                group.append(index)
                break
        else:
            groups.append([index])
    return groups


def _points_before(view: View) -> FloatArray:
    """Points (N, 3) in the body that fill the image of a camera at some depth."""
    camera = view.camera
    u, v = np.meshgrid(
        np.linspace(20, camera.width - 21, 9), np.linspace(20, camera.height - 21, 7)
    )
    plane, usable = camera.visible(np.column_stack([u.ravel(), v.ravel()]))
    rays = plane[usable]
    depth = min(OVERLAP_DEPTH_M, 0.9 * view.config.max_depth_m)
    in_camera = np.column_stack([rays, np.ones(len(rays))]) * depth
    return in_camera @ view.body_R_camera.T + view.position
