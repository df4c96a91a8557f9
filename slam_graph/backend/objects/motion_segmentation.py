# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which of the tracks that move, move together: one rigid motion after the other.

Points that two cameras (or a depth sensor) saw in an earlier frame are at known places relative to
the platform, and those of one object are seen now from one and the same pose. Samples are points
that are near one another in the image, because an object is compact (NAPSAC: Myatt et al. 2002),
and more than the least number, because the depth of a single frame is noisy. The pose that most
tracks fit is that of an object, and the rest is searched again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.distance import cdist

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.cost.row_unrolling import unrolled
from slam_graph.backend.cost.triangulation import triangulate_frames
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.sensors import FeatureFrame, Rig

_SAMPLE = 7
"""Points of a sample."""
_MAX_GROUPS = 8
"""Most objects that begin in one frame."""
_SIGMAS = 3.0
"""Errors of a track that fits, in standard deviations."""
_REFINEMENTS = 3
"""Times that a pose is fitted to the tracks that fit it."""
_MAX_DEPTH_ERROR = 0.3
"""Relative error of a depth above which it is of no use."""


@dataclass(frozen=True, eq=False)
class _Tracks:
    """Tracks with a depth in an earlier frame, in the first camera.

    Attributes:
        ids: (N,).
        points: (N, 3) in the camera, m.
        depth_errors: (N,) relative standard deviations of their depths.
        rays: (N, 2) where it sees them now, on the plane z = 1.
        sigma: standard deviation of the rays.
    """

    ids: IntArray
    points: FloatArray
    depth_errors: FloatArray
    rays: FloatArray
    sigma: float

    def without(self, rows: BoolArray) -> _Tracks:
        """Those where `rows` (N,) does not hold."""
        left = ~rows
        return _Tracks(
            self.ids[left],
            self.points[left],
            self.depth_errors[left],
            self.rays[left],
            self.sigma,
        )

    def fitting(self, pose: tuple[FloatArray, FloatArray]) -> BoolArray:
        """Which tracks (N,) fit a pose of the camera, with the errors of their depths."""
        R = cv2.Rodrigues(pose[0])[0]
        here, moved = (
            (self.points * scale[:, None]) @ R.T + pose[1].ravel()
            for scale in (np.ones(len(self.points)), 1.0 + self.depth_errors)
        )
        ahead = np.minimum(here[:, 2], moved[:, 2]) > 1e-3
        seen, other = (p[:, :2] / np.maximum(p[:, 2:], 1e-3) for p in (here, moved))
        variance = self.sigma**2 + np.sum((other - seen) ** 2, axis=1)
        errors = np.sum((seen - self.rays) ** 2, axis=1)
        return np.asarray(ahead & (errors < _SIGMAS**2 * variance))

    def pose_of(self, rows: IntArray | BoolArray) -> tuple[FloatArray, FloatArray]:
        """Rotation vector and translation of the camera by some of the tracks."""
        start = np.zeros((2, 3, 1))
        rotation, translation = cv2.solvePnPRefineLM(
            np.ascontiguousarray(self.points[rows]),
            np.ascontiguousarray(self.rays[rows]),
            np.eye(3),
            None,
            start[0],
            start[1],
        )
        return np.asarray(rotation, np.float64), np.asarray(translation, np.float64)


def rigid_groups(
    ids: IntArray,
    frames: Sequence[FeatureFrame],
    rig: Rig,
    min_points: int,
    sigma_px: float,
    motions: Mapping[int, FrameMotion] | None = None,
) -> list[IntArray]:
    """Groups of tracks that move rigidly, the largest first.

    Args:
        ids: (N,) of the tracks, ascending.
        frames: the last ones, in the order of time.
        rig: its first camera is looked through.
        min_points: fewest tracks of a group.
        sigma_px: standard deviation of the observations.
        motions: of the platform within frames, by their stamps; for rolling shutters.

    Returns:
        Their ids, ascending.
    """
    groups: list[IntArray] = []
    rest = ids
    for frame in list(frames)[:-1]:
        tracks = _tracks(rest, (frame, frames[-1]), rig, sigma_px, motions or {})
        while len(tracks.ids) >= min_points and len(groups) < _MAX_GROUPS:
            fits = _largest(tracks, min_points)
            if fits is None:
                break
            groups.append(np.sort(tracks.ids[fits]))
            tracks = tracks.without(fits)
        rest = np.setdiff1d(rest, np.concatenate([np.zeros(0, np.int64), *groups]))
    return groups


def _largest(tracks: _Tracks, min_points: int) -> BoolArray | None:
    """The largest set of tracks (N,) that fits one pose; None if none is large enough."""
    count = len(tracks.ids)
    nearest = np.argsort(cdist(tracks.rays, tracks.rays), axis=1)[:, : min(_SAMPLE, count)]
    best: BoolArray | None = None
    for sample in np.unique(np.sort(nearest, axis=1), axis=0):
        fits = tracks.fitting(tracks.pose_of(sample))
        if np.count_nonzero(fits) >= min_points and (best is None or fits.sum() > best.sum()):
            best = fits
    if best is None:
        return None
    for _ in range(_REFINEMENTS):
        refined = tracks.fitting(tracks.pose_of(best))
        if np.count_nonzero(refined) <= np.count_nonzero(best):
            break
        best = refined
    return best


def _tracks(
    ids: IntArray,
    frames: tuple[FeatureFrame, FeatureFrame],
    rig: Rig,
    sigma_px: float,
    motions: Mapping[int, FrameMotion],
) -> _Tracks:
    """The tracks with a depth in an earlier frame that are seen now."""
    before, now = frames
    moving = {0: motions[before.stamp_ns]} if before.stamp_ns in motions else {}
    mounted, seen = rig.cameras[0], now.cameras[0]
    focal_px = float(np.sqrt(mounted.camera.fx * mounted.camera.fy))
    ids = ids[np.isin(ids, seen.ids) & np.isin(ids, before.cameras[0].ids)]
    if len(ids) == 0 or len(rig.cameras) < 2:
        none = np.zeros(0)
        return _Tracks(ids[:0], none.reshape(0, 3), none, none.reshape(0, 2), 1.0)
    origin = np.eye(3)[None], np.zeros((1, 3))
    found = triangulate_frames(ids, [before.only(ids)], *origin, rig, moving)
    relative = found.depth_error * sigma_px / focal_px
    good = found.good & (relative < _MAX_DEPTH_ERROR)
    ids = ids[good]
    points = np.asarray(mounted.body_T_camera.transformTo(found.points[good].T)).T.reshape(-1, 3)
    order = np.argsort(seen.ids)
    rows = order[np.searchsorted(seen.ids[order], ids)]
    rays = unrolled(seen, rows, rig, motions.get(now.stamp_ns), points[:, 2])
    sigma = 2.0 * sigma_px / focal_px  # that of where the point was seen before counts, too
    return _Tracks(ids, points, relative[good], rays, sigma)
