# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How far the calibration is off, by one step at the minimum of a bundle adjustment.

If the parameters e of the calibration were variables like states and features x, the next
Gauss-Newton step from the minimum under the calibration as it is would move them by

    δ = (S + P)⁻¹ g,   S = H_ee - H_ex H_xx⁻¹ H_xe,   g = g_e - H_ex H_xx⁻¹ g_x,

with their prior P and the covariance (S + P)⁻¹. The factor of H_xx is there already, so that this
costs little. The parameters are those of online calibration: where each camera is mounted, its
focal lengths, principal point and distortion, and the time offset of all cameras. A camera that
moves on the body by ξ in its own frame sees what it would see if the body moved by Ad_E ξ, with
E = body_T_camera; one that is late by τ, what it would see if the body had moved on by (ω, v) τ,
its angular rate and velocity in its own frame. Of a rolling shutter the motion to the row of a
feature is left out of the Jacobians.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.backend_config import CalibrationConfig
from slam_graph.backend.online_calibration import prior_sigmas, rolling_motion
from slam_graph.backend.smoothing.recording_cost import (
    EliminatedFeatures,
    LinearCost,
    LinearReprojection,
)
from slam_graph.backend.smoothing.state_elimination import STATE, EliminatedStates
from slam_graph.geometry import NavState
from slam_graph.sensors import CalibrationEstimate, ImuBuffer, Rig, RigCamera

_BLOCK = 20_000
"""Observations at a time: their Jacobians would take 60 MB for two minutes with two cameras."""


def variables_of(rig: Rig) -> dict[str, slice]:
    """Columns of the parameters of a rig, named as in `CalibrationEstimate`.

    A lens that GTSAM does not have is left out: the adjustment has a pinhole in its place.
    """
    sizes = {**dict(_sizes_of_cameras(rig)), "t0": 1}
    stops = np.cumsum(list(sizes.values())).tolist()
    starts = [0, *stops[:-1]]
    return {name: slice(*ends) for name, *ends in zip(sizes, starts, stops, strict=True)}


def _sizes_of_cameras(rig: Rig) -> Iterator[tuple[str, int]]:
    """Components of mountings (rotation, translation) and lenses (fx, fy, cx, cy; distortion)."""
    for c, mounted in enumerate(rig.cameras):
        yield f"e{c}", 6
        if mounted.camera.gtsam_calibration() is not None:
            yield f"k{c}", 4
            if mounted.camera.coefficients:
                yield f"d{c}", len(mounted.camera.coefficients)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationEquations:
    """Normal equations of the parameters e, all else eliminated, without their prior.

    Attributes:
        information: (n, n) S.
        gradient: (n,) g.
    """

    information: FloatArray
    gradient: FloatArray

    @classmethod
    def total(cls, parts: Iterable[CalibrationEquations]) -> CalibrationEquations | None:
        """Those of several parts of a recording; None of none."""
        parts = list(parts)
        if not parts:
            return None
        information = np.sum([part.information for part in parts], axis=0)
        return cls(information, np.sum([part.gradient for part in parts], axis=0))

    def estimate(
        self,
        rig: Rig,
        config: CalibrationConfig,
        stamp_ns: int,
        nominal: Rig | None = None,
        only: Container[str] | None = None,
    ) -> CalibrationEstimate:
        """The calibration after the step, with its covariance.

        Args:
            rig: the calibration that the equations were made with.
            config: prior standard deviations.
            stamp_ns: time of the estimate.
            nominal: the calibration that the prior is about; `rig` if not said.
            only: the variables that are estimated, one at least; the others are right then. All if
                not said.
        """
        columns = variables_of(rig)
        prior = np.concatenate(
            [prior_sigmas(name[0], rig.cameras[int(name[1:])].camera, config) for name in columns]
        )
        free = {name: own for name, own in columns.items() if only is None or name in only}
        among = np.ix_(
            *2 * [np.concatenate([np.arange(own.start, own.stop) for own in free.values()])]
        )
        covariance = np.zeros_like(self.information)
        covariance[among] = np.linalg.inv((self.information + np.diag(prior**-2.0))[among])
        nominal = nominal or rig
        away = np.concatenate([_difference(name, rig, nominal) for name in columns])
        step = covariance @ (self.gradient + prior**-2.0 * away)
        moved = _moved(rig, {name: step[own] for name, own in columns.items()})
        blocks = {name: covariance[own, own] for name, own in free.items()}
        by_baselines = _baseline_rows(moved) if only is None else np.zeros((0, len(covariance)))
        variances = np.einsum("ci,ij,cj->c", by_baselines, covariance, by_baselines)
        return CalibrationEstimate(stamp_ns, nominal, moved, blocks, np.sqrt(variances).tolist())


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationColumns:
    """What the Jacobians by the calibration are made of.

    Attributes:
        rig: the calibration.
        rates: (K, 6) angular rates and velocities of the keyframes, rad/s and m/s, body frame.
    """

    rig: Rig
    rates: FloatArray

    @classmethod
    def of(cls, rig: Rig, states: Sequence[NavState], imu: ImuBuffer) -> CalibrationColumns:
        """At the states of the keyframes, by the samples over them."""
        lead_ns = round(rig.pose_offset_s * 1e9)
        motions = [rolling_motion(s, s.stamp_ns - lead_ns, imu, rig) for s in states]
        return cls(rig, np.array([motion.rate for motion in motions]))

    def equations(
        self, linear: LinearCost, features: EliminatedFeatures, states: EliminatedStates
    ) -> CalibrationEquations:
        """The equations at a minimum.

        Args:
            linear: the cost, linearised there.
            features: the factor of its features.
            states: that of its states.
        """
        images, keyframes = linear.images, len(linear.chain.gradient)
        width = variables_of(self.rig)["t0"].stop
        H, g = np.zeros((width, width)), np.zeros(width)
        by_poses = np.zeros((keyframes, 6, width))
        by_points = np.zeros((len(images.obs.ids), 3, width))
        for first in range(0, len(images.obs), _BLOCK):
            part = images.rows(np.arange(first, min(first + _BLOCK, len(images.obs))))
            for camera in range(len(self.rig.cameras)):
                own = part.rows(np.flatnonzero(part.obs.camera == camera))
                columns, J = self._jacobians(own, camera)
                by_pose, by_point = own.products(J, keyframes)
                by_poses[:, :, columns] += by_pose
                by_points[:, :, columns] += by_point
                rows = J.reshape(-1, len(columns))
                H[np.ix_(columns, columns)] += rows.T @ rows
                g[columns] += rows.T @ own.r.ravel()
        reduced, t = features.reduced(by_poses, by_points)
        T, B = t.reshape(-1, width), np.zeros((keyframes, STATE, width))
        B[:, :6] = reduced
        by_state = linear.chain.gradient.copy()
        reduced, t = features.reduced(*images.gradient(keyframes))
        by_state[:, :6] += reduced
        if linear.fixes is not None and features.fixes is not None:
            by_state[:, :6] += features.fixes.reduced(*linear.fixes.gradient(keyframes))
        own_columns = B.reshape(-1, width)
        held = states.times_covariance(B).reshape(own_columns.shape)
        return CalibrationEquations(
            H - T.T @ T - own_columns.T @ held, g - T.T @ t.ravel() - held.T @ by_state.ravel()
        )

    def _jacobians(self, images: LinearReprojection, camera: int) -> tuple[IntArray, FloatArray]:
        """Whitened derivatives of the pixels of a camera by the parameters that they depend on.

        Args:
            images: observations of this camera only.
            camera: its number.

        Returns:
            Columns (m,) of these parameters, and the derivatives (N, 2, m).
        """
        columns, mounted = variables_of(self.rig), self.rig.cameras[camera]
        own = (f"e{camera}", f"k{camera}", f"d{camera}", "t0")
        names = [name for name in own if name in columns]
        parts = [images.by_pose @ mounted.body_T_camera.AdjointMap()]
        # where predicted: what was measured has errors in common with the residuals
        predicted, weights = images.normalized, images.weights[:, None, None]
        if f"k{camera}" in columns:
            parts.append(weights * mounted.camera.by_intrinsics(predicted))
        if f"d{camera}" in columns:
            parts.append(weights * mounted.camera.by_coefficients(predicted))
        parts.append(images.by_pose @ self.rates[images.obs.frame][:, :, None])
        chosen = [np.arange(columns[name].start, columns[name].stop) for name in names]
        return np.concatenate(chosen), np.concatenate(parts, axis=2)


def _baseline_rows(rig: Rig) -> FloatArray:
    """Derivatives (C - 1, n) of the distances from the first camera to each of the others."""
    columns, (first, *others) = variables_of(rig), [c.body_T_camera for c in rig.cameras]
    rows = np.zeros((len(others), columns["t0"].stop))
    for c, other in enumerate(others, 1):
        away = other.translation() - first.translation()
        away /= max(float(np.linalg.norm(away)), np.finfo(np.float64).tiny)
        rows[c - 1, columns[f"e{c}"]][3:] = other.rotation().unrotate(away)
        rows[c - 1, columns["e0"]][3:] = -first.rotation().unrotate(away)
    return rows


def _difference(name: str, rig: Rig, nominal: Rig) -> FloatArray:
    """The step of a variable from one calibration to another."""
    number = int(name[1:])
    one, other = rig.cameras[number], nominal.cameras[number]
    if name.startswith("t"):
        return np.array([other.time_offset_s - one.time_offset_s])
    if name.startswith("e"):
        step = one.body_T_camera.localCoordinates(other.body_T_camera)
        return np.asarray(step, dtype=np.float64)
    if name.startswith("d"):
        return np.subtract(other.camera.coefficients, one.camera.coefficients)
    return other.camera.intrinsics - one.camera.intrinsics


def _moved(rig: Rig, steps: dict[str, FloatArray]) -> Rig:
    """The rig with its parameters moved."""

    def camera(c: int, mounted: RigCamera) -> RigCamera:
        lens, pose = mounted.camera, gtsam.Pose3.Expmap(steps[f"e{c}"])
        if f"k{c}" in steps:
            fx, fy, cx, cy = (lens.intrinsics + steps[f"k{c}"]).tolist()
            lens = replace(lens, fx=fx, fy=fy, cx=cx, cy=cy)
        if f"d{c}" in steps:
            coefficients = np.add(lens.coefficients, steps[f"d{c}"])
            lens = replace(lens, coefficients=tuple(coefficients.tolist()))
        return replace(
            mounted,
            camera=lens,
            body_T_camera=mounted.body_T_camera * pose,
            time_offset_s=mounted.time_offset_s + float(steps["t0"][0]),
        )

    return replace(rig, cameras=tuple(camera(c, m) for c, m in enumerate(rig.cameras)))
