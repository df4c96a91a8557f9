# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Small pose graphs with known truth, and false loop closures."""

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.pose_graph.graph import PoseGraph, Poses


def turns(vectors: np.ndarray) -> np.ndarray:
    """(N, d, d) rotations from (N, 1 or 3) tangents."""
    if vectors.shape[1] == 3:
        return Rotation.from_rotvec(vectors).as_matrix()
    cos, sin = np.cos(vectors[:, 0]), np.sin(vectors[:, 0])
    return np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)


def laps(
    dimension: int, noise: float = 0.0, poses: int = 60, lap: int = 20, seed: int = 0
) -> tuple[PoseGraph, Poses]:
    """A few laps with a loop closure from each pose to that one lap later, and the true poses.

    Args:
        dimension: 2 or 3.
        noise: standard deviation of every axis of an edge, in m and rad.
        poses: number of poses.
        lap: number of poses to a lap.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(poses) / lap
    vectors = np.zeros((poses, 1 if dimension == 2 else 3))
    vectors[:, -1] = angle
    places = [3.0 * np.cos(angle), 3.0 * np.sin(angle), 0.1 * np.arange(poses)]
    truth = Poses(turns(vectors), np.column_stack(places[:dimension]))
    steps = np.arange(poses - 1)
    back = np.arange(poses - lap)
    edges = np.concatenate(
        [np.column_stack([steps, steps + 1]), np.column_stack([back, back + lap])]
    )
    exact = truth.select(edges[:, 0]).inverse().compose(truth.select(edges[:, 1]))
    p = vectors.shape[1]
    error = noise * rng.standard_normal((len(edges), dimension + p))
    measured = exact.compose(Poses(turns(error[:, dimension:]), error[:, :dimension]))
    information = np.tile(np.eye(dimension + p) / max(noise, 0.01) ** 2, (len(edges), 1, 1))
    return PoseGraph(np.arange(poses), truth, edges, measured, information), truth


def with_false_loops(graph: PoseGraph, count: int, seed: int = 0) -> PoseGraph:
    """The graph with random loop closures behind its own edges."""
    rng = np.random.default_rng(seed)
    d = graph.dimension
    ends = np.sort(rng.integers(0, len(graph.keys), (10 * count, 2)), axis=1)
    ends = ends[ends[:, 1] - ends[:, 0] > 1][:count]
    p = graph.tangent_size - d
    measured = Poses(turns(rng.uniform(-2, 2, (count, p))), rng.uniform(-5, 5, (count, d)))
    return graph.add_edges(ends, measured, np.tile(graph.information[0], (count, 1, 1)))


def distance(first: Poses, second: Poses) -> float:
    """Largest distance of positions, without alignment."""
    return float(np.linalg.norm(first.translations - second.translations, axis=1).max())
