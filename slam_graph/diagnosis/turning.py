# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The coarse comparison of camera and gyroscope: unit, axes and clock, whatever they are.

The rotation vectors of the camera, φ_c, and the integrals of the angular rate over the same times,
φ_g, obey φ_g = s Q φ_c + b Δt: a unit s, an orthogonal matrix Q and a bias b. The best Q of either
handedness follows from a singular value decomposition, for every time offset of a grid.
"""

from __future__ import annotations

from collections.abc import Callable
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
    moved = np.array([_gyroscope_turns(seen, gyroscopes, offset) for offset in grid[order]])
    handed = [_fits(camera, moved, seconds, _best_turns(sign)) for sign in (1.0, -1.0)]
    misfits = np.array([fits.misfits for fits in handed])
    best = int(np.argmin(misfits.min(axis=0)))
    fits = handed[int(np.argmin(misfits[:, best]))]
    calibrated = _fits(camera, moved, seconds, lambda _: body_R_camera)
    return Turning(
        float(fits.factors[best]),
        fits.Q[best],
        float(grid[order][best]),
        fits.biases[best],
        float(misfits[:, best].min()),
        float(misfits[:, best].max()),
        float(calibrated.misfits.min()),
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


@dataclass(frozen=True, slots=True, eq=False)
class _Fits:
    """The best fits of G time offsets: Q (G, 3, 3), or one for all, the others (G,) and (G, 3)."""

    Q: FloatArray
    factors: FloatArray
    misfits: FloatArray
    biases: FloatArray


_Turns = Callable[[FloatArray], FloatArray]
"""Rotations (G, 3, 3), or one for all, from the moments (G, 3, 3) of body and camera."""


def _best_turns(handed: float) -> _Turns:
    """The orthogonal matrices with a determinant of 1 or -1 that fit best (Kabsch 1976)."""

    def turns(moments: FloatArray) -> FloatArray:
        U, _, Vt = np.linalg.svd(moments)
        U[:, :, 2] *= handed * np.linalg.det(U @ Vt)[:, None]
        return np.asarray(U @ Vt)

    return turns


def _fits(camera: FloatArray, moved: FloatArray, seconds: FloatArray, turns: _Turns) -> _Fits:
    """The fits of camera turns (K, 3) with those of the gyroscope (G, K, 3) at G time offsets."""
    weights = np.ones(moved.shape[:2])
    for _ in range(_REWEIGHTINGS):
        share = weights * seconds / (weights @ seconds**2)[:, None]
        mean = share @ camera, (share[:, None] @ moved)[:, 0]
        one, two = (
            v - seconds[:, None] * m[:, None] for v, m in zip((camera, moved), mean, strict=True)
        )
        Q = turns((two * weights[..., None]).swapaxes(1, 2) @ one)
        turned = one @ Q.swapaxes(-1, -2)
        along, square = (np.sum(v * w, axis=2) for v, w in ((two, turned), (one, one)))
        along, square = (np.sum(weights * part, axis=1) for part in (along, square))
        factors = np.maximum(along / np.maximum(square, 1e-12), 0.0)
        rest = np.linalg.norm(two - factors[:, None, None] * turned, axis=2)
        scale = np.maximum(np.median(rest, axis=1), 1e-9)
        weights = 1.0 / (1.0 + (rest / (1.5 * scale[:, None])) ** 2)
    sizes = np.quantile(np.linalg.norm(two, axis=2), _MOST, axis=1)
    misfits = np.quantile(rest, _MOST, axis=1) / np.maximum(sizes, 1e-9)
    biases = mean[1] - factors[:, None] * (Q @ mean[0][..., None])[..., 0]
    return _Fits(Q, factors, misfits, biases)
