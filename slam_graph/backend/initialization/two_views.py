# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The motion between two views of one camera, up to its length, and the points that both see.

An essential matrix and a homography are fitted by RANSAC, and the one that explains the features
better is taken apart, as in ORB-SLAM (Mur-Artal, Montiel & Tardós 2015, section IV). Of the motions
that it allows the one counts that has the points in front of both views. If two of them do, or the
rays to the points are parallel, the views do not tell the motion, and none is found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend.initialization.start_diagnosis import Refusal

MIN_POINTS = 20
"""Fewer features that both views see tell no motion."""
MIN_PARALLAX = np.radians(1.0)
"""Smallest median angle between the two rays to a point."""
_LINE, _POINT = 3.841, 5.991
"""95 % quantiles of χ² of one and two degrees of freedom: of distances from lines and points."""
_PLANE_SHARE = 0.45
"""The homography is taken if it has more than this share of the two scores."""
_MIN_GOOD = 0.75
"""Smallest part of the features that must fit the motion and be in front of both views."""
_RIVAL = 0.75
"""Another motion with more than this part of the good points makes the choice ambiguous."""
_CONFIDENCE = 0.999
_SINGULAR = 1e-9
"""Smallest determinant of a homography that can be inverted."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViews:
    """A motion between two views, and what they see.

    Attributes:
        first_T_second: of the camera; its translation has the length 1.
        points: (N, 3) of all features in the first view.
        good: (N,) which of them fit the motion, and are in front of both views.
        parallax: (N,) angles between the two rays, rad.
        model: what the motion was found by.
    """

    first_T_second: gtsam.Pose3
    points: FloatArray
    good: BoolArray
    parallax: FloatArray
    model: Literal["essential", "homography"]


def two_view_motion(first: FloatArray, second: FloatArray, sigma: float) -> TwoViews | Refusal:
    """The motion between two views of a camera, or what is missing for it.

    Args:
        first: (N, 2) where the first view sees the features, on its plane z = 1.
        second: (N, 2) where the second one does.
        sigma: standard deviation of these coordinates.
    """
    if len(first) < MIN_POINTS:
        return Refusal(
            "tracks", f"{MIN_POINTS} features that two views share ({len(first)} so far)"
        )
    shift = float(np.median(np.linalg.norm(second - first, axis=1)))
    if shift < np.tan(MIN_PARALLAX):
        return Refusal("motion", "motion of the camera (its features hardly move)")
    models = _Model.of_lines(first, second, sigma), _Model.of_plane(first, second, sigma)
    total = sum(model.score for model in models)
    if total == 0.0:
        return Refusal("fit", "features of two views that fit one motion")
    model = models[1] if models[1].score > _PLANE_SHARE * total else models[0]
    return _chosen([_seen(R, t, first, second, sigma) for R, t in model.motions()], model)


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """An essential matrix or a homography of two views.

    Attributes:
        name: which of them.
        matrix: (3, 3).
        score: how well it explains the features.
        fits: (N,) which features fit it.
    """

    name: Literal["essential", "homography"]
    matrix: FloatArray
    score: float
    fits: BoolArray

    @staticmethod
    def of_lines(first: FloatArray, second: FloatArray, sigma: float) -> _Model:
        """The essential matrix; its score is 0 if there is none."""
        reach = float(np.sqrt(_LINE)) * sigma
        found, _ = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, _CONFIDENCE, reach)
        if found is None or found.shape != (3, 3):
            return _Model("essential", np.eye(3), 0.0, np.zeros(len(first), np.bool_))
        E = np.asarray(found, dtype=np.float64)
        return _Model("essential", E, *_score(_line_errors(E, first, second) / sigma**2, _LINE))

    @staticmethod
    def of_plane(first: FloatArray, second: FloatArray, sigma: float) -> _Model:
        """The homography; its score is 0 if there is none."""
        found, _ = cv2.findHomography(first, second, cv2.RANSAC, float(np.sqrt(_POINT)) * sigma)
        if found is None or abs(np.linalg.det(np.asarray(found, np.float64))) < _SINGULAR:
            return _Model("homography", np.eye(3), 0.0, np.zeros(len(first), np.bool_))
        H = np.asarray(found, dtype=np.float64)
        return _Model("homography", H, *_score(_point_errors(H, first, second) / sigma**2, _POINT))

    def motions(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        """The motions second_T_first that it allows, four at most; translations of length 1."""
        if self.name == "essential":
            parts = cv2.decomposeEssentialMat(self.matrix)
            R_1, R_2, t = (np.asarray(part, np.float64) for part in parts)
            yield from ((R, sign * t[:, 0]) for R in (R_1, R_2) for sign in (1.0, -1.0))
            return
        _, rotations, translations, _ = cv2.decomposeHomographyMat(self.matrix, np.eye(3))
        for rotation, translation in zip(rotations, translations, strict=True):
            t = np.asarray(translation, np.float64)[:, 0]
            length = float(np.linalg.norm(t))
            if length > 0.0:
                yield np.asarray(rotation, np.float64), t / length


def _chosen(
    views: list[tuple[FloatArray, FloatArray, FloatArray, BoolArray, FloatArray]],
    model: _Model,
) -> TwoViews | Refusal:
    """The motion that has the features in front of both views, if it is one."""
    counts = [np.count_nonzero(good & model.fits) for *_, good, _ in views]
    order = np.argsort(counts)[::-1]
    if not len(order) or counts[order[0]] < MIN_POINTS:
        return Refusal("motion", "motion with parallax (a camera that only turns shows no depth)")
    R, t, points, good, parallax = views[order[0]]
    good = good & model.fits
    angle = float(np.median(parallax[good]))
    if angle < MIN_PARALLAX:
        needs = f"motion with parallax ({np.degrees(angle):.1f}° of {np.degrees(MIN_PARALLAX):.0f}°"
        return Refusal("motion", needs + "; a camera that only turns shows no depth)")
    if counts[order[0]] < _MIN_GOOD * np.count_nonzero(model.fits):
        return Refusal("fit", "features of two views that fit one motion")
    if len(order) > 1 and counts[order[1]] > _RIVAL * counts[order[0]]:
        return Refusal("motion", "views of more than one plane, or other motion (two motions fit)")
    pose = gtsam.Pose3(gtsam.Rot3(R), t).inverse()
    return TwoViews(pose, points, good, parallax, model.name)


# --- models --------------------------------------------------------------------------------------


def _score(errors: FloatArray, threshold: float) -> tuple[float, BoolArray]:
    """The score of squared errors (N, 2) in both views, in σ², and (N,) which features fit."""
    return float(np.sum(np.maximum(_POINT - errors, 0.0)[errors < threshold])), np.all(
        errors < threshold, axis=1
    )


def _line_errors(E: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Squared distances (N, 2) of features from their epipolar lines in both views."""
    one, two = _homogeneous(first), _homogeneous(second)
    in_second, in_first = one @ E.T, two @ E
    product = np.sum(two * in_second, axis=1) ** 2
    norms = [np.sum(lines[:, :2] ** 2, axis=1) for lines in (in_first, in_second)]
    return np.stack([product / np.maximum(norm, 1e-30) for norm in norms], axis=1)


def _point_errors(H: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Squared distances (N, 2) of features from where the homography moves the other view's."""
    there, back = _homogeneous(first) @ H.T, _homogeneous(second) @ np.linalg.inv(H).T
    errors = [there[:, :2] / there[:, 2:] - second, back[:, :2] / back[:, 2:] - first]
    return np.stack([np.sum(error**2, axis=1) for error in errors], axis=1)


def _seen(
    R: FloatArray, t: FloatArray, first: FloatArray, second: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, FloatArray]:
    """A motion second_T_first with its points (N, 3), which are good, and their parallax (N,)."""
    there = np.column_stack([R, t])
    homogeneous = cv2.triangulatePoints(np.eye(3, 4), there, first.T.copy(), second.T.copy())
    with np.errstate(divide="ignore", invalid="ignore"):
        points = (homogeneous[:3] / homogeneous[3]).T
        other = points @ R.T + t
        errors = np.stack(
            [
                np.sum((local[:, :2] / local[:, 2:] - view) ** 2, axis=1)
                for local, view in ((points, first), (other, second))
            ]
        )
        good = np.all(errors < _POINT * sigma**2, axis=0)
        good &= np.isfinite(points).all(axis=1) & (points[:, 2] > 0.0) & (other[:, 2] > 0.0)
        one, two = _homogeneous(first), _homogeneous(second) @ R
        cross = np.linalg.norm(np.cross(one, two), axis=1)
        parallax = np.arctan2(cross, np.sum(one * two, axis=1))
    return R, t, points, good, parallax


def _homogeneous(view: FloatArray) -> FloatArray:
    return np.column_stack([view, np.ones(len(view))])
