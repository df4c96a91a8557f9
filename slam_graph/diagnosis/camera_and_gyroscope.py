# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What camera and gyroscope say of one another, step by step: unit, axes, mounting, and the rest.

Each step corrects what it has found, so that the next one sees only its own faults.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.diagnosis.constant_sensors import (
    anything_constant,
    check_accelerometer,
    check_gyroscope,
)
from slam_graph.diagnosis.finding import Finding
from slam_graph.diagnosis.fit_findings import (
    TURNED_RAD,
    CameraAndGyroscope,
    judge,
    judge_scale,
    replace_imu,
    scaled_lenses,
)
from slam_graph.diagnosis.frame_pairs import FramePair, frame_pairs
from slam_graph.diagnosis.gathering import Part
from slam_graph.diagnosis.gyroscope import Gyroscope
from slam_graph.diagnosis.kinematics import Kinematics
from slam_graph.diagnosis.mountings import axes_text, explained
from slam_graph.diagnosis.rotation_fit import RotationFit, RotationProblem
from slam_graph.diagnosis.turning import Turning, coarse_turning
from slam_graph.sensors import Rig, RigCamera

_SAME_RATE = (0.55, 1.8)
"""Camera and gyroscope turn equally fast within these; focal lengths may be wrong, too."""
_DEGREES = 57.29578
_RATE_UNITS = {
    "degrees/s": _DEGREES,
    "mrad/s": 1e3,
    "revolutions/min": 30.0 / np.pi,
    "rad/s where degrees/s were expected": 1 / _DEGREES,
}
_UNIT_RATIO = 1.5
"""A factor on the rate is of a unit if it is so near."""
_BETTER = 2.0
"""Another mounting or handedness must have a misfit smaller by this factor …"""
_FITS, _NOTHING_FITS = 0.3, 0.5
"""… and below this to be taken; beyond this nothing fits."""
_EXPLAINED = 0.2
"""Something fits all the same if it leaves so small a part of the calibration's epipolar distances:
rotations from two views are bad where the lens is wrong and the camera turns little."""
FEWEST_PAIRS = 10
CLEARLY = 1.05
"""The noise of one fit is clearly larger than that of another by this factor."""
_LENSES = (1.0, 1.2, 1.45)
"""Factors on the focal length with which turns of the camera are looked for."""
_FOCAL_STARTS = np.geomspace(0.7, 1.45, 9)
"""Factors on the focal length with which a fit is compared, as it may be in a wrong minimum."""
_SAME_MINIMUM = 0.06
"""Logarithms of focal lengths that are so near lead to the same minimum."""
_CLEARLY_BETTER = 0.9
"""Noise of another minimum as a part of that of the first one, if it is taken."""


def compare(rig: Rig, parts: list[Part]) -> CameraAndGyroscope:
    """Compare the first camera with the gyroscope.

    Args:
        rig: the calibration.
        parts: with features of the first camera and at least two IMU samples each.
    """
    now = CameraAndGyroscope(rig, parts, [Gyroscope(part.imu) for part in parts])
    camera = rig.cameras[0]
    pairs, turning = _by_some_lens(now)
    R = camera.body_T_camera.rotation().matrix()
    found = check_gyroscope(now.parts, pairs, R) if turning is not None else []
    found += check_accelerometer(now.parts, now.gyroscopes, turning is not None)
    now.findings += found
    if any(finding.kind == "gyroscope_constant" for finding in found):
        return now
    if turning is None or len(pairs) < FEWEST_PAIRS:
        text = "the camera turns too little to check clock, mounting and focal length"
        now.findings.append(Finding("turns_too_little", "info", text, "record livelier motion"))
        return now
    turning = _unit(now, pairs, turning)
    turning = _handedness(now, pairs, turning)
    start = _coarse_mounting(now, turning)
    problem = RotationProblem(pairs, now.gyroscopes, camera)
    now.fit = _solved(problem, start)
    alike = turning.misfit <= _NOTHING_FITS
    if now.fit is not None and camera.rotation_known:
        alike = alike or _explains(now.fit, problem, _calibrated(camera))
    if now.fit is None or not alike:
        now.fit = None
        what = "camera and gyroscope do not turn alike under any mounting"
        fix = "compare the clocks (more than 0.2 s?); mask moving objects; check the matches"
        now.findings.append(Finding("not_alike", "warning", what, fix, "likely"))
        return now
    if not _calibration_is_better(problem, _calibrated(camera), now.fit):
        judge_scale(now, problem, now.fit)
        judge(now, now.fit)
    return now


def refine(rig: Rig, parts: list[Part]) -> CameraAndGyroscope:
    """The same for a calibration that is right or nearly so: a tenth of the time.

    Unit and axes of the gyroscope are taken as they are, and the fit starts as calibrated.
    """
    if anything_constant(parts):
        return compare(rig, parts)
    now = CameraAndGyroscope(rig, parts, [Gyroscope(part.imu) for part in parts])
    camera = rig.cameras[0]
    pairs = frame_pairs(now.parts, now.gyroscopes, camera, turns=False)
    if len(pairs) < FEWEST_PAIRS:
        return now
    start = _calibrated(camera)
    problem = RotationProblem(pairs, now.gyroscopes, camera)
    if not np.isfinite(problem.noise_px(start)):  # most features are beyond the edge of the lens
        return compare(rig, parts)
    try:
        now.fit = problem.solve(start)
    except np.linalg.LinAlgError:
        return now
    if not (_shows_faults(now, now.fit) and _calibration_is_better(problem, start, now.fit)):
        judge(now, now.fit)
    return now


def _shows_faults(now: CameraAndGyroscope, fit: RotationFit) -> bool:
    """Whether a fit shows anything wrong; only then the calibration is compared with it."""
    tried = replace(now, findings=[])
    judge(tried, fit)
    return any(finding.severity != "info" for finding in tried.findings)


def _explains(fit: RotationFit, problem: RotationProblem, calibrated: Kinematics) -> bool:
    """Whether a fit leaves but a small part of the epipolar distances of the calibration."""
    return fit.noise_px < _EXPLAINED * problem.noise_px(calibrated)


def _calibration_is_better(problem: RotationProblem, start: Kinematics, fit: RotationFit) -> bool:
    """Whether the features fit the calibration as it is better than what was found.

    Gauss-Newton minimises weighted squares, and a few pairs that hardly move can lead it away, to
    where its covariance means nothing. So the calibration, with a bias alone, counts as right where
    most features fit it clearly better, or all of them together no worse.
    """
    calibrated, at = problem.noise_px(start), start
    if calibrated * CLEARLY > fit.noise_px:
        with suppress(np.linalg.LinAlgError):
            bias = problem.solve(start, ("bx", "by", "bz"))
            if bias.noise_px < calibrated:
                calibrated, at = bias.noise_px, bias.values
    if calibrated * CLEARLY < fit.noise_px:
        return True
    misfits = [problem.misfit(values, fit.noise_px) for values in (at, fit.values)]
    return misfits[0] <= misfits[1]


def _by_some_lens(now: CameraAndGyroscope) -> tuple[list[FramePair], Turning | None]:
    """Pairs of frames, and how the camera turns by the calibrated lens or a longer one.

    By one that is far too short many features of a wide lens are beyond its edge.
    """
    for factor in _LENSES:
        camera = scaled_lenses(now.rig, factor).cameras[0]
        pairs = frame_pairs(now.parts, now.gyroscopes, camera)
        turning = _turning(now, pairs)
        if turning is not None or len(pairs) < FEWEST_PAIRS or _sees_all(camera, pairs):
            break
    return pairs, turning


def _sees_all(camera: RigCamera, pairs: list[FramePair]) -> bool:
    """Whether no feature is beyond the edge of a lens."""
    return bool(np.all(camera.camera.visible(np.vstack([pair.first for pair in pairs]))[1]))


def _turning(now: CameraAndGyroscope, pairs: list[FramePair]) -> Turning | None:
    camera = now.rig.cameras[0]
    R = camera.body_T_camera.rotation().matrix()
    return coarse_turning(pairs, now.gyroscopes, R, camera.clock_offset_s)


def _unit(now: CameraAndGyroscope, pairs: list[FramePair], turning: Turning) -> Turning:
    """Correct the unit of the gyroscope."""
    factor = turning.factor
    same = _SAME_RATE[0] < factor < _SAME_RATE[1]
    if same or factor <= 0.0 or turning.misfit > _FITS:
        return turning
    what = f"the gyroscope turns {factor:.3g} times as fast as the camera"
    fix, named = f"divide the angular rates by {factor:.4g} to have rad/s", ""
    for unit, ratio in _RATE_UNITS.items():
        if 1 / _UNIT_RATIO < factor / ratio < _UNIT_RATIO:
            what, fix = (
                f"{what}: its unit is {unit}",
                f"multiply the angular rates by {1 / ratio:g}",
            )
            factor, named = ratio, unit
    values = {"factor": turning.factor, "unit": named}
    sigmas = 1.0 / max(turning.misfit, 1e-3) * np.sqrt(len(pairs))
    now.findings.append(Finding.measured("gyroscope_unit", "error", what, fix, sigmas, values))
    replace_imu(now, np.eye(3) / factor)
    return _turning(now, pairs) or turning


def _handedness(now: CameraAndGyroscope, pairs: list[FramePair], turning: Turning) -> Turning:
    """Correct a gyroscope that turns the other way round."""
    mirrored = np.linalg.det(turning.Q) < 0
    clear = _BETTER * turning.misfit < min(turning.misfit_other, turning.misfit_calibrated)
    if not mirrored or not clear or turning.misfit > _FITS:
        return turning
    found = explained(turning.Q, now.rig.cameras[0].body_T_camera.rotation().matrix())
    what = f"the gyroscope is left-handed: its axes should be read as {axes_text(found.axes)}"
    fix = f"write the angular rates (x, y, z) as {axes_text(found.axes)}"
    sigmas = turning.misfit_other / max(turning.misfit, 1e-3) * np.sqrt(len(pairs))
    values = {"axes": axes_text(found.axes), "misfit": turning.misfit}
    now.findings.append(Finding.measured("gyroscope_axes", "error", what, fix, sigmas, values))
    replace_imu(now, found.axes)
    return _turning(now, pairs) or turning


def _coarse_mounting(now: CameraAndGyroscope, turning: Turning) -> Kinematics:
    """Where the fit starts: at the calibrated mounting, unless another one is clearly better."""
    camera = now.rig.cameras[0]
    R, offset_s = camera.body_T_camera.rotation().matrix(), camera.clock_offset_s
    Q = turning.Q
    if np.linalg.det(Q) > 0:
        away = Rotation.from_matrix(R.T @ Q).magnitude()
        if away > TURNED_RAD and _BETTER * turning.misfit < turning.misfit_calibrated:
            R = Q
    if abs(turning.offset_s - offset_s) > 0.02:
        offset_s = turning.offset_s
    return Kinematics(offset_s, 1.0, camera.readout_s, R, np.zeros(3))


def _calibrated(camera: RigCamera) -> Kinematics:
    """What the calibration says."""
    R = camera.body_T_camera.rotation().matrix()
    return Kinematics(camera.clock_offset_s, 1.0, camera.readout_s, R, np.zeros(3))


def _solved(problem: RotationProblem, start: Kinematics) -> RotationFit | None:
    """The best fit, also from the focal length that fits the start best.

    The tracks of a few seconds may fit a wrong focal length well, with a turn of the camera that
    makes up for it.
    """
    best: RotationFit | None = None
    with suppress(np.linalg.LinAlgError):
        best = problem.solve(start)
    others = [replace(start, focal=float(focal)) for focal in _FOCAL_STARTS]
    other = min(others, key=problem.noise_px)
    if best is not None and abs(np.log(other.focal / best.values.focal)) < _SAME_MINIMUM:
        return best
    with suppress(np.linalg.LinAlgError):
        fit = problem.solve(other)
        if best is None or fit.noise_px < _CLEARLY_BETTER * best.noise_px:
            best = fit
    return best
