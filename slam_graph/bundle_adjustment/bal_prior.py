# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The residuals of a prior on the poses of a bundle adjustment, and their derivatives.

A camera is as far from its prior, in standard deviations, as

    r = (Log(R R₀ᵀ) / σ_θ,  (c - c₀) / σ_c),   c = -Rᵀ t.

No point is in it: it adds to the blocks of the cameras alone.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, skew
from slam_graph.bundle_adjustment.bal_problem import POSE_DIM, BalEstimates, BalPrior


def prior_cost(prior: BalPrior, estimates: BalEstimates) -> float:
    """Half the squared residuals."""
    of_cameras, of_points = camera_residuals(prior, estimates), point_residuals(prior, estimates)
    return 0.5 * float(np.sum(of_cameras**2) + np.sum(of_points**2))


def point_residuals(prior: BalPrior, estimates: BalEstimates) -> FloatArray:
    """(P, 3) in standard deviations."""
    away: FloatArray = (estimates.points - prior.points) / prior.point_sigmas[:, None]
    return away


def camera_residuals(prior: BalPrior, estimates: BalEstimates) -> FloatArray:
    """(C, 6) rotation and position, in standard deviations."""
    turn = Rotation.from_matrix(estimates.rotations @ prior.rotations.transpose(0, 2, 1))
    away = estimates.centres() - prior.centres
    return np.hstack([turn.as_rotvec() / prior.rotation_sigma, away / prior.centre_sigma])


def linearized_prior(prior: BalPrior, estimates: BalEstimates) -> tuple[FloatArray, FloatArray]:
    """Derivatives (C, 6, 6) by δθ, δt of a camera, and residuals (C, 6).

    Log(Exp(δθ) Exp(a)) = a + (I - ½ [a]ₓ + ¹⁄₁₂ [a]ₓ² - …) δθ, of which the next term is a⁴ / 720,
    and c changes by -Rᵀ ([t]ₓ δθ + δt).
    """
    r = camera_residuals(prior, estimates)
    turn, back = skew(prior.rotation_sigma * r[:, :3]), -estimates.rotations.transpose(0, 2, 1)
    by_pose = np.zeros((len(r), POSE_DIM, POSE_DIM))
    by_pose[:, :3, :3] = (np.eye(3) - turn / 2 + turn @ turn / 12) / prior.rotation_sigma
    by_pose[:, 3:, :3] = back @ skew(estimates.translations) / prior.centre_sigma
    by_pose[:, 3:, 3:] = back / prior.centre_sigma
    return by_pose, r
