# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Clock and mounting of a camera by the epipolar errors that its features have under the gyroscope.

Two views alone often have several rotations that fit nearly as well: a plane has two, and a narrow
lens hardly tells a turn from a shift. So the rotation of a pair of frames is not estimated here. It
is that of the gyroscope,

    R_k = Cᵀ G(t₁ + Δ)ᵀ G(t₂ + Δ) Exp(-J_k b) C,

with the time offset Δ (t_imu = t_camera + Δ), the gyroscope bias b and the mounting C, and only the
direction of the translation is free in each pair. The robust cost of all features is found for
every Δ of a grid, and its least value and curvature there by smaller steps, as in
`gyro_alignment.py`. What the gyroscope integrates wrongly is noise of the rotation of each pair.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray, median
from slam_graph.backend.initialization.gyro_alignment import (
    MAX_OFFSET_S,
    GyroAlignment,
    IntegratedGyroscope,
    rotation_matrices,
    rotation_vectors,
)
from slam_graph.backend.initialization.visual_rotation import Bearings
from slam_graph.backend.initialization.visual_turns import at_middle_row
from slam_graph.kernels.epipolar_equations import CAUCHY_WIDTH, pair_equations
from slam_graph.kernels.epipolar_rotation import find_directions
from slam_graph.sensors import FeatureFrame, ImuBuffer, ImuData, RigCamera

_SPACING_NS, _LONGEST_NS = 190_000_000, 410_000_000
"""Smallest time between frames that are used, and largest between the two of a pair."""
_COMMON, _FEWEST, _MOST = 40, 15, 60
"""Features that a pair should share, must, and may have."""
_LEAST_PAIRS = 9
_COARSE_S, _FINE_S, _FINE_STEPS = 0.02, 5e-3, 3
"""Steps of the time offset, and how many of the smaller ones on either side."""
_BIAS_SIGMA, _OFFSET_SIGMA_S, _TURN_SIGMA = 0.1, 0.5, 10.0
"""Prior standard deviations: rad/s, s, rad."""
_LEAST_SIGMA_RAD = 1e-6
"""Of a bearing: where a lens model is used far beyond its image its slopes have no limit."""
_GYROSCOPE_RAD = 1.5e-3
"""Standard deviation of the rotation of a pair by the gyroscope (measured on recorded flights)."""
_CORRELATION, _TURN_CORRELATION = 2.0, 3.0
"""Pairs share frames and errors: standard deviations of offset and mounting are larger by this."""
_LEAST_VARIANCE = 0.25
"""Of the residuals, in units of what is assumed: with less noise the errors that are left are those
of the gyroscope and of the calibration, as of a mounting that is some degrees off."""
_MEDIAN_CHI2_1 = 0.455
"""Median of χ² with one degree of freedom."""
_TURNS_AWAY = 0.12 * np.vstack([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
"""Turns from a coarse mounting from which the mounting is sought, rad: there are local minima."""
_SHORTENED = np.array([0.03, 0.15, 0.15, 0.15, 0.15, 0.15, 0.15])
"""Largest step of offset, bias and mounting."""
_STEPS, _DAMPINGS, _CONVERGED = 15, 4, 0.02
"""Most steps, most tries to shorten one, and the gain below which one is the last."""
_OFFSET, _BIAS, _BIAS_AND_TURN, _TURN = [0, 1, 2, 3], [1, 2, 3], [1, 2, 3, 4, 5, 6], [4, 5, 6]
_ALL = [0, *_BIAS_AND_TURN]
_TINY = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """Offset (s), gyroscope bias (3,) (rad/s) and mounting (3, 3)."""

    offset_s: float
    bias: FloatArray
    body_R_camera: FloatArray

    def moved(self, by: FloatArray) -> _Guess:
        """With a change (7,); the mounting turns in the frame of the camera."""
        turn = rotation_matrices(by[4:])
        return _Guess(self.offset_s + float(by[0]), self.bias + by[1:4], self.body_R_camera @ turn)


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Cost, its second (7, 7) and first (7,) derivatives, directions (P, 3), squares (N,)."""

    cost: float
    H: FloatArray
    g: FloatArray
    t: FloatArray
    squares: FloatArray

    def least_cost(self, columns: list[int]) -> float:
        """The cost that a step of some unknowns would lead to if it were quadratic."""
        g = self.g[columns]
        return self.cost - 0.5 * float(g @ np.linalg.solve(self.H[np.ix_(columns, columns)], g))

    @property
    def variance(self) -> float:
        """Of the residuals, in units of what is assumed."""
        return float(median(self.squares)) * CAUCHY_WIDTH**2 / _MEDIAN_CHI2_1


class _Problem:
    """Pairs of frames, and the gyroscope between them.

    Args:
        frames: stamps and bearings.
        imu: samples that cover them.
    """

    def __init__(self, frames: Sequence[tuple[int, Bearings]], imu: ImuData) -> None:
        pairs = list(_pairs(frames))
        self.count = len(pairs)
        if not pairs:
            return
        self._first = np.concatenate([frames[a][1].rays[i] for a, _, i, _ in pairs])
        self._second = np.concatenate([frames[b][1].rays[j] for _, b, _, j in pairs])
        sigmas = [
            np.column_stack([frames[a][1].sigmas[i], frames[b][1].sigmas[j]])
            for a, b, i, j in pairs
        ]
        self._variances = np.maximum(np.concatenate(sigmas), _LEAST_SIGMA_RAD) ** 2
        sizes = [len(i) for _, _, i, _ in pairs]
        self._begins = np.append(0, np.cumsum(sizes)).astype(np.int64)
        self._gyro = IntegratedGyroscope(imu)
        stamps = np.array([[frames[a][0] for a, *_ in pairs], [frames[b][0] for _, b, *_ in pairs]])
        self._t = 1e-9 * (stamps - self._gyro.start_ns)
        self._seconds = self._t[1] - self._t[0]
        self._prior = np.array([_OFFSET_SIGMA_S, *[_BIAS_SIGMA] * 3, *[_TURN_SIGMA] * 3]) ** -2.0

    def equations(self, at: _Guess, t: FloatArray | None = None) -> _Equations:
        """Cost and its derivatives.

        Args:
            at: values of the unknowns.
            t: (P, 3) directions to begin with; None to find them from nothing.
        """
        times, C = self._t + at.offset_s, at.body_R_camera
        one, two = self._gyro.orientation(times)
        body = one.transpose(0, 2, 1) @ two
        by_bias = rotation_matrices(-0.5 * rotation_vectors(body))
        by_bias *= -self._seconds[:, None, None]
        body = body @ rotation_matrices(by_bias @ at.bias)
        R = np.ascontiguousarray(C.T @ body @ C)
        seen = self._first, self._second, self._variances, self._begins
        if t is None:
            find_directions(*seen, R, t := np.empty((self.count, 3)))
        else:
            t = t.copy()
        found, squares = np.empty((self.count, 3, 4)), np.empty(len(self._first))
        pair_equations(*seen, R, t, found, squares)
        cost = 0.5 * CAUCHY_WIDTH**2 * float(np.sum(np.log1p(squares)))
        # without the error of the rotation by the gyroscope, which is eliminated
        noise = _GYROSCOPE_RAD**2
        marginal = np.linalg.solve(np.eye(3) + noise * found[:, :, :3], found)
        cost -= 0.5 * noise * float(np.sum(found[:, :, 3] * marginal[:, :, 3]))
        rate_one, rate_two = self._gyro.rate(times) - at.bias
        J = np.empty((self.count, 3, 7))
        J[:, :, 0] = (rate_two - (rate_one[:, None] @ body)[:, 0]) @ C
        J[:, :, 1:4] = C.T @ by_bias
        J[:, :, 4:] = np.eye(3) - R.transpose(0, 2, 1)
        H = np.sum(J.transpose(0, 2, 1) @ marginal[:, :, :3] @ J, axis=0) + np.diag(self._prior)
        g = np.sum(J.transpose(0, 2, 1) @ marginal[:, :, 3:], axis=0)[:, 0]
        g[_BIAS] += self._prior[_BIAS] * at.bias
        cost += 0.5 * self._prior[1] * float(at.bias @ at.bias)
        return _Equations(cost, H, g, t, squares)

    def minimized(
        self, at: _Guess, columns: list[int], steps: int = _STEPS, t: FloatArray | None = None
    ) -> tuple[_Guess, _Equations]:
        """The least cost by some of the unknowns, and where it is (Levenberg-Marquardt).

        Args:
            at: where to begin.
            columns: of the unknowns.
            steps: most steps.
            t: as for `equations`.
        """
        now, damping = self.equations(at, t), 1e-4
        for _ in range(steps):
            H, g = now.H[np.ix_(columns, columns)], now.g[columns]
            better = None
            for _ in range(_DAMPINGS):
                step = np.zeros(7)
                step[columns] = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
                step *= min(1.0, float(np.min(_SHORTENED / np.maximum(np.abs(step), _TINY))))
                tried = at.moved(step)
                there = self.equations(tried, now.t)
                if there.cost < now.cost:
                    better = tried, there
                    break
                damping *= 10.0
            if better is None:
                break
            gain, damping = now.cost - better[1].cost, 0.2 * damping
            at, now = better
            if gain < _CONVERGED:
                break
        return at, now


def _pairs(
    frames: Sequence[tuple[int, Bearings]],
) -> Iterable[tuple[int, int, IntArray, IntArray]]:
    """Numbers of both frames and rows of their common features: each frame with an earlier one."""
    for second, (stamp_ns, now) in enumerate(frames):
        for first in range(second):
            before_ns, before = frames[first]
            if stamp_ns - before_ns > _LONGEST_NS:
                continue
            _, i, j = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
            if len(i) >= (_COMMON if first < second - 1 else _FEWEST):
                stride = -(-len(i) // _MOST)
                yield first, second, i[::stride], j[::stride]
                break


def _problem(
    frames: Iterable[FeatureFrame],
    camera: RigCamera,
    pixel_sigma: float,
    imu: ImuBuffer,
    mounted: bool,
) -> _Problem | None:
    """The frames that the gyroscope covers whatever the offset is; None if they are too few.

    Rows are put at the time of the middle one where the rotation of the camera is known.
    """
    nominal_ns = round(camera.clock_offset_s * 1e9)
    around_ns = round(MAX_OFFSET_S * 1e9) + 10_000_000
    chosen: list[tuple[int, Bearings]] = []
    for frame in frames:
        stamp_ns = frame.stamp_ns + nominal_ns
        if not imu.covers(stamp_ns - around_ns) or stamp_ns + around_ns > imu.newest_ns():
            continue
        if not chosen or frame.stamp_ns - chosen[-1][0] >= _SPACING_NS:
            seen = (at_middle_row(frame, camera, imu) if mounted else frame).cameras[0]
            chosen.append((frame.stamp_ns, Bearings.of(seen, camera.camera, pixel_sigma)))
    if len(chosen) <= _LEAST_PAIRS:
        return None
    begin_ns, end_ns = chosen[0][0] + nominal_ns, chosen[-1][0] + nominal_ns
    problem = _Problem(chosen, imu.between(begin_ns - around_ns, end_ns + around_ns))
    return problem if problem.count >= _LEAST_PAIRS else None


def align_by_epipolar_errors(
    frames: Iterable[FeatureFrame],
    camera: RigCamera,
    pixel_sigma: float,
    imu: ImuBuffer,
    coarse: GyroAlignment | None,
    mounted: bool,
    near_s: float | None = None,
) -> GyroAlignment | None:
    """Time offset, bias and, where it is not known, mounting.

    Args:
        frames: features over the last seconds, without those that are known to move.
        camera: the first of the rig; offsets around its `clock_offset_s` are looked for.
        pixel_sigma: standard deviation of an observation, pixels.
        imu: samples so far.
        coarse: the same by rotations of two views each; needed for an unknown mounting.
        mounted: whether the rotation of the camera on the body is known.
        near_s: offset that was found a few seconds ago; it is looked for around it at first.

    Returns:
        None if frames are too few, or the cost has no minimum within the range.
    """
    if coarse is None and not mounted:
        return None
    problem = _problem(frames := list(frames), camera, pixel_sigma, imu, mounted)
    if problem is None:
        return None
    C, nominal_s = camera.body_T_camera.rotation().matrix(), camera.clock_offset_s
    start = _Guess(nominal_s, np.zeros(3), C)
    columns = _BIAS if mounted else _BIAS_AND_TURN
    if mounted:
        start = problem.minimized(start, _BIAS, 3)[0]
    elif coarse is not None:
        start = _mounted(problem, coarse)
    for grid in _grids(nominal_s, near_s):
        costs = [problem.equations(replace(start, offset_s=s)).least_cost(columns) for s in grid]
        best = int(np.argmin(np.nan_to_num(costs, nan=np.inf)))  # pairs of one bearing
        if 0 < best < len(grid) - 1:
            break
    else:
        return None
    found = replace(start, offset_s=float(grid[best]))
    unknowns = _OFFSET if mounted else _ALL
    found, least = problem.minimized(found, unknowns)
    if not abs(found.offset_s - nominal_s) < MAX_OFFSET_S:
        return None
    apart = np.abs(np.arange(len(grid)) - best) > 1
    margin = (float(np.min(np.array(costs)[apart])) - least.cost) / max(
        least.variance, _LEAST_VARIANCE
    )
    if camera.readout_s != 0.0:  # rows at the times that offset and mounting give them
        offset_s = camera.time_offset_s + found.offset_s - nominal_s
        pose = gtsam.Pose3(gtsam.Rot3(found.body_R_camera), camera.body_T_camera.translation())
        moved = replace(camera, body_T_camera=pose, time_offset_s=offset_s)
        problem = _problem(frames, moved, pixel_sigma, imu, mounted=True) or problem
        found, least = problem.minimized(found, unknowns)
    return _with_curvature(problem, found, least, columns, margin)


def _grids(nominal_s: float, near_s: float | None) -> list[FloatArray]:
    """Offsets at which the cost is found first, s: around one that is near, and all of them."""
    steps = round(MAX_OFFSET_S / _COARSE_S)
    grid = nominal_s + _COARSE_S * np.arange(-steps, steps + 1, dtype=np.float64)
    if near_s is None:
        return [grid]
    middle = int(np.argmin(np.abs(grid - near_s)))
    return [grid[max(middle - 2, 0) : middle + 3], grid]


def _mounted(problem: _Problem, coarse: GyroAlignment) -> _Guess:
    """Where the cost is least for an unknown mounting, from several ones around a coarse one."""
    around = _Guess(coarse.offset_s, coarse.gyro_bias, coarse.body_R_camera)
    turns = np.concatenate([np.zeros((len(_TURNS_AWAY), 4)), _TURNS_AWAY], axis=1)
    found = [problem.minimized(around.moved(turn), _ALL) for turn in turns]
    return min(found, key=_cost)[0]


def _cost(found: tuple[_Guess, _Equations]) -> float:
    return found[1].cost


def _with_curvature(
    problem: _Problem, found: _Guess, least: _Equations, columns: list[int], margin: float
) -> GyroAlignment | None:
    """The alignment by a parabola through the costs around a minimum."""
    away = _FINE_S * np.arange(-_FINE_STEPS, _FINE_STEPS + 1)
    beside = [replace(found, offset_s=found.offset_s + s) for s in away]
    costs = [problem.minimized(guess, columns, 1, least.t)[1].cost for guess in beside]
    curve = np.polyfit(away, costs, 2)
    if curve[0] <= 0.0:
        return None
    offset_s = found.offset_s + float(np.clip(-0.5 * curve[1] / curve[0], away[0], away[-1]))
    variance = max(least.variance, _LEAST_VARIANCE)
    rotation_sigma = 0.0
    if columns == _BIAS_AND_TURN:
        P = np.linalg.inv(least.H)[np.ix_(_TURN, _TURN)] * variance
        rotation_sigma = _TURN_CORRELATION * float(np.sqrt(np.linalg.eigvalsh(P)[-1]))
    return GyroAlignment(
        offset_s,
        _CORRELATION * float(np.sqrt(0.5 * variance / curve[0])),
        margin,
        found.bias,
        found.body_R_camera,
        rotation_sigma,
        least.variance,
    )
