# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Findings about the accelerometer's axes and sign and the baseline, from windows of motion."""

from __future__ import annotations

from dataclasses import replace
from statistics import median_low

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.diagnosis.finding import Finding, graded, sureness
from slam_graph.diagnosis.fit_findings import CameraAndGyroscope
from slam_graph.diagnosis.motion_window import Window, WindowSolution
from slam_graph.diagnosis.mountings import axes_text, signed_permutations
from slam_graph.diagnosis.rotation_fit import RotationFit
from slam_graph.sensors import FeatureFrame, Rig

_SPACING_S = 0.14
_WINDOW_S, _WINDOWS = 3.0, 6
"""Length of the windows that show axes, and most of them: those with the liveliest motion."""
_SHORT_S, _SHORT_WINDOWS = 1.5, 16
"""The same of those that show the baseline: rotations are of the gyroscope alone, whose errors grow
with time, and bend the scale of a window of 3 s by a tenth."""
_FEWEST_FEATURES = 10
_LEAST_VARIATION = 0.25
"""Standard deviation of the specific force in the world, m/s², of a window that shows something."""
_QUICK = 3
"""Windows by which all axes are compared at first."""
_LEFT = 16
"""So many of them are left after the first window; the best four of all were within nine there."""
_COMPARED = 4
"""So many of the best axes are compared by a full solution."""
_CLEARER = 1.12
"""Residuals with the axes as they are must be so many times those with others …"""
_BEHIND = 0.2
"""… or at most such a share of the observations in front of the camera."""
_FITS_PX = 4.0
"""Axes with larger residuals are not believed: something else is wrong, such as features that move.
"""
_BASELINE, _WRONG_BASELINE, _BAD_BASELINE = 0.12, 0.16, 0.3
"""Logarithms of wrong baselines that are a warning, an error if it is certain, and an error."""
_BASELINE_SIGMAS = 6.0
_FEWEST_WINDOWS = 3
_ROBUST_WINDOWS = 5
"""Of fewer windows two may agree by chance, and then the median deviation is much too small: their
standard deviation counts."""
_LEAST_SIGMA = 0.025
"""No window knows the baseline better."""
_UNSURE = 0.15
"""A window that knows the baseline less well is left out."""


def check_motion(
    now: CameraAndGyroscope, fit: RotationFit, stereo: bool, axes_known: bool = False
) -> list[Finding]:
    """The findings.

    Args:
        now: what camera and gyroscope say, with the rig corrected.
        fit: of both.
        stereo: whether the second camera is to be used.
        axes_known: whether the accelerometer's axes are not looked at.
    """
    rig = now.rig if stereo else now.rig.select(1)
    windows = _windows(now, fit, rig, _SHORT_S)[:_SHORT_WINDOWS]
    axes, found = np.eye(3), list[Finding]()
    if not axes_known:
        # features of one camera alone: those of two are triangulated with any axes
        long = _windows(now, fit, now.rig.select(1), _WINDOW_S)[:_WINDOWS]
        axes, found = _axes(long) if long else (axes, found)
    if not windows:
        text = "too little motion to check the accelerometer's axes and the scale"
        return [*found, Finding("moves_too_little", "info", text, "record livelier motion")]
    if len(rig.cameras) < 2:
        return found
    solutions = [s for window in windows if (s := window.solve(axes)) is not None]
    return found + _baseline(solutions, rig)


def _windows(now: CameraAndGyroscope, fit: RotationFit, rig: Rig, length_s: float) -> list[Window]:
    """Windows that show something, the liveliest first."""
    found: list[Window] = []
    for part, gyroscope in zip(now.parts, now.gyroscopes, strict=True):
        frames = [_seen(f, rig) for f in _thinned([f for f in part.frames if f.cameras])]
        end_s = gyroscope.t[-1] - abs(fit.values.offset_s) - 0.05
        frames = [f for f in frames if gyroscope.seconds(np.array(f.stamp_ns)) < end_s]
        count = round(length_s / _SPACING_S)
        for k in range(0, len(frames) - count + 1, count):
            window = Window(frames[k : k + count], gyroscope, rig, fit.values)
            if window.features >= _FEWEST_FEATURES and window.variation > _LEAST_VARIATION:
                found.append(window)
    return sorted(found, key=lambda w: -w.variation)


def _seen(frame: FeatureFrame, rig: Rig) -> FeatureFrame:
    """A frame with its points normalised by the rig, which may have been corrected."""
    cameras = [
        replace(seen, normalized=mounted.camera.undistort(seen.pixels))
        for seen, mounted in zip(frame.cameras, rig.cameras, strict=False)
    ]
    return FeatureFrame(frame.stamp_ns, tuple(cameras))


def _thinned(frames: list[FeatureFrame]) -> list[FeatureFrame]:
    """Frames that are about `_SPACING_S` apart."""
    kept: list[FeatureFrame] = []
    for frame in frames:
        if not kept or frame.stamp_ns - kept[-1].stamp_ns >= 0.95e9 * _SPACING_S:
            kept.append(frame)
    return kept


def _axes(windows: list[Window]) -> tuple[FloatArray, list[Finding]]:
    """How the accelerometer's axes should be read (3, 3), and a finding if not as they are."""
    nominal = [window.solve(np.eye(3)) for window in windows]
    candidates = [P for handed in (1, -1) for P in signed_permutations(handed)]
    best = _likeliest(windows[:_QUICK], candidates)
    solved = {k: [window.solve(candidates[k]) for window in windows] for k in best if k > 0}
    solved |= {0: nominal} if 0 in best else {}  # the plainest
    k = min(best, key=lambda k: _score_of(solved[k]))
    P, score, usual = candidates[k], _score_of(solved[k]), _score_of(nominal)
    # wrong axes spoil every window; a single one may end in a wrong minimum under right ones,
    # which is why it is but a hint
    better = median_low((_sizes_px(nominal) / _sizes_px(solved[k])).tolist())
    unclear = min(better, usual / score) < _CLEARER or score > _FITS_PX
    if np.allclose(P, np.eye(3)) or unclear:
        return np.eye(3), []
    values = {"axes": axes_text(P), "residual_px": score, "residual_as_it_is_px": usual}
    found = "accelerometer_axes"
    if np.allclose(P, -np.eye(3)):
        found, what = "accelerometer_sign", "the accelerometer has the opposite sign"
        fix = "negate the accelerations: at rest they must point up, +9.81"
    else:
        what = f"the accelerometer's axes should be read as {axes_text(P)}"
        fix = f"write the accelerations (x, y, z) as {axes_text(P)}"
    what = f"{what}: features are off by {usual:.2f} px in the mean, and then by {score:.2f} px"
    sigmas = float((usual / score - 1.0) * np.sqrt(100.0 * len(windows)))
    finding = Finding.measured(found, "error", what, fix, sigmas, values)
    return P, [finding if len(windows) > 1 else replace(finding, sure="hint")]


def _likeliest(windows: list[Window], candidates: list[FloatArray]) -> list[int]:
    """Numbers of the axes (3, 3) that fit best by linear solutions, the best first.

    The first window leaves a few of them to be compared by the others.
    """
    solved: dict[int, list[WindowSolution | None]] = {k: [] for k in range(len(candidates))}
    for window in windows:
        for k, solutions in solved.items():
            solutions.append(window.solve(candidates[k], 0))
        ordered = sorted(solved, key=lambda k: _score_of(solved[k]))
        solved = {k: solved[k] for k in ordered[:_LEFT]}
    return list(solved)[:_COMPARED]


def _score_of(solutions: list[WindowSolution | None]) -> float:
    """Geometric mean of the residuals in pixels."""
    return float(np.exp(np.mean(np.log(_sizes_px(solutions)))))


def _sizes_px(solutions: list[WindowSolution | None]) -> FloatArray:
    """Residuals (W,) of windows in pixels; what is behind the camera is far off."""
    sizes = [
        100.0 if s is None or s.ahead < 1 - _BEHIND else min(s.residual_px, 100.0)
        for s in solutions
    ]
    return np.array(sizes)


def _baseline(solutions: list[WindowSolution], rig: Rig) -> list[Finding]:
    """A finding if the accelerometer says another baseline."""
    factors = [
        (s.baseline, max(s.baseline_sigma / s.baseline, _LEAST_SIGMA))
        for s in solutions
        if s.baseline > 0.0 and s.baseline_sigma < _UNSURE * s.baseline
    ]
    if len(factors) < _FEWEST_WINDOWS:
        return []
    logs = np.log([f for f, _ in factors])
    factor = float(np.exp(np.median(logs)))
    spread = 1.4826 * float(np.median(np.abs(logs - np.median(logs))))
    if len(logs) < _ROBUST_WINDOWS:
        spread = max(spread, float(np.std(logs, ddof=1)))
    known = float(np.median([sigma for _, sigma in factors]))
    sigma = max(spread, known) * 1.25 / np.sqrt(len(factors))
    one, two = (mounted.body_T_camera for mounted in rig.cameras[:2])
    length = float(np.linalg.norm(two.between(one).translation()))
    values = {"factor": 1.0 / factor, "baseline_m": length * factor, "sigma": sigma}
    change = abs(float(np.log(factor)))
    if change < max(_BASELINE, _BASELINE_SIGMAS * sigma):
        text = f"the accelerometer agrees with the baseline of {length:.4f} m to {change:.0%}"
        return [Finding("scale", "info", text, values=values)]
    what = (
        f"the calibrated baseline is {1.0 / factor:.2f} ± {sigma / factor:.2f} times the one that "
        "fits the accelerometer"
    )
    fix = (
        f"a baseline of {length * factor:.4f} m: multiply the translation of T_cn_cnm1 of cam1 by "
        f"{factor:.3f}"
    )
    certain = sureness(change / sigma) == "certain"
    severity = graded(change > (_WRONG_BASELINE if certain else _BAD_BASELINE))
    return [Finding.measured("baseline", severity, what, fix, change / sigma, values)]
