# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""GTSAM's factors for observations and for a prior, as its smoothers need them."""

from __future__ import annotations

from typing import Any

import gtsam
from gtsam.symbol_shorthand import L, X

from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.errors import ConfigError
from slam_graph.sensors import Camera, Rig


def calibration(camera: Camera) -> tuple[Any, Any]:
    """GTSAM's calibration of a camera, and the type of its projection factor.

    Raises:
        ConfigError: if GTSAM has no such camera model.
    """
    model = camera.gtsam_calibration()
    if model is None:
        raise ConfigError(
            f"GTSAM's smoothers have no camera with distortion '{camera.distortion}'; "
            "choose another algorithm"
        )
    return model, getattr(gtsam, f"GenericProjectionFactor{type(model).__name__}")


def pixel_noise(sigma_px: float, loss: RobustLoss) -> gtsam.noiseModel.Base:
    """Noise model of an observation under a robust loss."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma_px)
    estimators = gtsam.noiseModel.mEstimator
    if loss.name == "huber":
        return gtsam.noiseModel.Robust.Create(estimators.Huber.Create(loss.width), noise)
    if loss.name == "cauchy":
        return gtsam.noiseModel.Robust.Create(estimators.Cauchy.Create(loss.width), noise)
    return noise


class ProjectionFactors:
    """Makes the projection factors of the cameras of a rig."""

    def __init__(self, rig: Rig, noise: gtsam.noiseModel.Base) -> None:
        self._noise = noise
        self._cameras = [(*calibration(c.camera), c.body_T_camera) for c in rig.cameras]

    def of(self, obs: Observations) -> list[gtsam.NonlinearFactor]:
        """One factor between `X(frame)` and `L(feature)` for each observation.

        For a point behind the camera the cost is constant; no exception is raised.
        """
        factors = []
        poses, points = [X(i) for i in obs.frames], [L(j) for j in obs.ids.tolist()]
        rows = zip(
            obs.pixels,
            obs.camera.tolist(),
            obs.frame.tolist(),
            obs.feature.tolist(),
            strict=True,
        )
        for pixel, c, i, j in rows:
            model, factor, body_T_camera = self._cameras[c]
            keys = (poses[i], points[j])
            factors.append(factor(pixel, self._noise, *keys, model, False, False, body_T_camera))
        return factors


def joint_prior(prior: SquareRootInformation, at: gtsam.Values) -> gtsam.NonlinearFactor:
    """A Gaussian on pose, velocity and bias of one frame as one factor, with all correlations.

    Args:
        prior: ‖R δ - d‖² on exactly these three variables.
        at: the linearisation point, at which δ is zero.
    """
    (x, A_x), (v, A_v), (b, A_b) = (
        (key, prior.R[:, columns]) for key, columns in prior.layout.columns.items()
    )
    noise = gtsam.noiseModel.Unit.Create(prior.layout.size)
    gaussian = gtsam.JacobianFactor(x, A_x, v, A_v, b, A_b, prior.d, noise)
    return gtsam.LinearContainerFactor(gaussian, at)
