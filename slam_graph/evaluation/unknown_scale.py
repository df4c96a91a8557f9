# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The unit of length of an estimate whose covariances are relative to it.

One camera alone has a unit of length of its own. Its covariances are relative to the one at the
start (or, smoothed, to that of a distance that was held): there the scale is known exactly, and
later it drifts. A scale that is fitted over the whole path takes the mean of the drift away, which
the covariances do not; and at the start, where the fit is off, it makes errors that are many σ.

It is the path of the camera that has this scale, not that of the body: the place of the camera in
the body is in metres. So errors are taken at the camera: with a unit of u metres, the scaled path
of a body whose camera is right is off by up to twice |1 - u| of their distance.

The scale is taken where the estimate knows it best. A state at p from the first, with covariance
P, knows it relative to its unit with the variance v = 1 / (pᵀ P⁻¹ p), and the best linear estimate
of the scale from it is v pᵀ P⁻¹ t, t being the true p.
"""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.evaluation.truth_pairing import paired
from slam_graph.geometry import Similarity, Trajectory


def mounted_covariances(covariances: FloatArray, body_T_part: gtsam.Pose3) -> FloatArray:
    """Covariances (N, 6, 6) of poses of a body, as those of a part of it in its own frame."""
    by_body = body_T_part.inverse().AdjointMap()
    return np.asarray(by_body @ covariances @ by_body.T)


def scale_of_covariances(
    truth: Trajectory, estimate: Trajectory, pose_covariances: FloatArray
) -> float | None:
    """Metres of the truth per unit of an estimate, at the state that knows this best.

    That state is found from the estimate alone, so that errors have no say in it. Its own error
    along its distance from the first state is lost.

    Args:
        truth: the true trajectory.
        estimate: N states in a unit of their own.
        pose_covariances: (N, 6, 6) relative to this unit and the first of the poses, body frame,
            rotation before position; NaN where unknown.

    Returns:
        The scale; None if no state tells it: without covariances, or without motion.
    """
    true, rows = paired(truth, estimate)
    own, P = estimate.select(rows), pose_covariances[rows][:, 3:, 3:]
    turned = Similarity.of_first_pose(true, own, level=False)
    rotations = Rotation.from_quat(own.quaternions).as_matrix()
    shifts = (own.positions - own.positions[0])[:, :, None]
    in_body = (rotations.transpose(0, 2, 1) @ shifts)[:, :, 0]
    known = np.isfinite(P).all(axis=(1, 2)) & np.any(in_body != 0.0, axis=1)
    known[known] = np.linalg.eigvalsh(P[known])[:, 0] > 0.0
    if not known.any():
        return None
    weighted = np.linalg.solve(P[known], in_body[known][:, :, None])[:, :, 0]
    information = np.sum(weighted * in_body[known], axis=1)
    true_shifts = (true.positions - true.positions[0]) @ turned.rotation  # axes of the estimate
    true_in_body = (rotations.transpose(0, 2, 1) @ true_shifts[:, :, None])[known][:, :, 0]
    best = int(np.argmax(information))
    scale = float(weighted[best] @ true_in_body[best] / information[best])
    return scale if scale > 0.0 else None
