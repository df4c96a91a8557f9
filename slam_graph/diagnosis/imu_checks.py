# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Units, rate, gaps and overlap of the IMU, without any image."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.diagnosis.finding import Finding, graded
from slam_graph.sensors import ImuData, ImuNoise

GRAVITY = 9.81
_STANDARD_G = 9.80665
_UNITS = {"g": _STANDARD_G, "mm/s²": 1e-3, "cm/s²": 1e-2, "mg": _STANDARD_G * 1e-3}
_BIAS = 0.05
"""Standard deviation of an accelerometer's bias along gravity, m/s². It and the scatter of the mean
force tell units that differ by 2 %, or not:"""
_CLEARER = 2.0
"""the next unit must be so many deviations farther from gravity than the nearest one."""
_ONE_UNIT = (0.75, 1.3)
"""The mean force is that of gravity within these factors: motion adds to it, biases are small."""
_WINDOW_S = 1.0
_WITHOUT_GRAVITY = 0.6
"""Mean forces of a second that are shorter than this part of the force, if gravity is removed."""
_OFF = 0.5
"""Mean gravity may differ so much, m/s²: biases are a few tenths."""
_RATE_TOLERANCE, _JITTER, _GAP_PERIODS = 0.1, 0.3, 5.0
_LOST = 0.02
"""Share of the time in gaps from which on it is a warning."""
_COVERED = 0.9


def check_units(imu: ImuData) -> tuple[list[Finding], float]:
    """Findings about the unit of the accelerometer, and the factor to m/s² that the forces need."""
    if len(imu) < 10:
        return [], 1.0
    seconds = max(round(len(imu) / max((imu.stamps_ns[-1] - imu.stamps_ns[0]) * 1e-9, 1e-3)), 1)
    windows = max(len(imu) // max(round(seconds * _WINDOW_S), 1), 1)
    force = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    means = [np.linalg.norm(np.mean(block, axis=0)) for block in np.array_split(imu.accel, windows)]
    mean = float(np.median(means))
    values = {"mean_force": force}
    if _fits(force, GRAVITY) and mean > _WITHOUT_GRAVITY * force:
        return _scale(mean, values), 1.0
    if mean < _WITHOUT_GRAVITY * force or force < 0.05:
        what = (
            f"the accelerometer does not feel gravity: {mean:.2g} in the mean, {force:.2g} in all"
        )
        fix = "record the specific force, with gravity (not the driver's linear acceleration)"
        return [Finding("accelerometer_gravity", "error", what, fix, values=values)], 1.0
    units = _units(force, np.array(means))
    if units:
        names, factor = " or ".join(units), units[next(iter(units))]
        factors = " or ".join(f"{value:g} ({unit})" for unit, value in units.items())
        what = f"the accelerometer measures {force:.4g} where gravity is 9.81: its unit is {names}"
        fix = f"multiply the accelerations by {factors} to have m/s²"
        return [Finding("accelerometer_unit", "error", what, fix, values=values)], factor
    factor = GRAVITY / force
    what = f"the accelerometer measures {force:.4g} where gravity is 9.81 m/s²"
    fix = f"multiply the accelerations by {factor:.4g}, and check the accelerometer's range setting"
    return [Finding("accelerometer_unit", "error", what, fix, values=values)], factor


def _units(force: float, means: FloatArray) -> dict[str, float]:
    """Factors to m/s² of the units that a force may have, the likeliest first.

    Args:
        force: the median.
        means: (W,) lengths of the mean forces of seconds, which motion changes little.
    """
    fitting = {unit: factor for unit, factor in _UNITS.items() if _fits(force * factor, GRAVITY)}
    mean = float(np.median(means))
    spread = 1.4826 * float(np.median(np.abs(means - mean))) * 1.25 / np.sqrt(len(means))
    away = {
        unit: abs(mean * factor - GRAVITY) / float(np.hypot(_BIAS, spread * factor))
        for unit, factor in fitting.items()
    }
    units = sorted(fitting, key=lambda unit: away[unit])
    return {unit: fitting[unit] for unit in units if away[unit] < away[units[0]] + _CLEARER}


def _scale(mean: float, values: dict[str, float]) -> list[Finding]:
    if abs(mean - GRAVITY) < _OFF:
        return []
    what = f"the accelerometer measures {mean:.2f} m/s² in the mean, and not 9.81"
    fix = "calibrate the scale of the accelerometer; or raise backend.noise.imu_scale"
    return [Finding("accelerometer_scale", "warning", what, fix, "likely", None, values)]


def _fits(force: float, expected: float) -> bool:
    return _ONE_UNIT[0] < force / expected < _ONE_UNIT[1]


def check_sampling(imu: ImuData, noise: ImuNoise, frames: list[IntArray]) -> list[Finding]:
    """Findings about rate, gaps and overlap with the frames."""
    stamps = np.concatenate(frames) if frames else np.zeros(0, np.int64)
    if len(imu) < 10:
        return [Finding("imu_missing", "error", f"{len(imu)} IMU samples", "record an IMU")]
    found = []
    inside = (stamps >= imu.stamps_ns[0]) & (stamps <= imu.stamps_ns[-1])
    if len(stamps) and np.mean(inside) < _COVERED:
        apart = (int(stamps[0]) - int(imu.stamps_ns[0])) * 1e-9
        what = (
            f"the IMU covers {np.mean(inside):.0%} of the frames; they begin {apart:.3f} s after it"
        )
        fix = "bring both to one clock: correct the stamps, or timeshift_cam_imu in the calibration"
        severity = graded(np.mean(inside) < 0.5)
        found.append(Finding("clocks_apart", severity, what, fix))
    steps = np.diff(imu.stamps_ns).astype(np.float64)
    period = float(np.median(steps))
    rate = 1e9 / period
    found += _rate(rate, noise) + _gaps(steps, period)
    return found


def _rate(rate: float, noise: ImuNoise) -> list[Finding]:
    values = {"rate_hz": rate}
    if abs(rate / noise.rate_hz - 1.0) <= _RATE_TOLERANCE:
        return [Finding("imu_rate", "info", f"the IMU runs at {rate:.1f} Hz", values=values)]
    what = f"the IMU runs at {rate:.1f} Hz, the calibration says {noise.rate_hz:.1f} Hz"
    fix = f"update_rate: {rate:.1f} (Kalibr) or rate_hz: {rate:.1f} (EuRoC) of the IMU"
    return [Finding("imu_rate", "warning", what, fix, values=values)]


def _gaps(steps: FloatArray, period: float) -> list[Finding]:
    found = []
    gaps = steps > _GAP_PERIODS * period
    if np.any(gaps):
        lost = float(np.sum(steps[gaps]) / np.sum(steps))
        count, longest_s = int(np.sum(gaps)), 1e-9 * float(steps.max())
        what = f"{count} gap{'s' * (count > 1)} of the IMU, the longest {longest_s:.3f} s"
        fix = "look for lost messages; backend.noise.max_imu_gap_s says what is bridged"
        found.append(Finding("imu_gaps", "warning" if lost > _LOST else "info", what, fix))
    jitter = float(np.sqrt(np.mean((steps[~gaps] - period) ** 2)) / period)
    if jitter > _JITTER:
        what = f"the stamps of the IMU scatter by {jitter:.0%} of the period"
        fix = "use the sensor's own stamps, and not those of arrival"
        found.append(Finding("imu_jitter", "warning", what, fix, values={"jitter": jitter}))
    return found
