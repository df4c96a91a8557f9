# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The coarse comparison of camera and gyroscope: unit, axes and clock, whatever they are.

The rotation vectors of the camera, φ_c, and the integrals of the angular rate over the same times,
φ_g, obey φ_g = s Q φ_c + b Δt: a unit s, an orthogonal matrix Q and a bias b. The best Q of either
handedness follows from a singular value decomposition, for every time offset of a grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.diagnosis.frame_pairs import FramePair
from slam_graph.diagnosis.gyroscope import Gyroscope

_MAX_OFFSET_S, _OFFSET_STEP_S = 0.2, 5e-3
_REWEIGHTINGS = 6
_LEAST_TURN_RAD = 0.02
"""Rotations that change less from pair to pair show nothing."""
_LEAST_PAIRS = 12
_MOST = 0.75
"""Sizes are those of this quantile: a platform may stand still most of the time."""


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """How the gyroscope turns when the camera turns.

    Attributes:
        factor: by which the gyroscope turns faster than the camera.
        Q: (3, 3) orthogonal, from the camera to the gyroscope; with determinant -1 if the gyroscope
            is left-handed against it.
        offset_s: t_imu - t_camera.
        bias: (3,) of the gyroscope, in its unit.
        misfit: difference of the rotations relative to their size, between 0 and about 1.
        misfit_other: the same with the best Q of the other handedness.
        misfit_calibrated: with the calibrated mounting, at the best time offset.
        size_rad: size of the rotations without their mean.
        axes: about how many axes the camera turns enough to be compared.
    """

    factor: float
    Q: FloatArray
    offset_s: float
    bias: FloatArray
    misfit: float
    misfit_other: float
    misfit_calibrated: float
    size_rad: float
    axes: int


def coarse_turning(
    pairs: list[FramePair], gyroscopes: list[Gyroscope], body_R_camera: FloatArray, offset_s: float
) -> Turning | None:
    """The coarse comparison; None where the camera turns too little to tell.

    Args:
        pairs: of frames.
        gyroscopes: of the parts.
        body_R_camera: (3, 3) calibrated mounting.
        offset_s: calibrated time offset, the middle of those looked for.
    """
    seen = [pair for pair in pairs if pair.turn is not None]
    if len(seen) < _LEAST_PAIRS:
        return None
    camera = np.array([pair.turn for pair in seen])
    seconds = np.array([pair.second_s - pair.first_s for pair in seen])
    centred = _centred(camera, seconds)
    size = float(np.quantile(np.linalg.norm(centred, axis=1), _MOST))
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(centred.T)))
    axes = int(np.sum(spread > _LEAST_TURN_RAD))
    if size < _LEAST_TURN_RAD:
        return None
    steps = round(_MAX_OFFSET_S / _OFFSET_STEP_S)
    grid = offset_s + _OFFSET_STEP_S * np.arange(-steps, steps + 1)
    # at equal misfit the offset nearest to the calibrated one
    order = np.argsort(np.abs(grid - offset_s), kind="stable")
    moved = [_gyroscope_turns(seen, gyroscopes, offset) for offset in grid[order]]
    fits = [_best(camera, body, seconds, None) for body in moved]
    best = int(np.argmin([min(fit[2] for fit in pair) for pair in fits]))
    proper, mirrored = fits[best]
    fit, other = (proper, mirrored) if proper[2] <= mirrored[2] else (mirrored, proper)
    calibrated = min(_best(camera, body, seconds, body_R_camera)[0][2] for body in moved)
    return Turning(
        fit[1],
        fit[0],
        float(grid[order][best]),
        fit[3],
        fit[2],
        other[2],
        calibrated,
        size,
        axes,
    )


def _centred(vectors: FloatArray, seconds: FloatArray) -> FloatArray:
    """Vectors (K, 3) without what a bias may add."""
    return np.asarray(vectors - np.outer(seconds, np.median(vectors / seconds[:, None], axis=0)))


def _gyroscope_turns(
    pairs: list[FramePair], gyroscopes: list[Gyroscope], offset_s: float
) -> FloatArray:
    turns = np.empty((len(pairs), 3))
    part = np.array([pair.part for pair in pairs])
    times = np.array([[pair.first_s, pair.second_s] for pair in pairs]) + offset_s
    for number, gyroscope in enumerate(gyroscopes):
        of = part == number
        turns[of] = gyroscope.integral_at(times[of, 1]) - gyroscope.integral_at(times[of, 0])
    return turns


_Fit = tuple[FloatArray, float, float, FloatArray]
"""Q (3, 3), factor, misfit and bias (3,)."""


def _best(
    camera: FloatArray, body: FloatArray, seconds: FloatArray, Q: FloatArray | None
) -> list[_Fit]:
    """The best proper and improper fit; of a given Q the only one."""
    fits = []
    for handed in (1.0, -1.0) if Q is None else (1.0,):
        weights = np.ones(len(camera))
        turn, factor, bias = np.eye(3), 1.0, np.zeros(3)
        misfit = np.inf
        for _ in range(_REWEIGHTINGS):
            total = np.sum(weights * seconds**2)
            mean = [(weights * seconds) @ vectors / total for vectors in (camera, body)]
            one, two = camera - np.outer(seconds, mean[0]), body - np.outer(seconds, mean[1])
            if Q is None:
                U, _, Vt = np.linalg.svd((two * weights[:, None]).T @ one)
                turn = (U * (1.0, 1.0, handed * np.linalg.det(U @ Vt))) @ Vt
            else:
                turn = Q
            along = np.sum(weights[:, None] * two * (one @ turn.T))
            factor = max(float(along / max(np.sum(weights[:, None] * one**2), 1e-12)), 0.0)
            rest = np.linalg.norm(two - factor * one @ turn.T, axis=1)
            scale = max(float(np.median(rest)), 1e-9)
            weights = 1.0 / (1.0 + (rest / (1.5 * scale)) ** 2)
            bias = mean[1] - factor * turn @ mean[0]
            size = float(np.quantile(np.linalg.norm(two, axis=1), _MOST))
            misfit = float(np.quantile(rest, _MOST)) / max(size, 1e-9)
        fits.append((turn, factor, misfit, bias))
    return fits
