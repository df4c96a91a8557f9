# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Clock and mounting of a camera from its rotations and those of the gyroscope.

The camera's rotation from one frame to another equals that of the body between the same times: with
the time offset Δ (t_imu = t_camera + Δ), gyroscope bias b and mounting C = body_R_camera,

    C Log(R_k) ≈ Log(G(t₁ + Δ)ᵀ G(t₂ + Δ)) - J_k b,

G being the integrated gyroscope. For a given Δ this is linear in b, and in C it is Wahba's problem.
So Δ is found by evaluating the least cost on a grid, twice, and by its curvature. Neither velocity
nor gravity nor scale takes part, and a camera that turns fast shows Δ whatever else is unknown
(Mair, Fleps, Suppa & Burschka 2011; Qin & Shen 2018 for the offset as a variable).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, IntArray, median, skew
from slam_graph.kernels.gyroscope_turns import orientations_at, turn_matrices
from slam_graph.sensors import ImuData

MAX_OFFSET_S = 0.12
"""Largest time offset that is looked for, of either sign."""
MIN_TURNS = 15
"""Fewest rotations for an estimate."""
CLEAR = 30.0
"""Smallest margin of a minimum: the second best has a probability of exp(-30) of the best."""
_MAX_MISFIT = 30.0
"""Rotations that fit worse, in units of their information, are of something else than offsets."""
_COARSE_S, _FINE_S = 5e-3, 1e-3
"""Steps of the two grids."""
_BIAS_SIGMA = 0.1
"""Prior standard deviation of the gyroscope bias, rad/s."""
_CAUCHY_WIDTH = 2.4
"""Residual with half the weight, in units of the noise."""
_REWEIGHTINGS = 3
"""How often wrong rotations lose weight."""
_MEDIAN_CHI2_3 = 2.366
"""Median of χ² with three degrees of freedom."""
_MOVING_CHI2 = 25.0
"""Squared size, in units of its information, of a rotation that is none of noise."""
_CORRELATION = 2.0
"""Rotations that share frames have errors in common: standard deviations are larger than those of
independent ones by this factor (measured on simulated flights with real and simulated IMUs)."""
_APART_S = 0.02
"""A second minimum is one that is farther from the first than this."""
_SHOWN_RAD = 0.03
"""Changes of the rotation below this in the median show nothing of units and mounting."""
_SAME_RATE = (0.67, 1.5)
"""Camera and gyroscope turn equally fast if the ratio of their rates is within these."""
_FITS, _CONTRADICTS = 0.3, 0.6
"""Median difference of rotations relative to their size, of what fits and what does not."""


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """Rotations of a camera between pairs of frames.

    Attributes:
        first_ns, second_ns: (K,) stamps of the frames on the clock of the camera.
        R: (K, 3, 3) first_R_second of the camera.
        information: (K, 3, 3) about them, in the tangent at the second frame, 1/rad².
    """

    first_ns: IntArray
    second_ns: IntArray
    R: FloatArray
    information: FloatArray

    def select(self, rows: BoolArray) -> Turns:
        """Those of some rows (K,)."""
        return Turns(
            self.first_ns[rows], self.second_ns[rows], self.R[rows], self.information[rows]
        )


@dataclass(frozen=True, slots=True, eq=False)
class GyroAlignment:
    """How the camera's clock and mounting go with the gyroscope.

    Attributes:
        offset_s: t_imu - t_camera.
        offset_sigma_s: its standard deviation.
        margin: how much larger the least cost elsewhere is (half a χ² of one degree of freedom).
        gyro_bias: (3,) rad/s.
        body_R_camera: (3, 3).
        rotation_sigma_rad: largest standard deviation of its rotation; 0 if it was given.
        misfit: mean squared residual in units of what the rotations' own information allows.
    """

    offset_s: float
    offset_sigma_s: float
    margin: float
    gyro_bias: FloatArray
    body_R_camera: FloatArray
    rotation_sigma_rad: float
    misfit: float

    def is_clear(self, margin: float = CLEAR) -> bool:
        """Whether the minimum is the only one, and the rotations are of the body."""
        return self.margin >= margin and self.misfit <= _MAX_MISFIT


class IntegratedGyroscope:
    """The integrated gyroscope, at any time."""

    def __init__(self, imu: ImuData) -> None:
        self.start_ns = int(imu.stamps_ns[0])
        self._t = np.asarray((imu.stamps_ns - self.start_ns) * 1e-9, np.float64)
        self._rate = np.ascontiguousarray(imu.gyro)
        mean = 0.5 * (imu.gyro[1:] + imu.gyro[:-1])
        self._R = imu.chained(rotation_matrices(mean * np.diff(self._t)[:, None]))

    def orientation(self, t: FloatArray) -> FloatArray:
        """start_R_body (..., 3, 3) at times (...) in seconds after the start."""
        R = np.empty((t.size, 3, 3))
        orientations_at(self._t, self._rate, self._R, np.ascontiguousarray(t).ravel(), R)
        return R.reshape(*t.shape, 3, 3)

    def rate(self, t: FloatArray) -> FloatArray:
        """Angular rates (..., 3) at times (...) in seconds after the start."""
        return np.stack([np.interp(t, self._t, axis) for axis in self._rate.T], axis=-1)


class _Problem:
    """The least cost over bias and mounting at each of many offsets.

    Attributes:
        moving: (K,) the rotations that are not of a camera at rest, or all if there are none.
            Those have smaller errors, and show nothing of the offset.
    """

    def __init__(self, turns: Turns, imu: ImuData) -> None:
        self._gyro = IntegratedGyroscope(imu)
        self._t = 1e-9 * (np.stack([turns.first_ns, turns.second_ns]) - self._gyro.start_ns)
        self._seconds = self._t[1] - self._t[0]
        self._turns = turns
        vectors = Rotation.from_matrix(turns.R).as_rotvec()
        squares = np.einsum("ki,kij,kj->k", vectors, turns.information, vectors)
        moving = squares > _MOVING_CHI2
        self.moving = moving if moving.any() else ~moving

    def body_turns(self, offsets: FloatArray) -> FloatArray:
        """Rotation vectors (D, K, 3) of the body between the frames, for D offsets."""
        one, two = (self._gyro.orientation(t + offsets[:, None]) for t in self._t)
        return rotation_vectors(one.swapaxes(-1, -2) @ two)

    def rotation_by_wahba(self, body: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mounting (D, 3, 3) and squared residual (D,) for rotation vectors (D, K, 3) of the body.

        The bias moves all of them alike, so their means are left out.
        """
        camera = Rotation.from_matrix(self._turns.R).as_rotvec()
        seconds = self._seconds / self._seconds.mean()
        centred = camera - seconds[:, None] * camera.mean(axis=0)
        moved = body - seconds[:, None] * body.mean(axis=1, keepdims=True)
        U, _, Vt = np.linalg.svd(np.einsum("dki,kj->dij", moved, centred))
        signs = np.ones((len(body), 3))
        signs[:, 2] = np.linalg.det(U @ Vt)
        C = (U * signs[:, None, :]) @ Vt
        rest = moved - np.einsum("dij,kj->dki", C, centred)
        return C, np.median(np.sum(rest**2, axis=2), axis=1)

    def linearized(
        self, body: FloatArray, C: FloatArray, free: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (D, K, 3) and their Jacobian (D, K, 3, 3 or 6) at each of D offsets.

        Args:
            body: (D, K, 3) rotation vectors of the body.
            C: (3, 3) mounting.
            free: whether it is estimated as well.
        """
        half = rotation_matrices(-0.5 * body)
        seen = C @ self._turns.R @ C.T
        r = -rotation_vectors(half @ (half @ seen))
        J = -half * self._seconds[:, None, None]
        if free:  # C exp(θ) turns the vectors by θ × v
            vectors = Rotation.from_matrix(self._turns.R).as_rotvec()
            by_mounting = np.broadcast_to(C @ skew(vectors), (*body.shape, 3))
            J = np.concatenate([J, by_mounting], axis=-1)
        root = np.linalg.cholesky(C @ self._turns.information @ C.T).swapaxes(-1, -2)
        return (root @ r[..., None])[..., 0], root @ J


def rotation_matrices(vectors: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) of rotation vectors (..., 3), rad."""
    R = np.empty((vectors.size // 3, 3, 3))
    turn_matrices(np.ascontiguousarray(vectors).reshape(-1, 3), R)
    return R.reshape(*vectors.shape, 3)


def rotation_vectors(R: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3), rad, of rotations (..., 3, 3) by less than half a turn.

    By way of SciPy's quaternions it takes ten times as long.
    """
    x, y, z = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    sine = 0.5 * np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(sine, 0.5 * (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0))
    scale = 0.5 * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)
    return np.stack([x * scale, y * scale, z * scale], axis=-1)


def _robust_least_squares(
    r: FloatArray, J: FloatArray, scale: float | None, moving: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Least robust cost of D problems r + J x with K residuals of three rows each.

    Args:
        r: (D, K, 3).
        J: (D, K, 3, n), by the gyroscope bias and the mounting or the offset, if one is estimated.
        scale: variance of the residuals in units of their information; None to measure it.
        moving: (K,) by which residuals it is measured.

    Returns:
        Cost (D,), unknowns (D, n), their information (D, n, n), and the scale (D,).
    """
    others = [MAX_OFFSET_S**-2] if J.shape[-1] == 4 else [0.0] * (J.shape[-1] - 3)
    prior = np.diag([_BIAS_SIGMA**-2] * 3 + others)
    D, K, _, n = J.shape
    J, r = J.reshape(D, 3 * K, n), r.reshape(D, 3 * K)
    weights = np.ones((D, K))
    for _ in range(_REWEIGHTINGS):
        weighted = (J * np.repeat(weights, 3, axis=1)[..., None]).transpose(0, 2, 1)
        H = weighted @ J + prior
        x = -np.linalg.solve(H, weighted @ r[..., None])[..., 0]
        squares = np.sum((r + (J @ x[..., None])[..., 0]).reshape(D, K, 3) ** 2, axis=2)
        measured = np.maximum(median(squares[:, moving].T) / _MEDIAN_CHI2_3, 1e-9)
        width = _CAUCHY_WIDTH**2 * (measured if scale is None else np.full(D, scale))
        weights = 1.0 / (1.0 + squares / (3.0 * width[:, None]))
    cost = 0.5 * np.sum(np.log1p(squares / (3.0 * width[:, None])), axis=1) * 3.0 * width
    return cost, np.asarray(x, np.float64), H, np.asarray(measured)


def align_gyroscope(
    turns: Turns, imu: ImuData, body_R_camera: FloatArray | None, nominal_s: float
) -> GyroAlignment | None:
    """Time offset, bias and, where it is not known, mounting.

    Args:
        turns: rotations of the camera.
        imu: samples that cover them with `MAX_OFFSET_S` on both sides of `nominal_s`.
        body_R_camera: (3, 3) mounting; None to estimate it.
        nominal_s: offset in the middle of those looked for.

    Returns:
        None if the cost has no minimum within the range.
    """
    problem = _Problem(turns, imu)
    steps = round(MAX_OFFSET_S / _COARSE_S)
    grid = nominal_s + _COARSE_S * np.arange(-steps, steps + 1, dtype=np.float64)
    free, C, body = body_R_camera is None, body_R_camera, problem.body_turns(grid)
    if C is None:
        mountings, residuals = problem.rotation_by_wahba(body)
        C = mountings[np.argmin(residuals)]
    for _ in range(_REWEIGHTINGS if free else 1):
        r, J = problem.linearized(body, C, free)
        scale = float(np.min(_robust_least_squares(r, J, None, problem.moving)[3]))
        cost, x, H, _ = _robust_least_squares(r, J, scale, problem.moving)
        best = int(np.argmin(cost))
        if free:
            C = C @ Rotation.from_rotvec(x[best, 3:]).as_matrix()
    if not 0 < best < len(grid) - 1:
        return None
    apart = np.abs(grid - grid[best]) > _APART_S
    margin = float(np.min(cost[apart]) - cost[best]) / scale
    fine = grid[best] + _FINE_S * np.arange(-5, 6)
    r, J = problem.linearized(problem.body_turns(fine), C, free)
    cost, x, H, _ = _robust_least_squares(r, J, scale, problem.moving)
    curve = np.polyfit(fine - grid[best], cost, 2)
    if curve[0] <= 0.0:
        return None
    away = float(np.clip(-0.5 * curve[1] / curve[0], fine[0] - grid[best], fine[-1] - grid[best]))
    middle = int(np.argmin(cost))
    covariance = np.linalg.inv(H[middle]) * scale * _CORRELATION**2
    rotation_sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])) if free else 0.0
    return GyroAlignment(
        float(grid[best]) + away,
        _CORRELATION * float(np.sqrt(0.5 * scale / curve[0])),
        margin,
        x[middle, :3],
        C,
        rotation_sigma,
        scale,
    )


def offset_step(
    turns: Turns, imu: ImuData, body_R_camera: FloatArray, offset_s: float
) -> tuple[float, float]:
    """How far the time offset is from a value near by, and its standard deviation, in seconds.

    One Gauss-Newton step of bias and offset: a tenth of the work of `align_gyroscope`, which is to
    follow where the step is large.

    Args:
        turns: rotations of the camera.
        imu: samples that cover them.
        body_R_camera: (3, 3) mounting.
        offset_s: the value, t_imu - t_camera.
    """
    problem = _Problem(turns, imu)
    around = problem.body_turns(offset_s + _COARSE_S * np.array([0.0, -1.0, 1.0]))
    r, J = problem.linearized(around, body_R_camera, free=False)
    by_offset = (r[2] - r[1]) / (2.0 * _COARSE_S)
    J = np.concatenate([J[0], by_offset[..., None]], axis=-1)[None]
    _, x, H, scale = _robust_least_squares(r[:1], J, None, problem.moving)
    variance = float(np.linalg.inv(H[0])[3, 3] * scale[0])
    return float(x[0, 3]), _CORRELATION * float(np.sqrt(variance))


def log_likelihood_ratios(
    turns: Turns,
    imu: ImuData,
    body_R_camera: FloatArray,
    gyro_bias: FloatArray,
    offsets_s: tuple[float, float],
) -> FloatArray:
    """How much likelier each of the rotations (K,) is under the second of two time offsets.

    Args:
        turns: rotations of the camera.
        imu: samples that cover them.
        body_R_camera: (3, 3) mounting.
        gyro_bias: (3,) rad/s.
        offsets_s: t_imu - t_camera.

    Returns:
        (K,) logarithms of the robust likelihood ratio; negative where the first is likelier.
    """
    problem = _Problem(turns, imu)
    body = problem.body_turns(np.array(offsets_s))
    r, J = problem.linearized(body, body_R_camera, free=False)
    squares = np.sum((r + J @ gyro_bias) ** 2, axis=2)
    noise = max(float(np.median(squares.min(axis=0)[problem.moving])) / _MEDIAN_CHI2_3, 1e-9)
    costs = 0.5 * _CAUCHY_WIDTH**2 * np.log1p(squares / (_CAUCHY_WIDTH**2 * noise))
    return np.asarray(costs[0] - costs[1])


def turns_contradict(
    turns: Turns, imu: ImuData, body_R_camera: FloatArray, offset_s: float
) -> str | None:
    """What is likely to be wrong if camera and gyroscope do not turn alike; None if they do.

    Coarser than the alignment and without its wrap at half a turn: the integral of the angular rate
    is compared with the rotation vector of the camera, with the means subtracted for the bias.

    Args:
        turns: rotations of the camera.
        imu: samples that cover them.
        body_R_camera: (3, 3) mounting by calibration.
        offset_s: time offset by calibration.
    """
    camera = Rotation.from_matrix(turns.R).as_rotvec()
    stamps_s = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    durations_s, rates, _ = imu.steps()
    integral = np.zeros_like(imu.gyro)
    np.cumsum(rates * durations_s[:, None], axis=0, out=integral[1:])
    one, two = (
        (stamps - imu.stamps_ns[0]) * 1e-9 + offset_s
        for stamps in (turns.first_ns, turns.second_ns)
    )
    body = np.stack([np.interp(two, stamps_s, c) - np.interp(one, stamps_s, c) for c in integral.T])
    seconds = ((two - one) / np.mean(two - one))[:, None]
    camera = camera - seconds * np.median(camera, axis=0)
    moved = body.T - seconds * np.median(body, axis=1)
    size = float(np.median(np.linalg.norm(camera, axis=1)))
    if size < _SHOWN_RAD:
        return None
    ratio = float(np.median(np.linalg.norm(moved, axis=1))) / size
    best = Rotation.align_vectors(moved, camera)[0]
    scaled = moved / max(ratio, 1e-6)

    def misfit(R: FloatArray) -> float:
        return float(np.median(np.linalg.norm(scaled - camera @ R.T, axis=1))) / size

    if misfit(best.as_matrix()) < _FITS:
        if not _SAME_RATE[0] < ratio < _SAME_RATE[1]:
            return (
                f"the gyroscope turns {ratio:.3g} times as fast as the camera; check its unit "
                "(rad/s; 57 times is degrees) and the focal length"
            )
        if misfit(body_R_camera) > _CONTRADICTS:
            away = np.rad2deg((best * Rotation.from_matrix(body_R_camera).inv()).magnitude())
            return (
                f"the camera is turned by some {away:.0f}° against its calibrated mounting; check "
                "T_cam_imu and the axes of the IMU"
            )
    elif misfit(body_R_camera) > _CONTRADICTS:
        return (
            "camera and gyroscope do not turn alike under any mounting; clocks that differ by more "
            "than 0.1 s, most features on moving objects, or wrong matches"
        )
    return None
