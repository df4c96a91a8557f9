# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The result of online calibration: the rig, and the covariances of its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.sensors.rig import Rig


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of a calibration.

    Attributes:
        name: with the camera and the unit, e.g. ``cam0_fx_px``.
        start: calibrated value, from which the estimation started.
        value: estimate.
        sigma: standard deviation of the estimate.
    """

    name: str
    start: float
    value: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationEstimate:
    """An estimate of some parameters of a rig at one time.

    Attributes:
        stamp_ns: time of the estimate on the clock of the IMU.
        nominal: the rig that the estimation started from.
        rig: with the estimated parameters.
        covariances: of each variable that was estimated: `e0` (6, 6) of the pose of camera 0, in
            its tangent (rad and m, camera frame); `k0` (4, 4) of its intrinsics in pixels; `d0`
            (n, n) of the n coefficients of its camera model; `t0` (1, 1) of the time offset in
            seconds.
    """

    stamp_ns: int
    nominal: Rig
    rig: Rig
    covariances: Mapping[str, FloatArray]

    def parameters(self) -> list[Parameter]:
        """All parameters that were estimated.

        Rotations are from the calibrated to the estimated camera frame, as a rotation vector in the
        former; positions are those of the camera in the body.
        """
        table: list[Parameter] = []
        for variable, covariance in self.covariances.items():
            names, start, values = self._values(variable)
            if variable.startswith("e"):
                R = self.rig.cameras[int(variable[1:])].body_T_camera.rotation().matrix()
                in_body = np.block([[np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), R]])
                covariance = in_body @ covariance @ in_body.T
            sigmas = np.sqrt(np.diag(covariance))
            table += map(Parameter, names, start.tolist(), values.tolist(), sigmas.tolist())
        return table

    def _values(self, variable: str) -> tuple[list[str], FloatArray, FloatArray]:
        """Names of a variable's parameters, their calibrated values, and their estimates."""
        kind, c = variable[0], int(variable[1:])
        before, now = self.nominal.cameras[c], self.rig.cameras[c]
        if kind == "t":
            offsets = [np.array([mounted.time_offset_s]) for mounted in (before, now)]
            return ["time_offset_s"], offsets[0], offsets[1]
        if kind == "e":
            names = [f"rotation_{axis}_rad" for axis in "xyz"]
            names += [f"position_{axis}_m" for axis in "xyz"]
            turn = before.body_T_camera.rotation().between(now.body_T_camera.rotation())
            start = np.concatenate([np.zeros(3), before.body_T_camera.translation()])
            values = np.concatenate([gtsam.Rot3.Logmap(turn), now.body_T_camera.translation()])
        elif kind == "k":
            names = ["fx_px", "fy_px", "cx_px", "cy_px"]
            start, values = before.camera.intrinsics, now.camera.intrinsics
        else:
            names = [f"distortion_{n}" for n in range(len(now.camera.coefficients))]
            start = np.array(before.camera.coefficients)
            values = np.array(now.camera.coefficients)
        return [f"cam{c}_{name}" for name in names], start, values
