# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Findings of the fit of camera and gyroscope: clock, mounting, focal length, readout, scale."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.diagnosis.finding import Finding, graded
from slam_graph.diagnosis.gathering import Part
from slam_graph.diagnosis.gyroscope import Gyroscope
from slam_graph.diagnosis.mountings import Explanation, axes_text, explained
from slam_graph.diagnosis.rotation_fit import WITH_SCALE, RotationFit, RotationProblem
from slam_graph.sensors import ImuData, Rig

TURNED_RAD = np.deg2rad(20.0)
"""A mounting that is farther off is looked for coarsely first."""
SIGMAS = 6.0
"""A difference is a finding from so many standard deviations on, and if it is larger than these,
which grow with the square of the noise in pixels above 1 px, as the bias by the noise does:"""
_OFFSET_S, BAD_OFFSET_S = 5e-3, 1.5e-2
_FOCAL, _BAD_FOCAL = 0.02, 0.025
_TURN_RAD, _BAD_TURN_RAD = np.deg2rad(1.2), np.deg2rad(1.5)
_READOUT_S = 8e-3
_SCALE, _BAD_SCALE = 0.02, 0.05
_KNOWN_OFFSET_S, _KNOWN_FOCAL = 1e-2, 0.05
"""Camera and gyroscope agree only if clocks and focal length are known so well."""
_KNOWN_TURN_RAD = np.deg2rad(5.0)
"""An unknown mounting counts as found if it is known so well."""
_LIKE_PRINCIPAL_POINT_RAD = np.deg2rad(5.0)
_LIKE_PRINCIPAL_POINT, _BAD_FIT_PX = 0.1, 1.5
"""A wrong principal point looks like a turn of the camera that is smaller than this, and like such
a change of the focal length; wrong distortion leaves residuals."""
_NAMED_RAD = np.deg2rad(4.0)
"""So near a named explanation must come to a mounting that was found."""
_NOT_JUDGED = "principal point and distortion are not judged, and wrong ones can look like this"


@dataclass(eq=False)
class CameraAndGyroscope:
    """The state of the comparison.

    Attributes:
        rig: with what was found so far corrected.
        parts: with the IMU corrected likewise.
        gyroscopes: of the parts.
        findings: so far.
        fit: of clock, mounting, focal length and bias; None if the camera turns too little.
        scale_sigma: standard deviation of the gyroscope's scale, if it was asked for: where it is
            large, nothing tells a factor on the focal length from one on the angular rates.
    """

    rig: Rig
    parts: list[Part]
    gyroscopes: list[Gyroscope]
    findings: list[Finding] = field(default_factory=list)
    fit: RotationFit | None = None
    scale_sigma: float = 0.0

    @property
    def has_constant_sensor(self) -> bool:
        """Whether gyroscope or accelerometer say nothing."""
        return any(finding.kind.endswith("_constant") for finding in self.findings)


def replace_imu(now: CameraAndGyroscope, gyro_map: FloatArray) -> None:
    """Map the angular rates of all parts by a matrix (3, 3)."""

    def mapped(imu: ImuData) -> ImuData:
        return ImuData(imu.stamps_ns, imu.gyro @ gyro_map.T, imu.accel)

    now.parts = [replace(part, imu=mapped(part.imu)) for part in now.parts]
    now.gyroscopes = [Gyroscope(part.imu) for part in now.parts]


def judge_scale(now: CameraAndGyroscope, problem: RotationProblem, fit: RotationFit) -> None:
    """Whether the gyroscope has another scale.

    For turns about the axes of the image a factor on the rates is like one on the focal length, and
    not for turns about the optical axis or at the edge of the image. What is found is corrected.
    """
    try:
        wider = problem.solve(fit.values, WITH_SCALE)
    except np.linalg.LinAlgError:
        return
    scale, sigma = wider.values.scale, float(wider.sigmas[WITH_SCALE.index("scale")])
    now.scale_sigma = sigma
    change = abs(float(np.log(scale)))
    if change < max(_SCALE * _noisier(wider), SIGMAS * sigma) or wider.noise_px > fit.noise_px:
        return
    coarse = _withdrawn_unit(now)  # where a wrong lens has made it of another unit at first
    now.fit = replace(
        wider, values=replace(wider.values, bias=wider.values.bias / scale, scale=1.0)
    )
    replace_imu(now, np.eye(3) / scale)
    scale *= coarse
    change = abs(float(np.log(scale)))
    if change < max(_SCALE * _noisier(wider), SIGMAS * sigma):
        return
    what = (
        f"the gyroscope turns {scale:.3f} ± {sigma:.3f} times as fast as the camera, about all "
        "axes: its scale is wrong"
    )
    fix = f"divide the angular rates by {scale:.4f}, and check the gyroscope's range setting"
    severity, values = graded(change > _BAD_SCALE), {"factor": scale, "sigma": sigma}
    now.findings.append(
        Finding.measured("gyroscope_scale", severity, what, fix, change / sigma, values)
    )


def _withdrawn_unit(now: CameraAndGyroscope) -> float:
    """The factor of a finding of a gyroscope's unit without a name, which is taken back; else 1."""
    for finding in now.findings:
        if finding.kind == "gyroscope_unit" and not finding.values["unit"]:
            now.findings.remove(finding)
            factor = finding.values["factor"]
            assert isinstance(factor, float)
            return factor
    return 1.0


def judge(now: CameraAndGyroscope, fit: RotationFit) -> None:
    """Findings of a fit; what is wrong is corrected in the rig."""
    sigma = dict(zip(WITH_SCALE, fit.sigmas.tolist(), strict=True))
    before = len(now.findings)
    _judge_mounting(now, fit)
    _judge_readout(now, fit, sigma["readout"])
    camera = now.rig.cameras[0]
    change_s = fit.values.offset_s - camera.clock_offset_s
    if abs(change_s) > max(_OFFSET_S * _noisier(fit), SIGMAS * sigma["offset"]):
        value = camera.time_offset_s + change_s
        shown = round(value, 4) + 0.0  # without a negative zero
        what = (
            f"the clocks of camera and IMU differ by {1e3 * shown:.1f} ± "
            f"{1e3 * sigma['offset']:.1f} ms, "
            f"and the calibration says {1e3 * camera.time_offset_s:.1f} ms"
        )
        fix = (
            f"timeshift_cam_imu: {shown:.4f} in the calibration, or "
            "--set backend.calibration.time_offset=true"
        )
        severity = graded(abs(change_s) > BAD_OFFSET_S)
        values = {"time_offset_s": value, "sigma_s": sigma["offset"]}
        now.findings.append(
            Finding.measured(
                "time_offset",
                severity,
                what,
                fix,
                abs(change_s) / sigma["offset"],
                values,
            )
        )
    _judge_focal(now, fit, sigma["focal"])
    if len(now.findings) == before:
        now.findings.append(_agreement(fit, change_s, sigma))


def _agreement(fit: RotationFit, change_s: float, sigma: dict[str, float]) -> Finding:
    """That nothing is wrong, or that too little is known to say so."""
    figures = (
        f"clocks differ by {round(1e3 * change_s, 1) + 0.0:.1f} ± {1e3 * sigma['offset']:.1f} ms, "
        f"the focal length by {fit.values.focal - 1:.1%} ± {sigma['focal']:.1%}; "
        f"epipolar distances are {fit.noise_px:.2f} px"
    )
    if sigma["offset"] < _KNOWN_OFFSET_S and sigma["focal"] < _KNOWN_FOCAL:
        text = f"camera and gyroscope agree: {figures}"
        turn = np.rad2deg(np.sqrt(np.linalg.eigvalsh(fit.covariance[3:6, 3:6])[-1]))
        values = {"focal_sigma": sigma["focal"], "turn_sigma_deg": float(turn)}
        return Finding("camera_and_gyroscope", "info", text, values=values)
    text = f"the camera turns too little to say whether it agrees with the gyroscope: {figures}"
    return Finding("turns_too_little", "info", text, "record livelier motion")


def _judge_mounting(now: CameraAndGyroscope, fit: RotationFit) -> None:
    """Whether the calibrated rotation is wrong; it is corrected then."""
    R = now.rig.cameras[0].body_T_camera.rotation().matrix()
    turn, covariance = fit.turn_from(R)
    if not now.rig.cameras[0].rotation_known:
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        now.findings.append(_found_mounting(fit.values.body_R_camera, sigma))
        if sigma < _KNOWN_TURN_RAD:
            now.rig = _turned(now.rig, fit.values.body_R_camera @ R.T)
        return
    away = float(np.linalg.norm(turn))
    sigmas = float(np.sqrt(turn @ np.linalg.solve(covariance, turn)))
    if away < _TURN_RAD * _noisier(fit) or sigmas < SIGMAS:
        return
    sigma = away / sigmas
    named = explained(fit.values.body_R_camera, R)
    if named.away_rad > max(_NAMED_RAD, 3 * sigma) or away < TURNED_RAD:
        named = Explanation("other", "", 0.0, np.eye(3))
    now.findings.append(_mounting_finding(named, fit.values.body_R_camera, away, sigma))
    now.rig = (
        _inverted(now.rig)
        if named.kind == "inverse"
        else _turned(now.rig, fit.values.body_R_camera @ R.T)
    )


def _turned(rig: Rig, R: FloatArray) -> Rig:
    """The rig with all cameras turned about the IMU by a rotation (3, 3)."""
    by = gtsam.Pose3(gtsam.Rot3(R), np.zeros(3))
    cameras = (replace(c, body_T_camera=by * c.body_T_camera) for c in rig.cameras)
    return replace(rig, cameras=tuple(cameras))


def _inverted(rig: Rig) -> Rig:
    """The rig with the mountings of all cameras the other way round."""
    cameras = (replace(c, body_T_camera=c.body_T_camera.inverse()) for c in rig.cameras)
    return replace(rig, cameras=tuple(cameras))


def _found_mounting(R: FloatArray, sigma: float) -> Finding:
    """The mounting R (3, 3) that was found where it is unknown, to sigma (rad); it is no fault."""
    degrees = np.rad2deg(sigma)
    if sigma >= _KNOWN_TURN_RAD:
        text = (
            f"the camera turns too little to find its mounting, which is unknown: ± {degrees:.0f}°"
        )
        return Finding("turns_too_little", "info", text, "record livelier motion")
    what = f"the mounting of the camera, which is unknown, is found to {degrees:.1f}°"
    fix = f"in the place of T_cam_imu: unknown, a T_cam_imu with the rotation {_rows(R)}"
    return Finding("mounting", "info", what, fix, values={"body_R_camera": R.tolist()})


def _rows(body_R_camera: FloatArray) -> str:
    """The rotation from IMU to camera in one line."""
    return " ".join(np.array2string(body_R_camera.T, precision=4, separator=", ").split())


def _mounting_finding(named: Explanation, R: FloatArray, away: float, sigma: float) -> Finding:
    degrees = np.rad2deg(away)
    values = {"degrees": degrees, "explanation": named.kind, "body_R_camera": R.tolist()}
    what = (
        f"the camera is turned by {degrees:.1f}° ± {np.rad2deg(sigma):.1f}° against its calibration"
    )
    fix = f"T_cam_imu: unknown in the calibration, or its rotation: {_rows(R)}"
    if named.kind == "inverse":
        what = f"{what}: {named.what}"
        fix = "give T_cam_imu (from IMU to camera) in a Kalibr file, T_BS (its inverse) in EuRoC's"
    elif named.kind == "axes":
        what = f"{what}: {named.what}"
        fix = f"write the IMU's (x, y, z) as {axes_text(named.axes)}, or {fix}"
    elif away < _LIKE_PRINCIPAL_POINT_RAD:
        fix = f"{fix}; {_NOT_JUDGED}"
    severity = graded(away > _BAD_TURN_RAD)
    return Finding.measured("mounting", severity, what, fix, away / sigma, values)


def _judge_readout(now: CameraAndGyroscope, fit: RotationFit, sigma: float) -> None:
    """Whether rows are exposed one after the other, and the calibration does not say so."""
    camera = now.rig.cameras[0]
    change = fit.values.readout_s - camera.readout_s
    if abs(change) < max(_READOUT_S * _noisier(fit), SIGMAS * sigma):
        return
    value = fit.values.readout_s
    what = (
        f"the shutter rolls: rows are read in {1e3 * value:.1f} ± {1e3 * sigma:.1f} ms, and the "
        f"calibration says {1e3 * camera.readout_s:.1f} ms"
    )
    fix = f"readout_time: {value:.4f} of the camera in the calibration"
    values = {"readout_s": value}
    now.findings.append(
        Finding.measured("rolling_shutter", "warning", what, fix, abs(change) / sigma, values)
    )
    cameras = tuple(replace(c, readout_s=value, rolling_shutter=True) for c in now.rig.cameras)
    now.rig = replace(now.rig, cameras=cameras)


def _judge_focal(now: CameraAndGyroscope, fit: RotationFit, sigma: float) -> None:
    """Whether the focal length is wrong; that of all cameras is corrected then."""
    factor = fit.values.focal
    change = abs(float(np.log(factor)))
    if not _is_magnified(fit):
        return
    camera = now.rig.cameras[0].camera
    what = (
        f"the calibrated focal length is {1 / factor:.3f} ± {sigma:.3f} times the one that fits "
        "the gyroscope"
    )
    fix = (
        f"fx: {camera.fx * factor:.1f}, fy: {camera.fy * factor:.1f} of cam0; "
        "or calibrate the lens again"
    )
    if change < SIGMAS * now.scale_sigma:
        what = f"{what}; or the gyroscope turns {1 / factor:.3f} times as fast as it should"
        fix = f"{fix}; or divide the angular rates by {1 / factor:.3f}"
    if fit.noise_px > _BAD_FIT_PX or change < _LIKE_PRINCIPAL_POINT:
        fix = f"{fix}; {_NOT_JUDGED}"
    severity = graded(change > _BAD_FOCAL)
    values = {"factor": 1 / factor, "fx": camera.fx * factor}
    now.findings.append(
        Finding.measured("focal_length", severity, what, fix, change / sigma, values)
    )
    now.rig = scaled_lenses(now.rig, factor)


def _is_magnified(fit: RotationFit) -> bool:
    change = abs(float(np.log(fit.values.focal)))
    sigma = float(fit.sigmas[WITH_SCALE.index("focal")])
    return change >= max(_FOCAL * _noisier(fit), SIGMAS * sigma)


def _noisier(fit: RotationFit) -> float:
    """A factor on what counts as a difference."""
    return max(1.0, fit.noise_px**2)


def scaled_lenses(rig: Rig, factor: float) -> Rig:
    """The rig with a factor on all focal lengths."""
    cameras = []
    for mounted in rig.cameras:
        lens = mounted.camera
        lens = replace(lens, fx=lens.fx * factor, fy=lens.fy * factor)
        cameras.append(replace(mounted, camera=lens))
    return replace(rig, cameras=tuple(cameras))
