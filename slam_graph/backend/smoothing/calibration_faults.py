# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What of a calibration is clearly off, by an estimate of it with covariances, in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.sensors import CalibrationEstimate

_SIGMAS, _SIGMAS_BASELINE = 6.0, 4.5
"""A difference counts from so many standard deviations on. A baseline is a single number, which
is known better than the places of the cameras in the body."""
_TURN_RAD, _MOVE_M = np.deg2rad(0.2), 0.015
_FOCAL, _CENTRE_PX = 0.005, 3.0
_DISTORTION_PX = 1.0
_OFFSET_S, _BASELINE = 0.0015, 0.008
"""It must also be larger than these: smaller ones hardly matter, and no calibration is better.
Focal lengths and baselines are relative; of distortions it is the root mean square over the image.
"""
_APART_M = 1e-3
"""The shortest baseline that is compared."""
_GRID = 12
"""Rows and columns of points by which distortions are compared."""
_HARMFUL = 2.0
"""A difference of so many times these limits may harm: with a camera turned by 0.5° the error of
V1_02 is three times as large, with 0.3° twice."""


@dataclass(frozen=True, slots=True)
class _Difference:
    """A difference of some parameters from what they are taken for.

    Attributes:
        what: in words.
        size: its length, in rad, m, pixels, s, or relative.
        least: the smallest size that counts.
        sigmas: its Mahalanobis distance.
        fewest: the smallest such distance that counts.
    """

    what: str
    size: float
    least: float
    sigmas: float
    fewest: float = _SIGMAS

    @classmethod
    def of(
        cls, what: str, d: FloatArray, covariance: FloatArray, least: float, unit: float = 1.0
    ) -> _Difference:
        """Of a vector (n,) with its covariance (n, n).

        Args:
            what: in words, with places for the size and its standard deviation.
            d: the vector.
            covariance: of it.
            least: the smallest size that counts.
            unit: what the size is shown in.
        """
        size = float(np.linalg.norm(d))
        squared = float(np.dot(d, np.linalg.solve(covariance, d)))
        sigmas = max(squared, 0.0) ** 0.5
        sigma = size / max(sigmas, 1e-9)
        return cls(what.format(size / unit, sigma / unit), size, least, sigmas)


@dataclass(frozen=True, slots=True)
class CalibrationFault:
    """What of a calibration is clearly off.

    Attributes:
        what: in words.
        variable: as in `CalibrationEstimate`.
        setting: of online calibration, under which the estimator finds it.
        harms: whether it is so large that errors may be several times as large by it.
    """

    what: str
    variable: str
    setting: str
    harms: bool


_SETTINGS = {
    "e": "backend.calibration.extrinsics",
    "k": "backend.calibration.intrinsics",
    "d": "backend.calibration.distortion",
    "t": "backend.calibration.time_offset",
}
"""By the first letter of a variable."""


def calibration_faults(found: CalibrationEstimate) -> list[CalibrationFault]:
    """What is off, the clearest first; [] where the calibration fits."""
    known = [(name, d) for name in found.covariances for d in _differences(found, name)]
    off = [(name, d) for name, d in known if d.sigmas > d.fewest and d.size > d.least]
    off.sort(key=lambda fault: fault[1].size / fault[1].least, reverse=True)
    return [
        CalibrationFault(d.what, name, _SETTINGS[name[0]], d.size > _HARMFUL * d.least)
        for name, d in off
    ]


def _baseline(found: CalibrationEstimate, number: int) -> Iterator[_Difference]:
    """How far a camera is from the first one, relative to what is calibrated, if they are apart."""
    if not number or not found.baseline_sigmas_m:
        return
    lengths = []
    for rig in (found.nominal, found.rig):
        first, other = (rig.cameras[c].body_T_camera.translation() for c in (0, number))
        lengths.append(float(np.linalg.norm(other - first)))
    was, now = lengths
    if was < _APART_M:
        return
    wrong = "short" if now > was else "long"
    what = f"the calibrated baseline of cam{number} is {{:.1f}} ± {{:.1f}} % too {wrong}"
    variance = np.array([[(found.baseline_sigmas_m[number - 1] / was) ** 2]])
    off = _Difference.of(what, np.array([now / was - 1.0]), variance, _BASELINE, 1e-2)
    yield replace(off, fewest=_SIGMAS_BASELINE)


def _distortion(found: CalibrationEstimate, number: int) -> Iterator[_Difference]:
    """How far the distortion is off: the root mean square by which points of the image move."""
    old, new = (rig.cameras[number].camera for rig in (found.nominal, found.rig))
    across = (np.arange(_GRID) + 0.5) / _GRID
    x, y = np.meshgrid(across * old.width, across * old.height)
    points, inside = old.visible(np.column_stack([x.ravel(), y.ravel()]))
    if np.count_nonzero(inside) < len(old.coefficients):
        return
    by_coefficients = old.by_coefficients(points[inside])
    moments = np.einsum("nij,nik->jk", by_coefficients, by_coefficients) / len(by_coefficients)
    in_px = np.linalg.cholesky(moments).T
    change = in_px @ np.subtract(new.coefficients, old.coefficients)
    what = f"the distortion of cam{number} is {{:.1f}} ± {{:.1f}} px off"
    covariance = in_px @ found.covariances[f"d{number}"] @ in_px.T
    yield _Difference.of(what, change, covariance, _DISTORTION_PX)


def _differences(found: CalibrationEstimate, name: str) -> Iterator[_Difference]:
    """How far a variable is from its calibration."""
    covariance, number = found.covariances[name], int(name[1:])
    old, new = found.nominal.cameras[number], found.rig.cameras[number]
    if name.startswith("t"):
        what = "the time offset of the cameras is {:.1f} ± {:.1f} ms off"
        late = np.array([new.time_offset_s - old.time_offset_s])
        yield _Difference.of(what, late, covariance, _OFFSET_S, 1e-3)
    elif name.startswith("e"):
        what = f"cam{number} is turned by {{:.2f}}° ± {{:.2f}}° against its calibration"
        step = old.body_T_camera.localCoordinates(new.body_T_camera)
        yield _Difference.of(what, step[:3], covariance[:3, :3], _TURN_RAD, np.deg2rad(1.0))
        what = f"cam{number} is {{:.0f}} ± {{:.0f}} mm away from where it is calibrated"
        yield _Difference.of(what, step[3:], covariance[3:, 3:], _MOVE_M, 1e-3)
        yield from _baseline(found, number)
    elif name.startswith("d"):
        yield from _distortion(found, number)
    else:
        focal, change = old.camera.intrinsics[:2], new.camera.intrinsics - old.camera.intrinsics
        what = f"the focal lengths of cam{number} are {{:.1f}} ± {{:.1f}} % off"
        both = focal * np.sqrt(2.0)  # so that the length is the root mean square of the two
        relative = covariance[:2, :2] / np.outer(both, both)
        yield _Difference.of(what, change[:2] / both, relative, _FOCAL, 1e-2)
        what = f"the principal point of cam{number} is {{:.1f}} ± {{:.1f}} px off"
        yield _Difference.of(what, change[2:], covariance[2:, 2:], _CENTRE_PX)
