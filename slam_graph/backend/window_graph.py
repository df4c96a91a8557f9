# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The cost of a step as a factor graph of GTSAM, to be held, drawn, solved and saved.

The engine works on stacked arrays, as its gate and its first-estimates Jacobians need them
(docs/engine.md compares the two). This module says the same cost in GTSAM's words: the marginal
prior is a `LinearContainerFactor`, the dynamics are the factors that the engine has anyway, and
each observation is a projection factor with the camera's distortion and place on the body, σ and
loss as used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.cost import Cost
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.gtsam_smoothers.smoother_features import pixel_noise
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import FrameMotion, State, dims_of, letter_and_index

_CALIBRATION_KINDS = frozenset("ekdt")
"""Symbols of the parameters of the rig, which are always linearised at their estimates."""


@dataclass(frozen=True, eq=False)
class WindowGraph:
    """The cost of a step, after its Gauss-Newton steps and before marginalization.

    Features that the step marginalises are variables here like all others.

    Attributes:
        graph: all factors: first the prior, then the dynamics, then one for each observation.
        values: the estimates of all variables.
        first_estimates: their linearisation points: the first estimates of variables of the prior.
        losses: for each factor its robust loss; None for those that have none.
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    first_estimates: gtsam.Values
    losses: tuple[RobustLoss | None, ...]

    def linearize(self) -> gtsam.GaussianFactorGraph:
        """The linear system of a Gauss-Newton step, as the engine solves it.

        Jacobians are evaluated at the first estimates (of the calibration at its estimates), right
        hand sides and the weights of the robust loss at the estimates.
        """
        points, tangents = gtsam.Values(self.first_estimates), {}
        for key in self.values.keys():  # noqa: SIM118
            kind = chr(gtsam.Symbol(key).chr())
            if kind == "e":  # increments are added to the offset from the first estimate
                first, pose = points.atPose3(key), self.values.atPose3(key)
                tangents[key] = gtsam.Pose3.ExpmapDerivative(first.localCoordinates(pose))
            if kind in _CALIBRATION_KINDS:
                _copy_calibration(self.values, points, key)
        linear = gtsam.GaussianFactorGraph()
        for number, loss in enumerate(self.losses):
            factor = self.graph.at(number)
            at = self.values if isinstance(factor, gtsam.LinearContainerFactor) else points
            jacobian = gtsam.JacobianFactor(factor.linearize(at))
            if loss is not None:  # each is weighted by the residual where it is linearised
                there, here = (self._weight(factor, v, loss) for v in (points, self.values))
                jacobian.getA()[:] *= np.sqrt(here / there)
            if at is points:
                _turn(jacobian, tangents)
            now = gtsam.JacobianFactor(factor.linearize(self.values))  # owns what getb() shows
            jacobian.getb()[:] = now.getb()
            linear.add(jacobian)
        return linear

    @staticmethod
    def _weight(factor: Any, values: gtsam.Values, loss: RobustLoss) -> float:
        """The weight of a factor that has a robust noise model around an isotropic one."""
        sigma = factor.noiseModel().noise().sigmas()[0]
        length = np.linalg.norm(factor.unwhitenedError(values)) / sigma
        return float(loss.weights(np.array([length]))[0])

    def texts(self) -> dict[str, str]:
        """Graph and values in GTSAM's own serialisation, and a drawing of the graph for Graphviz.

        Factors that are computed in Python (of calibration variables, and of camera models that
        GTSAM does not have) cannot be serialised; their linearisation stands for them.

        Returns:
            contents by name: `graph.txt`, `values.txt`, `graph.dot`.
        """
        graph = gtsam.NonlinearFactorGraph()
        for number in range(self.graph.size()):
            factor = self.graph.at(number)
            if isinstance(factor, gtsam.CustomFactor):
                linear = gtsam.JacobianFactor(factor.linearize(self.values))
                factor = gtsam.LinearContainerFactor(linear, self.values)
            graph.push_back(factor)
        return {
            "graph.txt": graph.serialize(),
            "values.txt": self.values.serialize(),
            "graph.dot": self.graph.dot(self.values),
        }


def window_graph(cost: Cost) -> WindowGraph:
    """A cost of the engine as a factor graph."""
    graph = gtsam.NonlinearFactorGraph()
    values, first = cost.state.estimate, cost.state.first
    losses: list[RobustLoss | None] = []
    if cost.prior.layout.size:
        graph.push_back(_container(cost.prior, first))
        losses.append(None)
    for factor in cost.factors:
        graph.push_back(factor)
        losses.append(None)
    loss = cost.robust
    projections = _Projections(cost)
    if cost.landmarks is not None:
        projections.add(graph, cost.landmarks)
    if cost.tracks is not None:
        for j, point in zip(cost.tracks.obs.ids.tolist(), cost.tracks.points, strict=True):
            if not values.exists(L(j)):
                values.insert(L(j), point)
                first.insert(L(j), point)
        projections.add(graph, cost.tracks.obs)
    robust = None if loss.name == "none" else loss
    losses += [robust] * (graph.size() - len(losses))
    return WindowGraph(graph, values, first, tuple(losses))


class _Projections:
    """Makes projection factors: GTSAM's own where it has them, else in Python."""

    def __init__(self, cost: Cost) -> None:
        self._cost, self._rig, self._motions = cost, cost.rig, dict(cost.state.motions)
        self._now = cost.rig.at(cost.state)
        self._models = [camera.gtsam_calibration() for camera in self._now.cameras]

    def add(self, graph: gtsam.NonlinearFactorGraph, obs: Observations) -> None:
        """One factor for each observation."""
        for row in range(len(obs)):
            single = obs.rows(np.array([row]))
            model = self._models[int(single.camera[0])]
            own = model is None or bool(self._common_keys(single))
            noise = pixel_noise(float(self._cost.sigmas(single)[0]), self._cost.robust)
            make = self._python(single, noise) if own else self._native(single, noise, model)
            graph.push_back(make)

    def _native(
        self, single: Observations, noise: gtsam.noiseModel.Base, model: object
    ) -> gtsam.NonlinearFactor:
        kind = getattr(gtsam, f"GenericProjectionFactor{type(model).__name__}")
        pose, point = _keys(single)
        mount = self._now.mount_poses(single)[0]  # of a rolling shutter that of the observed row
        factor: gtsam.NonlinearFactor = kind(
            single.pixels[0], noise, pose, point, model, False, False, mount
        )
        return factor

    def _python(self, single: Observations, noise: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
        keys = [*_keys(single), *self._common_keys(single)]
        error = _projection_error(single, self._rig, keys, self._motions)
        return gtsam.CustomFactor(noise, keys, error)

    def _common_keys(self, single: Observations) -> list[int]:
        """Keys of the calibration, and of the velocity of the frame if that is a variable."""
        frame = single.frames[int(single.frame[0])]
        own = [V(frame)] if frame in self._rig.velocities.first else []
        return [*self._rig.calibration_keys, *own]


def _keys(single: Observations) -> tuple[int, int]:
    """Keys of the pose and the feature of one observation."""
    return X(single.frames[int(single.frame[0])]), L(int(single.ids[int(single.feature[0])]))


def _projection_error(
    single: Observations, rig: RigProjection, keys: list[int], motions: dict[int, FrameMotion]
) -> Callable[[gtsam.CustomFactor, gtsam.Values, list[FloatArray] | None], FloatArray]:
    """π - z of one observation as a function of pose, feature and the rest, with Jacobians."""
    frame = single.frames[int(single.frame[0])]
    one = Observations(
        single.ids[single.feature],
        (frame,),
        np.zeros(1, np.int64),
        np.zeros(1, np.int64),
        single.camera,
        single.pixels,
        single.normalized,
    )
    dims = list(dims_of(keys[2:]).values())

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None
    ) -> FloatArray:
        state = State()
        state.insert(_calibration_in(values, keys[2:]))
        state.motions = motions
        now = rig.at(state)
        point = np.asarray(values.atPoint3(keys[1]))[None]
        geometry = Geometry(*now.poses(values, [frame]), point)
        if H is not None:
            by_pose, by_point, by_calibration = now.all_jacobians(one, geometry)
            H[0], H[1] = np.asfortranarray(by_pose[0]), np.asfortranarray(by_point[0])
            column = 0
            for number, dim in enumerate(dims, start=2):
                H[number] = np.asfortranarray(by_calibration[0][:, column : column + dim])
                column += dim
        if V(frame) in keys:  # as in the engine, only residuals follow the velocity
            velocity = values.atPose3(keys[0]).rotation().unrotate(values.atVector(V(frame)))
            rate = np.concatenate([motions[frame].rate[:3], velocity])
            state.motions = {frame: replace(motions[frame], rate=rate)}
            now = rig.at(state)
        return np.asarray(-now.residuals(one, geometry)[0][0], dtype=np.float64)

    return error


def _container(prior: SquareRootInformation, first: gtsam.Values) -> gtsam.LinearContainerFactor:
    """‖R δ - d‖² over the offsets δ from the first estimates as one factor."""
    unit = gtsam.GaussianFactorGraph()
    for key, dim in prior.layout.dims.items():
        noise = gtsam.noiseModel.Unit.Create(dim)
        unit.add(gtsam.JacobianFactor(key, np.eye(dim), np.zeros(dim), noise))
    gaussian = gtsam.JacobianFactor(unit)  # of the right shape; its arrays are views
    gaussian.getA()[:] = prior.R[:, prior.layout.indices(gaussian.keys())]
    gaussian.getb()[:] = prior.d
    return gtsam.LinearContainerFactor(gaussian, first)


def _turn(jacobian: gtsam.JacobianFactor, tangents: dict[int, FloatArray]) -> None:
    """Multiply the columns of some variables by the derivatives of their tangents, in place."""
    column = 0
    for key, dim in dims_of(jacobian.keys()).items():
        if key in tangents:
            A = jacobian.getA()[:, column : column + dim]
            A[:] = A @ tangents[key]
        column += dim


def _calibration_in(values: gtsam.Values, keys: list[int]) -> gtsam.Values:
    """Parameters of the rig alone."""
    found = gtsam.Values()
    for key in keys:
        is_pose = letter_and_index(key)[0] == "e"
        found.insert(key, values.atPose3(key) if is_pose else values.atVector(key))
    return found


def _copy_calibration(source: gtsam.Values, target: gtsam.Values, key: int) -> None:
    if chr(gtsam.Symbol(key).chr()) == "e":
        target.update(key, source.atPose3(key))
    else:
        target.update(key, source.atVector(key))
