# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Visibility: which points a camera of the rig sees, and at which pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.sensors import Camera, Rig, RigCamera
from slam_graph.simulation.world import World

_OVERLAP_DEPTH_M = 4.0
"""Depth at which the overlap of two cameras is determined."""

MIN_DEPTH_M = 0.3
MAX_DEPTH_M = 40.0
"""Depths between which a point is visible: the range of an indoor front end."""

BORDER_PX = 8.0
"""Nothing is seen closer to the border of the image: a patch of a tracker would not fit."""


@dataclass(frozen=True, eq=False)
class View:
    """A mounted camera and its visible region.

    Attributes:
        camera: intrinsics.
        mounted: the camera with its shutter.
        body_R_camera: (3, 3).
        position: (3,) of the camera in the body.
        reach: largest norm of a normalised point in the image; beyond it the distortion polynomial
            may fold points back into the image.
        max_depth_m: points farther away are not seen.
    """

    camera: Camera
    mounted: RigCamera
    body_R_camera: FloatArray
    position: FloatArray
    reach: float
    max_depth_m: float = MAX_DEPTH_M

    @staticmethod
    def of(mounted: RigCamera, max_depth_m: float = MAX_DEPTH_M) -> View:
        """The view of a camera of a rig."""
        camera, pose = mounted.camera, mounted.body_T_camera
        plane, valid = camera.visible(_border(camera))
        reach = float(np.max(np.linalg.norm(plane[valid], axis=1), initial=0.0))
        reach = reach if valid.all() else camera.max_tangent
        R, p = pose.rotation().matrix(), np.asarray(pose.translation())
        return View(camera, mounted, R, p, 1.001 * reach, max_depth_m)

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
        """Project the visible ones of some points.

        Args:
            world_R_body: (3, 3).
            position: (3,) of the body in the world.
            points: (N, 3) in the world.
            normals: (N, 3) of the surfaces that they are on; zero for points visible from anywhere.
            world: its inner walls hide points.

        Returns:
            indices (K,) of the visible points, and their pixels (K, 2) without noise.
        """
        R, eye = self.pose(world_R_body, position)
        from_eye = points - eye
        depth = from_eye @ R[:, 2]
        near = np.flatnonzero((depth > MIN_DEPTH_M) & (depth < self.max_depth_m))
        plane = (from_eye[near] @ R[:, :2]) / depth[near, None]
        inside = np.einsum("ij,ij->i", plane, plane) < self.reach**2
        near, plane = near[inside], plane[inside]
        facing = np.einsum("ij,ij->i", from_eye[near], normals[near]) <= 0.0
        near, plane = near[facing], plane[facing]
        pixels = self.camera.pixels(plane)
        inside = self._within_borders(pixels)
        near, pixels = near[inside], pixels[inside]
        clear = ~world.hidden(eye, points[near])
        return near[clear], pixels[clear]

    def project(
        self, world_R_body: FloatArray, positions: FloatArray, points: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Project points, each from its own pose; nothing hides them.

        Args:
            world_R_body: (N, 3, 3).
            positions: (N, 3) of the body in the world.
            points: (N, 3) in the world.

        Returns:
            Pixels (N, 2), and which of them (N,) are in the image.
        """
        R = world_R_body @ self.body_R_camera
        local = np.einsum("nji,nj->ni", R, points - positions - world_R_body @ self.position)
        plane = local[:, :2] / np.maximum(local[:, 2:], MIN_DEPTH_M)
        pixels = self.camera.pixels(plane)
        near = np.einsum("ij,ij->i", plane, plane) < self.reach**2
        return pixels, near & (local[:, 2] > MIN_DEPTH_M) & self._within_borders(pixels)

    def _within_borders(self, pixels: FloatArray) -> BoolArray:
        """Which pixels (N, 2) are far enough from the border."""
        (u, v), low = pixels.T, BORDER_PX
        within = (u >= low) & (u <= self.camera.width - 1 - low)
        return np.asarray(within & (v >= low) & (v <= self.camera.height - 1 - low))


def _border(camera: Camera) -> FloatArray:
    """Pixels (N, 2) around the border of the image."""
    u, v = np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 33)
    rows = [np.column_stack([u, np.full(33, y)]) for y in (v[0], v[-1])]
    columns = [np.column_stack([np.full(33, x), v]) for x in (u[0], u[-1])]
    return np.concatenate(rows + columns)


def camera_groups(rig: Rig, views: list[View]) -> list[list[int]]:
    """Groups of cameras with overlapping views (a stereo pair); the first of a group leads it.

    A camera joins the first group of whose leader's image it sees more than half.
    """
    everywhere = World(())
    groups: list[list[int]] = []
    for index, view in enumerate(views):
        for group in groups:
            leader = views[group[0]]
            points = _points_in_view(leader)
            none = np.zeros_like(points)
            seen, _ = view.see(np.eye(3), np.zeros(3), points, none, everywhere)
            if len(seen) > 0.5 * len(points):
                group.append(index)
                break
        else:
            groups.append([index])
    return groups


def _points_in_view(view: View) -> FloatArray:
    """Points (N, 3) in the body frame that fill the image of a camera at `_OVERLAP_DEPTH_M`."""
    camera = view.camera
    u, v = np.meshgrid(
        np.linspace(20, camera.width - 21, 9), np.linspace(20, camera.height - 21, 7)
    )
    plane, usable = camera.visible(np.column_stack([u.ravel(), v.ravel()]))
    rays = plane[usable]
    depth = min(_OVERLAP_DEPTH_M, 0.9 * MAX_DEPTH_M)
    in_camera = np.column_stack([rays, np.ones(len(rays))]) * depth
    return in_camera @ view.body_R_camera.T + view.position
