# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Made-up pose graphs, seeded: a walk on a grid in 2D, and a drive with few loops in 3D."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.pose_graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_initialization import along_tree

NEAR_M = 1.0
"""Poses so near to each other see the same place."""
APART = 50
"""A loop closure joins poses that are at least so many steps apart."""


def grid_walk(poses: int, loops: int, seed: int = 0) -> PoseGraph:
    """A robot that turns at random at the corners of a grid, in 2D, like M3500 and its larger kin.

    Args:
        poses: one every metre.
        loops: number of loop closures between poses at the same place, if there are so many.
        seed: of everything random.
    """
    rng = np.random.default_rng(seed)
    half = round(np.sqrt(poses) / 3.0)
    place = np.zeros(2)
    heading = np.int64(0)
    translations, headings = np.zeros((poses, 2)), np.zeros(poses, int)
    steps = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    for k in range(1, poses):
        if k % 3 == 0:
            heading = (heading + rng.integers(-1, 2)) % 4
        while np.abs(place + steps[heading]).max() > half:
            heading = (heading + 1) % 4
        place = place + steps[heading]
        translations[k], headings[k] = place, heading
    angles = headings * (np.pi / 2.0)
    truth = Poses(_rotations_2d(angles), translations)
    ends = np.vstack([_odometry(poses), _loops(translations, loops, rng)])
    sigmas = np.array([0.02, 0.02, 0.01])
    noise = sigmas * rng.standard_normal((len(ends), 3))
    errors = Poses(_rotations_2d(noise[:, 2]), noise[:, :2])
    return _measured(truth, ends, errors, np.diag(sigmas**-2), f"grid_{poses}")


def drive(poses: int, loops: int, seed: int = 0) -> PoseGraph:
    """A car that drives a closed course of hills twice, in 3D, like a recording of KITTI.

    Args:
        poses: one about every metre.
        loops: number of loop closures between the two rounds.
        seed: of everything random.
    """
    rng = np.random.default_rng(seed)
    phase = 4.0 * np.pi * np.arange(poses) / poses
    radius = poses / (4.0 * np.pi)
    ring = radius * (1.0 + 0.2 * np.sin(3.0 * phase))
    height = 0.02 * radius * np.sin(2.0 * phase)
    path = np.stack([ring * np.cos(phase), ring * np.sin(phase), height], axis=1)
    ahead = np.gradient(path, axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    pitch = -np.arctan2(ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1]))
    truth = Poses(
        Rotation.from_euler("ZY", np.stack([yaw, pitch], axis=1)).as_matrix(),
        path + rng.normal(0.0, 0.1, path.shape),
    )
    ends = np.vstack([_odometry(poses), _loops(path, loops, rng)])
    sigmas = np.repeat([0.02, 0.001], 3)
    noise = sigmas * rng.standard_normal((len(ends), 6))
    errors = Poses(Rotation.from_rotvec(noise[:, 3:]).as_matrix(), noise[:, :3])
    return _measured(truth, ends, errors, np.diag(sigmas**-2), f"drive_{poses}")


def _odometry(poses: int) -> IntArray:
    """(N - 1, 2) edges between consecutive poses."""
    return np.stack([np.arange(poses - 1), np.arange(1, poses)], axis=1)


def _loops(positions: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """(L, 2) pairs of poses at the same place, chosen at random."""
    pairs = cKDTree(positions).query_pairs(NEAR_M, output_type="ndarray")
    pairs = np.sort(pairs[np.abs(np.diff(pairs, axis=1))[:, 0] >= APART], axis=1)
    pairs = pairs[np.lexsort(pairs.T)]
    chosen: IntArray = pairs[rng.permutation(len(pairs))[:count]]
    return chosen


def _measured(
    truth: Poses, ends: IntArray, errors: Poses, information: FloatArray, name: str
) -> PoseGraph:
    """The graph of measured relative poses; its estimates are those of odometry."""
    i, j = ends.T
    relative = truth.select(i).inverse().compose(truth.select(j)).compose(errors)
    whole = np.tile(information, (len(ends), 1, 1))
    graph = PoseGraph(np.arange(len(truth)), None, ends, relative, whole, name=name)
    return PoseGraph(graph.keys, along_tree(graph), ends, relative, whole, name=name)


def _rotations_2d(angles: FloatArray) -> FloatArray:
    """(N, 2, 2) rotations by some angles."""
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)
