# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How much of the difference of two poses is an error: the pose relations, under evo's names.

The difference is the relative pose E = T_reference⁻¹ T_estimate, with rotation R and translation t:

| relation | error | unit |
|---|---|---|
| `full` | Frobenius norm of E - I | none (mixes rad and m) |
| `trans_part` | norm of t | m |
| `rot_part` | Frobenius norm of R - I | none |
| `angle_deg`, `angle_rad` | angle of R | deg, rad |
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.evaluation.choices import PoseRelation


def relative_poses(
    rotations_a: Rotation, positions_a: FloatArray, rotations_b: Rotation, positions_b: FloatArray
) -> tuple[Rotation, FloatArray]:
    """T_a⁻¹ T_b of N pairs of poses, as rotations and (N, 3) translations."""
    inverse = rotations_a.inv()
    return inverse * rotations_b, inverse.apply(positions_b - positions_a)


def errors(rotations: Rotation, translations: FloatArray, relation: PoseRelation) -> FloatArray:
    """The (N,) errors of N relative poses.

    Args:
        rotations: R of the relative poses.
        translations: (N, 3) t of the relative poses, in metres.
        relation: which part counts.
    """
    squared_distance: FloatArray = np.sum(translations**2, axis=1)
    if relation == "trans_part":
        return np.sqrt(squared_distance)
    if relation in ("full", "rot_part"):
        squared = np.sum((rotations.as_matrix() - np.eye(3)) ** 2, axis=(1, 2))
        return np.asarray(np.sqrt(squared + (squared_distance if relation == "full" else 0.0)))
    angles = np.asarray(rotations.magnitude(), dtype=np.float64)
    return np.degrees(angles) if relation == "angle_deg" else angles
