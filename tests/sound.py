# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What must hold of all that was read, from a damaged file too: finite values, times in order."""

from typing import Any

import numpy as np
from damage import CAMPAIGN

from slam_graph.bundle_adjustment.bal_problem import BalProblem
from slam_graph.geometry import Trajectory
from slam_graph.pose_graph import PoseGraph, Poses, optimize_pose_graph
from slam_graph.sensors import Camera, ImuNoise, Rig

LARGEST_NS = 2**62
"""Times beyond would make differences that do not fit."""


def sound_trajectory(path: Trajectory) -> None:
    """Times in order, finite values, and quaternions of unit length."""
    assert np.all(path.stamps_ns[1:] > path.stamps_ns[:-1])
    assert np.all(np.abs(path.stamps_ns[[0, -1]] // 2) <= LARGEST_NS // 2)
    with_states = (path.velocities, path.gyro_biases, path.accel_biases)
    for values in (path.positions, *(part for part in with_states if part is not None)):
        assert np.isfinite(values**2).all()
    np.testing.assert_allclose(np.linalg.norm(path.quaternions, axis=1), 1.0, atol=0.02)


def sound_rig(rig: Rig) -> None:
    """A rig that images can be of: its numbers have squares that are finite."""
    sound_noise(rig.imu)
    for mounted in rig.cameras:
        sound_camera(mounted.camera)
        assert np.isfinite(mounted.body_T_camera.matrix() ** 2).all()
        assert abs(mounted.time_offset_s) * 1e9 < LARGEST_NS
        assert np.isfinite(mounted.readout_s)
    if rig.depth is not None:
        sensor = rig.depth
        values = np.array([sensor.scale, sensor.min_m, sensor.max_m, *sensor.sigma_m(np.ones(2))])
        assert np.isfinite(values**2).all()
        assert np.isfinite(sensor.camera_T_depth.matrix() ** 2).all()
        if sensor.lens is not None:
            sound_camera(sensor.lens)


def sound_noise(noise: ImuNoise) -> None:
    """Variances and periods that are finite, and not zero."""
    values = np.array(list(vars(noise).values()))
    assert np.all(values > 0)
    assert np.all((values**2 > 0) & np.isfinite(values**2))


def sound_camera(camera: Camera) -> None:
    """An image of some size, and pixels that have rays, or none, without an overflow."""
    for size in (camera.width, camera.height):
        assert isinstance(size, int)
        assert 0 < size < 2**16
    assert camera.fx > 0
    assert camera.fy > 0
    corners = np.array([[0.0, 0.0], [camera.width, camera.height], [camera.cx, camera.cy]])
    rays = camera.undistort(corners)
    assert rays.shape == (3, 2)
    assert np.isfinite(camera.distort(np.array([[0.0, 0.0], [0.1, -0.1]]))[0]).all()


def sound_graph(graph: PoseGraph) -> None:
    """Finite poses and rotations, edges between poses, and information that is positive."""
    parts = [graph.measured, graph.anchor_poses()]
    for poses in parts if graph.estimates is None else [*parts, graph.estimates]:
        sound_poses(poses)
    assert np.all(np.diff(graph.keys) > 0)
    assert graph.edges.min() >= 0
    assert graph.edges.max() < len(graph.keys)
    assert np.isfinite(graph.information**2).all()
    assert np.all(np.linalg.eigvalsh(graph.information) > 0)
    if CAMPAIGN:
        sound_poses(optimize_pose_graph(graph).minimum.poses)


def sound_poses(poses: Poses) -> None:
    """Rotations, and translations whose squares are finite."""
    assert np.isfinite(poses.translations**2).all()
    gram = poses.rotations @ poses.rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(gram, np.tile(np.eye(poses.dimension), (len(gram), 1, 1)), atol=1e-6)


def sound_problem(problem: BalProblem) -> None:
    """Finite numbers, and observations of cameras and points that there are."""
    found = problem.estimates
    for values in (found.translations, found.intrinsics, found.points, problem.pixels):
        assert np.isfinite(values**2).all()
    sound_poses(Poses(found.rotations, found.translations))
    for rows, count in ((problem.camera, problem.cameras), (problem.point, problem.points)):
        assert rows.min() >= 0
        assert rows.max() < count


def sound_table(table: Any) -> None:
    """Tables and lists whose numbers are finite."""
    if isinstance(table, dict):
        table = list(table.values())
    if isinstance(table, list):
        for value in table:
            sound_table(value)
    elif isinstance(table, float):
        assert np.isfinite(table)
