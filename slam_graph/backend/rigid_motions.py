# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which tracks moved as one body between two frames: the world, and what moves in front of it.

The two frames are some tenths of a second apart, as the motion from one frame to the next is often
within the noise: then a pose between that of the world and that of a box fits both. The places of
the tracks in the first frame are known by a second camera or a depth sensor, with the noise of
their inverse depths, so that far ones count as well. The motion that most tracks fit is estimated
under a loss that narrows (graduated non-convexity, with that of Geman & McClure; Yang et al. 2020),
and then that of the tracks that do not fit it. A second body is one only if its motion explains
them better, each by so much that chance is ruled out.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import TriangulationConfig
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.row_unrolling import unrolled
from slam_graph.backend.cost.triangulation import seen_by_first_and_another, triangulate
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.sensors import FeatureFrame, Rig

_FITS = 13.8
"""Largest squared Mahalanobis distance of a track that fits: 99.9 % of χ² of two degrees."""
_GAIN = 12.0
"""By how much the squared distance of a track of another body is smaller under its motion: a ratio
of likelihoods of 400, as for the tracks of objects."""
_FEWEST, _LEAST_SHARE = 8, 0.04
"""Fewer tracks, or a smaller part of all, are no body."""
_MOST_BODIES = 4
"""Besides the world."""
_SCALES, _NEARBY = np.array([256.0, 64.0, 16.0, 9.0, 9.0, 9.0]), 2
"""Squared scales of the loss, in squared standard deviations, and the first of them from a motion
that is nearly right."""
_NEIGHBOURS, _SEEDS = 12, 6
"""Tracks near one another in the image from which a motion is sought, and how often."""
_CELLS = 8.0
"""Cells of the image in a focal length, by which the parts that bodies cover are compared: texture
puts more tracks on one of them."""
_NEAREST_TRACKS = 5
"""So many of the nearest tracks decide where the residuals of a track do not."""
_DEPTHS = TriangulationConfig()
_NEAREST, _FAR = 1e-3, 1e3
"""Smallest depth of a track, as a part of its earlier one: below, it counts as behind the camera,
and has this residual."""
_DAMPING = 1e-12


@dataclass(frozen=True, eq=False)
class LocatedTracks:
    """What the first camera saw in one frame, and how far away it was.

    Attributes:
        stamp_ns: time of the frame.
        ids: (N,) ascending.
        rays: (N, 2) on the plane z = 1 of the first camera.
        inverse: (N,) inverse depths in that camera, 1/m.
        inverse_sigma: (N,) their standard deviations, for a standard deviation of 1 of the rays.
    """

    stamp_ns: int
    ids: IntArray
    rays: FloatArray
    inverse: FloatArray
    inverse_sigma: FloatArray

    @staticmethod
    def of(
        frame: FeatureFrame, rig: Rig, projection: RigProjection, motion: FrameMotion | None
    ) -> LocatedTracks:
        """The tracks of a frame that two cameras see, or one and a depth sensor.

        Args:
            frame: the frame.
            rig: its cameras.
            projection: into them.
            motion: of the body within the frame, for a rolling shutter.
        """
        obs = seen_by_first_and_another(np.sort(frame.cameras[0].ids), frame)
        if len(obs) == 0:
            none = np.zeros(0)
            return LocatedTracks(frame.stamp_ns, obs.ids, np.zeros((0, 2)), none, none)
        found = triangulate(obs, projection, np.eye(3)[None], np.zeros((1, 3)), _DEPTHS)
        axis = projection.body_R_camera[0][:, 2]
        depths = (found.points - projection.body_p_camera[0]) @ axis
        usable = (depths > _DEPTHS.min_depth_m) & (depths < _DEPTHS.max_depth_m)
        usable &= np.isfinite(found.depth_error)
        inverse = 1.0 / np.where(usable, depths, _DEPTHS.max_depth_m)
        sigma = inverse * found.depth_error
        usual = float(np.median(sigma[usable])) if usable.any() else np.inf
        rays = rays_of(frame, obs.ids, rig, motion, 1.0 / inverse)
        return LocatedTracks(frame.stamp_ns, obs.ids, rays, inverse, np.where(usable, sigma, usual))

    def subset(self, rows: BoolArray) -> LocatedTracks:
        """Some of them (N,)."""
        return LocatedTracks(
            self.stamp_ns,
            self.ids[rows],
            self.rays[rows],
            self.inverse[rows],
            self.inverse_sigma[rows],
        )


@dataclass(frozen=True, eq=False)
class RigidMotions:
    """The tracks that two frames have in common, by the bodies that they are of.

    Attributes:
        ids: (N,) ascending.
        body: (N,) 0 for the world, k for the k-th body that moves, -1 for tracks that fit
            no motion.
        unambiguous: (N,) for which the other motions are ruled out.
        share: of the part of the image that bodies cover, how much is of the largest one that
            moves; 0 where fewer than half of the tracks are unambiguous.
    """

    ids: IntArray
    body: IntArray
    unambiguous: BoolArray
    share: float

    @property
    def moving(self) -> IntArray:
        """Ids of the tracks that move with others, ascending."""
        return self.ids[self.body > 0]

    @property
    def static(self) -> IntArray:
        """Ids of the tracks that clearly stand still, ascending."""
        return np.asarray(self.ids[self.unambiguous & (self.body == 0)])


def rays_of(
    frame: FeatureFrame, ids: IntArray, rig: Rig, motion: FrameMotion | None, depths: FloatArray
) -> FloatArray:
    """Where (N, 2) the first camera sees some tracks, on its plane z = 1, at the frame's pose."""
    seen = frame.cameras[0]
    order = seen.ids.argsort()
    rows = order[seen.ids.searchsorted(ids, sorter=order)]
    return unrolled(seen, rows, rig, motion, depths)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Tracks in two frames.

    Attributes:
        before: where they were in the earlier frame.
        rays: (N, 2) where they are seen now.
        sigma: standard deviation of all rays.
    """

    before: LocatedTracks
    rays: FloatArray
    sigma: float

    def residuals(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals under a motion, and how much depth errors spread them.

        Args:
            pose: (3, 4) [R t] of the first camera at the earlier frame, seen from where it is now.

        Returns:
            (N, 2) residuals r, infinite behind the camera, and (N, 2) vectors s. The covariance of
            a residual is σ² (2 I + s sᵀ (1 + √2 / |s|)): the errors of ray and inverse depth may
            add up, as both are those of the same pixel.
        """
        moved, u = self._seen(pose)
        r = np.where(moved[:, 2:] > _NEAREST, self.rays - u, np.inf)
        by_inverse = (pose[:2, 3] - u * pose[2, 3]) / np.maximum(moved[:, 2:], _NEAREST)
        return r, self.before.inverse_sigma[:, None] * by_inverse

    def _seen(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Tracks (N, 3) times their earlier inverse depths, and (N, 2) on the plane z = 1, now."""
        x, inverse = self.before.rays, self.before.inverse
        moved = x @ pose[:, :2].T + pose[:, 2] + inverse[:, None] * pose[:, 3]
        return moved, moved[:, :2] / np.maximum(moved[:, 2:], _NEAREST)

    def distances(self, pose: FloatArray) -> FloatArray:
        """Squared Mahalanobis distances (N,) under a motion; infinite behind the camera."""
        r, spread = self.residuals(pose)
        r = _whitened(np.nan_to_num(r, posinf=_FAR)[:, :, None], spread)[:, :, 0]
        return np.asarray(np.add.reduce(r * r, axis=1) / self.sigma**2)

    def fitted(self, pose: FloatArray, rows: BoolArray, scales: FloatArray) -> FloatArray:
        """A motion (3, 4) that most of some tracks (N,) fit, from one nearby."""
        chosen = _Pairs(self.before.subset(rows), self.rays[rows], self.sigma)
        for scale in scales:
            Jr = chosen.whitened_rows(pose)
            squares = np.add.reduce(Jr[:, :, 6] ** 2, axis=1)
            Jr *= (scale / (scale + squares))[:, None, None]
            rows_of_all = Jr.reshape(-1, 7)
            Ab = rows_of_all[:, :6].T @ rows_of_all
            Ab[range(6), range(6)] += _DAMPING * Ab.trace() + _DAMPING
            step = np.linalg.solve(Ab[:, :6], Ab[:, 6])
            pose = gtsam.Rot3.Expmap(step[:3]).matrix() @ pose
            pose[:, 3] += step[3:]
        return pose

    def whitened_rows(self, pose: FloatArray) -> FloatArray:
        """Rows [J r] (N, 2, 7) by a small turn and shift of the tracks; zero behind the camera."""
        moved, u = self._seen(pose)
        r, spread = self.residuals(pose)
        ahead = np.isfinite(r[:, 0])
        here, (a, b) = self.before.inverse / np.maximum(moved[:, 2], _NEAREST), u.T
        rows = np.zeros((len(r), 2, 7))
        rows[:, 0, :3] = np.column_stack([-a * b, 1.0 + a * a, -b])
        rows[:, 1, :3] = np.column_stack([-(1.0 + b * b), a * b, a])
        rows[:, 0, 3], rows[:, 1, 4] = here, here
        rows[:, :, 5], rows[:, :, 6] = -u * here[:, None], r
        rows[~ahead] = 0.0
        return _whitened(rows, spread) / self.sigma


def _whitened(rows: FloatArray, spread: FloatArray) -> FloatArray:
    """Rows (N, 2, k) in standard deviations of 2 I + s sᵀ (1 + √2 / |s|), for s (N, 2)."""
    length = np.maximum(np.sqrt(np.add.reduce(spread * spread, axis=1)), _DAMPING)
    along = spread / length[:, None]
    # of the variance 2 across s, and 2 + √2 |s| + |s|² along it
    change = 1.0 / np.sqrt(2.0 + np.sqrt(2.0) * length + length**2) - np.sqrt(0.5)
    products = np.einsum("ni,nik->nk", along, rows)
    return np.asarray(
        np.sqrt(0.5) * rows + along[:, :, None] * (change[:, None] * products)[:, None]
    )


def rigid_motions(
    before: LocatedTracks,
    frame: FeatureFrame,
    rig: Rig,
    guess: gtsam.Pose3,
    sigma_px: float,
    motion: FrameMotion | None = None,
    trusted: bool = False,
) -> RigidMotions | None:
    """The bodies that tracks are of; None if one motion explains all but some of them.

    Args:
        before: the tracks in an earlier frame.
        frame: the frame now.
        rig: the cameras; the first one is looked through.
        guess: before_T_now of the body.
        sigma_px: standard deviation of an observation.
        motion: of the body within the frame, for a rolling shutter.
        trusted: whether the world is the body whose tracks fit the guess best, and not the one that
            covers most of the image.
    """
    camera = rig.cameras[0]
    before = before.subset(np.isin(before.ids, frame.cameras[0].ids))
    if len(before.ids) < 2 * _FEWEST:
        return None
    rays = rays_of(frame, before.ids, rig, motion, 1.0 / before.inverse)
    focal_px = float(np.sqrt(camera.camera.fx * camera.camera.fy))
    pairs = _Pairs(before, rays, sigma_px / focal_px)
    start = camera.body_T_camera.inverse().compose(guess.inverse()).compose(camera.body_T_camera)
    first, least = start.matrix()[:3], max(_FEWEST, _LEAST_SHARE * len(rays))
    if np.count_nonzero(pairs.distances(first) > _FITS) < least:
        return None
    scales = _SCALES[_NEARBY:] if trusted else _SCALES
    poses = [pairs.fitted(first, np.ones(len(rays), np.bool_), scales)]
    while len(poses) <= _MOST_BODIES:
        best = np.array([pairs.distances(pose) for pose in poses]).min(axis=0)
        apart = best > _FITS
        found = _another(pairs, poses[0], best, apart, least) if apart.sum() >= least else None
        if found is None:
            break
        poses = _refined(pairs, [*poses, found])
    return _sorted(pairs, poses, first if trusted else None) if len(poses) > 1 else None


def _another(
    pairs: _Pairs, near: FloatArray, best: FloatArray, apart: BoolArray, least: float
) -> FloatArray | None:
    """A motion of some of the tracks that fit no other; None if too few share one.

    Args:
        pairs: all tracks.
        near: a motion from which it is sought.
        best: (N,) their squared distances under the motions so far.
        apart: (N,) which of them do not fit these.
        least: how many must share it.
    """
    rows = apart.nonzero()[0]
    seeds = rows[np.linspace(0, len(rows) - 1, min(_SEEDS, len(rows))).astype(np.int64)]
    found, most = None, least
    for chosen in [apart, *(_nearest(pairs.rays, rows, seed) for seed in seeds)]:
        pose = pairs.fitted(near, chosen, _SCALES)
        pose = pairs.fitted(pose, apart, _SCALES[_NEARBY:])
        distances = pairs.distances(pose)
        count = int(np.count_nonzero((distances < _FITS) & (distances < best - _GAIN)))
        if count >= most:
            found, most = pose, count + 1
        if count >= 0.7 * len(rows):
            break
    return found


def _nearest(rays: FloatArray, rows: IntArray, seed: int) -> BoolArray:
    """The tracks (N,) among some rows that are nearest to one of them in the image."""
    away = np.sum((rays[rows] - rays[seed]) ** 2, axis=1)
    chosen = np.zeros(len(rays), np.bool_)
    chosen[rows[away.argsort()[:_NEIGHBOURS]]] = True
    return chosen


def _refined(pairs: _Pairs, poses: list[FloatArray]) -> list[FloatArray]:
    """Motions, each of the tracks that fit it best."""
    nearest = np.array([pairs.distances(pose) for pose in poses]).argmin(axis=0)
    return [
        pairs.fitted(pose, nearest == k, _SCALES[-2:])
        if np.count_nonzero(nearest == k) >= _FEWEST
        else pose
        for k, pose in enumerate(poses)
    ]


def _sorted(pairs: _Pairs, poses: list[FloatArray], trusted: FloatArray | None) -> RigidMotions:
    """The bodies of the tracks, the world first.

    Args:
        pairs: the tracks.
        poses: motions of the bodies.
        trusted: the motion of the world as it is known; None if it is that of the largest body.
    """
    distances = np.array([pairs.distances(pose) for pose in poses])
    nearest, least = distances.argmin(axis=0), distances.min(axis=0)
    second = np.partition(distances, 1, axis=0)[1]
    decided = (least < _FITS) & (second - least > _GAIN)
    of_body = [decided & (nearest == k) for k in range(len(poses))]
    covers = np.array([_cells(pairs.rays[rows]) for rows in of_body])
    world = int(covers.argmax())
    if trusted is not None:
        errors = pairs.distances(trusted)
        usual = [float(np.median(errors[rows])) if rows.any() else np.inf for rows in of_body]
        world = int(np.argmin(usual))
    moves = (least < _FITS) & (distances[world] - least > _GAIN)
    # what hardly moves against the world, among tracks that do, is of their body
    gains = distances[world] - np.delete(distances, world, axis=0).min(axis=0)
    moves |= (np.abs(gains) <= _GAIN) & _neighbours_move(pairs.rays, moves)
    body = np.where(distances[world] < _FITS, 0, -1)
    place = np.insert(np.arange(1, len(poses)), world, 0)
    of_others = np.delete(distances, world, axis=0).argmin(axis=0)
    of_others += of_others >= world
    share = np.delete(covers, world).max() / max(covers.sum(), 1)
    share *= 2 * np.count_nonzero(decided) >= len(decided)
    body = np.where(moves, place[of_others], body)
    return RigidMotions(pairs.before.ids, body, decided, float(share))


def _neighbours_move(rays: FloatArray, moves: BoolArray) -> BoolArray:
    """For which tracks (N,) most of the nearest ones in the image move."""
    near = np.sum((rays[:, None] - rays[None]) ** 2, axis=2).argsort(axis=1)[
        :, 1 : _NEAREST_TRACKS + 1
    ]
    return np.asarray(moves[near].mean(axis=1) > 0.5)


def _cells(rays: FloatArray) -> int:
    """How many cells of the image, an eighth of the focal length wide, tracks (N, 2) are in."""
    return len(np.unique(np.floor(_CELLS * rays), axis=0))
