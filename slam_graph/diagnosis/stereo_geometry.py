# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Do the calibrations of the first two cameras fit one another, by the points that both see?"""

from __future__ import annotations

from dataclasses import replace

import cv2
import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, median, skew
from slam_graph.diagnosis.finding import Finding
from slam_graph.diagnosis.stereo_matching import StereoMatches
from slam_graph.sensors import Camera, Rig

_FEWEST, _MOST = 60, 1500
"""Matches that are needed, and that are used."""
_RANSAC_PX, _CONFIDENCE = 1.0, 0.9999
_WORSE, _WORSE_PX = 2.0, 0.8
"""A calibration is wrong if its epipolar distances are so many times those of the best geometry,
and so much larger."""
_FITS_PX = 2.5
"""No cause is named that leaves larger epipolar distances than this."""
_SIMPLER = 1.3
"""A factor on both focal lengths is likelier than another pose, with five unknowns, up to so many
times its epipolar distances."""
_AHEAD = 0.75
"""At least so many of the near points must be in front of both cameras."""
_NEAR_PX = 3.0
"""Near points have at least this parallax."""
_BASELINES_M = (0.004, 4.0)
"""Shortest and longest baseline that is plausible."""
_FOCAL_STEP = 0.02
"""Least change of a focal length that is named."""
_FOCAL_STEPS = np.linspace(0.7, 1.45, 76)


class StereoPair:
    """Matches of two cameras, over all frames at once."""

    def __init__(self, matches: list[StereoMatches], rig: Rig) -> None:
        """Pool the matches, thinned to a bounded number."""
        first = np.concatenate([m.first for m in matches] or [np.zeros((0, 2))])
        second = np.concatenate([m.second for m in matches] or [np.zeros((0, 2))])
        step = max(1, -(-len(first) // _MOST))
        self.first, self.second = first[::step], second[::step]
        self._rig = rig

    @property
    def enough(self) -> bool:
        """Whether there are enough matches to judge."""
        return len(self.first) >= _FEWEST

    def _rays(
        self, focal: float, exchanged: bool, both: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Unit bearings (N, 3) in both cameras, with a factor on focal lengths: see `judged`."""
        one, two = (mounted.camera for mounted in self._rig.cameras[:2])
        if exchanged:
            one, two = two, one
        two = replace(two, fx=two.fx * focal, fy=two.fy * focal)
        if both:
            one = replace(one, fx=one.fx * focal, fy=one.fy * focal)
        return _bearings(one, self.first), _bearings(two, self.second)

    def judged(
        self,
        second_T_first: gtsam.Pose3,
        focal: float = 1.0,
        exchanged: bool = False,
        both: bool = False,
    ) -> tuple[float, float]:
        """Median epipolar distance in pixels, and share of near points in front of both cameras.

        Args:
            second_T_first: the relative pose; its length does not matter.
            focal: factor on the focal length of the second camera.
            exchanged: whether each camera has the lens of the other.
            both: whether the factor is on the focal length of the first one, too.
        """
        a, b = self._rays(focal, exchanged, both)
        R, t = second_T_first.rotation().matrix(), np.asarray(second_T_first.translation())
        length = float(np.linalg.norm(t))
        if length == 0.0:
            return np.inf, 0.0
        t = t / length
        turned = a @ R.T
        e = np.abs(np.einsum("ni,ij,nj->n", b, skew(t[None])[0], turned))
        along = (turned @ t) ** 2 + (b @ t) ** 2
        focal_px = self._rig.cameras[0].camera.fx
        distance = float(median(e / np.sqrt(np.maximum(2.0 - along, 0.02)))) * focal_px
        distance *= np.sqrt(2.0)
        # depths d with d_a R a + t = d_b b
        parallax = np.linalg.norm(np.cross(turned, b), axis=1)
        near = parallax * focal_px > _NEAR_PX
        if not np.any(near):
            return distance, 1.0
        turned, b = turned[near], b[near]
        normal = np.cross(turned, b)
        square = np.sum(normal**2, axis=1)
        depth_a = np.einsum("ni,ni->n", np.cross(b, np.broadcast_to(t, b.shape)), normal) / square
        depth_b = np.einsum("ni,ni->n", np.cross(turned, np.broadcast_to(t, b.shape)), normal)
        ahead = (depth_a > 0) & (depth_b / square > 0)
        return distance, float(np.mean(ahead))

    def fitted(self) -> gtsam.Pose3 | None:
        """The relative pose by the matches alone (Nistér 2004), with a baseline of length one."""
        a, b = self._rays(1.0, False)
        use = (a[:, 2] > 0.1) & (b[:, 2] > 0.1)
        one, two = a[use, :2] / a[use, 2:], b[use, :2] / b[use, 2:]
        tolerance = _RANSAC_PX / self._rig.cameras[0].camera.fx
        E, inlier = cv2.findEssentialMat(one, two, np.eye(3), cv2.RANSAC, _CONFIDENCE, tolerance)
        if E is None or E.shape != (3, 3):
            return None
        _, R, t, _ = cv2.recoverPose(E, one, two, np.eye(3), mask=inlier)
        return gtsam.Pose3(gtsam.Rot3(R), t.ravel())


def _bearings(camera: Camera, pixels: FloatArray) -> FloatArray:
    with np.errstate(all="ignore"):  # beyond a wide lens that is not the right one
        m = np.nan_to_num(camera.undistort(pixels), posinf=0.0, neginf=0.0)
    rays = np.column_stack([m, np.ones(len(m))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def check_stereo(matches: list[StereoMatches], rig: Rig) -> list[Finding]:
    """Findings about the first two cameras; nothing without enough matches.

    A finding of exchanged cameras has a value ``exchanged``: ``cameras`` or ``poses`` (`mended`).
    """
    if len(rig.cameras) < 2:
        return []
    pair = StereoPair(matches, rig)
    one, two = (mounted.body_T_camera for mounted in rig.cameras[:2])
    relative = two.between(one)
    baseline = float(np.linalg.norm(relative.translation()))
    found = []
    if not _BASELINES_M[0] < baseline < _BASELINES_M[1]:
        found.append(
            Finding(
                "baseline_unit",
                "error",
                f"the first two cameras are {baseline:.4g} m apart",
                "give translations of T_cn_cnm1 and T_cam_imu in metres",
                values={"baseline_m": baseline},
            )
        )
    if not pair.enough:
        text = f"{len(pair.first)} matches between the cameras: their calibration is not checked"
        return [*found, Finding("stereo_unchecked", "info", text)]
    distance_px, ahead = pair.judged(relative)
    best = pair.fitted()
    best_px = np.inf if best is None else pair.judged(best)[0]
    values = {"epipolar_px": distance_px, "best_px": best_px, "ahead": ahead}
    if ahead >= _AHEAD and not _worse(distance_px, best_px):
        text = f"matches between the cameras are {distance_px:.2f} px from their epipolar lines"
        return [*found, Finding("stereo", "info", text, values=values)]
    bad = f"matches between the cameras are {distance_px:.2f} px from their epipolar lines"
    if ahead < _AHEAD:
        bad = f"{bad}, and {1 - ahead:.0%} of the near points would be behind a camera"
    what, fix, exchanged = _cause(pair, one, two, best, best_px)
    told = {**values, "exchanged": exchanged}
    return [*found, Finding("stereo_geometry", "error", f"{what}: {bad}", fix, values=told)]


def mended(rig: Rig, finding: Finding) -> Rig | None:
    """The rig with the first two cameras as they were before they were exchanged.

    Returns:
        None if the finding is not of exchanged cameras.
    """
    one, two = rig.cameras[:2]
    exchanged = finding.values.get("exchanged")
    if exchanged == "cameras":
        return replace(rig, cameras=(two, one, *rig.cameras[2:]))
    if exchanged == "poses":
        first = replace(one, body_T_camera=two.body_T_camera)
        second = replace(two, body_T_camera=one.body_T_camera)
        return replace(rig, cameras=(first, second, *rig.cameras[2:]))
    return None


def _worse(distance_px: float, best_px: float) -> bool:
    return distance_px > max(_WORSE * best_px, best_px + _WORSE_PX)


def _cause(
    pair: StereoPair,
    one: gtsam.Pose3,
    two: gtsam.Pose3,
    best: gtsam.Pose3 | None,
    best_px: float,
) -> tuple[str, str, str]:
    """What explains the matches, the line to change, and what is exchanged, if anything is."""
    named = (
        (
            "the cameras are exchanged, images and intrinsics",
            "exchange cam0 and cam1 in the calibration, or their topics or folders",
            one.between(two),
            "cameras",
        ),
        (
            "the poses of the cameras are exchanged",
            "exchange T_cam_imu (T_BS) of cam0 and cam1, or invert T_cn_cnm1",
            one.between(two),
            "poses",
        ),
        (
            "the pose of cam1 is inverted",
            "invert T_cam_imu (T_BS) of cam1",
            two.inverse().between(one),
            "",
        ),
        (
            "the pose of cam0 is inverted",
            "invert T_cam_imu (T_BS) of cam0",
            two.between(one.inverse()),
            "",
        ),
        (
            "the poses of both cameras are inverted",
            "invert T_cam_imu (T_BS) of all cameras",
            two.inverse().between(one.inverse()),
            "",
        ),
    )
    fits = []
    for what, fix, relative, exchanged in named:
        distance, ahead = pair.judged(relative, exchanged=exchanged == "cameras")
        if ahead >= _AHEAD and distance < _FITS_PX and not _worse(distance, best_px):
            fits.append((distance, what, fix, exchanged))
    if fits:
        return min(fits)[1:]
    relative = two.between(one)
    factor, distance = _focal_factor(pair, relative, both=False)
    common, common_px = _focal_factor(pair, relative, both=True)
    fitting = common_px < min(distance, _SIMPLER * best_px, _FITS_PX)
    if fitting and abs(common - 1.0) > _FOCAL_STEP:
        what = f"the focal lengths of both cameras are {1 / common:.2f} times what fits their poses"
        return (
            what,
            f"multiply fx and fy of both by {common:.2f}, or calibrate the lenses again",
            "",
        )
    fitting = distance < _FITS_PX and not _worse(distance, best_px)
    if fitting and abs(factor - 1.0) > _FOCAL_STEP:
        what = f"the focal length of cam1 is {1 / factor:.2f} times what fits cam0"
        return what, f"multiply fx and fy of cam1 by {factor:.2f}, or calibrate the lens again", ""
    if best is None or best_px > _FITS_PX:
        what = "no pose between the cameras fits the matches, so that a lens is wrong"
        return what, "calibrate the cameras again, lenses first", ""
    turn = (best.rotation().inverse() * relative.rotation()).matrix()
    degrees = np.rad2deg(Rotation.from_matrix(turn).magnitude())
    b, length = best.matrix().copy(), float(np.linalg.norm(relative.translation()))
    b[:3, 3] *= length
    rows = np.array2string(b[:3], precision=4, separator=", ", suppress_small=True)
    return (
        f"the pose between the cameras is off by {degrees:.1f}°",
        f"calibrate again, or try T_cn_cnm1 of cam1: {' '.join(rows.split())}",
        "",
    )


def _focal_factor(pair: StereoPair, relative: gtsam.Pose3, both: bool) -> tuple[float, float]:
    """The factor on the focal length of the second camera or of both that fits best, and how well.

    Returns:
        The factor, and the median epipolar distance with it, px.
    """
    distances = [pair.judged(relative, float(k), both=both)[0] for k in _FOCAL_STEPS]
    k = int(np.argmin(distances))
    return float(_FOCAL_STEPS[k]), distances[k]
