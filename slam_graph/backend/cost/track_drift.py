# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Drift of tracks: estimated on the way, and process noise of the features of the state.

Lucas and Kanade's method follows a patch from frame to frame, so that its small errors add up: the
track does a random walk around the projection of its point, the same in all cameras, as each of
them is matched to the first one in every frame. A feature that stays in the state is observed
hundreds of times. If every observation had an error of its own, it would soon be known to a
hundredth of a pixel, and the poses with it. The walk of a track is the same as a point that slides
over its surface,

    f_{t+1} = f_t + w,    w ~ N(0, σ_d² J⁺ J⁺ᵀ),

with J (2, 3) the derivative of its pixel by its position: w is perpendicular to its ray, and moves
its pixel by σ_d along each axis in one frame. That is process noise of the features of the state.

σ_d is found from the residuals of tracks. Over blocks of n observations, with the symbols of
`pixel_noise`, their squared means have the expectation

    E ‖B e‖² = σ_w² tr(B P Bᵀ) + σ_d² tr(B P K P Bᵀ),    K = min(i, j) for frames i and j.

White noise falls with n, a walk does not: n = 1 and n = 8 give two equations for σ_w² and σ_d².
"""

from __future__ import annotations

import contextlib

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import NoiseConfig
from slam_graph.backend.cost.feature_tracks import Observations, is_in
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.winsorised import winsorised
from slam_graph.backend.solve.state import POINT_DIM, features_of
from slam_graph.backend.window import Window
from slam_graph.kernels.feature_sums import block_sums

_LEAST_VARIANCE = 1e-6
"""Of white noise, px²: simulated tracks may have none."""
EVERY_FRAMES = 6
"""Process noise is added once in so many frames, for as many frames: it takes time."""
_BLOCKS = (1, 8)
"""Consecutive observations of a camera that are averaged."""
_MEMORY_S = 20.0
"""Time constant with which tracks are forgotten."""
_LEAST_DOF = 30.0
"""Degrees of freedom of block means from which on they count for more than the settings."""
_QUANTILE = 0.999
"""Of the distribution of a track's sum, where the sum is cut off."""
_DEVIATIONS = 2.5
"""Standard deviations of the block means that are not taken for drift."""


class TrackDrift:
    """How far tracks slide off their points in a frame.

    Until they show it, it is what the settings say.

    Attributes:
        sigma_px: standard deviation along each axis of the image after one frame; √n times that
            after n.
    """

    def __init__(self, config: NoiseConfig) -> None:
        self.sigma_px = config.drift_px
        self._variances = np.array([config.pixel_sigma, config.drift_px]) ** 2
        self._traces, self._squares, self._dof = np.zeros((2, 2)), np.zeros(2), np.zeros(2)
        self._stamp_ns: int | None = None

    def learn(
        self, obs: Observations, r: FloatArray, by_point: FloatArray, cameras: int, stamp_ns: int
    ) -> None:
        """Learn from the tracks of a step.

        Args:
            obs: N observations of J features, each of them offered once.
            r: (N, 2) residuals in pixels.
            by_point: (N, 2, 3) derivatives by the position of the feature.
            cameras: how many cameras count, the first ones.
            stamp_ns: time of the step.
        """
        if self._stamp_ns is not None:
            memory = np.exp(-(stamp_ns - self._stamp_ns) * 1e-9 / _MEMORY_S)
            self._traces, self._squares = memory * self._traces, memory * self._squares
            self._dof = memory * self._dof
        self._stamp_ns = stamp_ns
        frame = np.array(obs.frames, np.int64)[obs.frame]
        for k, block in enumerate(_BLOCKS):
            sums = np.empty((4, len(obs.ids), cameras))
            block_sums(r, by_point, obs.camera, frame, obs.starts, block, sums)
            sums = sums.sum(axis=2)
            some = np.isfinite(sums).all(axis=0) & (sums[1] > 0.0)
            self._add(k, *sums[:, some])
        self._solve()

    def _add(
        self, k: int, squares: FloatArray, white: FloatArray, white2: FloatArray, walk: FloatArray
    ) -> None:
        """Add the sums of tracks, each cut off at a quantile under the present variances.

        Args:
            k: which block.
            squares: (J,) squared block means.
            white: (J,) tr(S).
            white2: (J,) tr(S²).
            walk: (J,) tr(D).
        """
        noise, drift = self._variances
        expected = noise * white + drift * walk
        # that of a walk is mostly one direction of each axis
        spread = noise * np.sqrt(white2) + drift * walk / np.sqrt(2.0)
        dof = (expected / spread) ** 2
        shares = winsorised(squares / expected, dof, _QUANTILE)
        self._squares[k] += shares @ expected
        self._traces[k] += np.array([white.sum(), walk.sum()])
        self._dof[k] += dof.sum()

    def _solve(self) -> None:
        """The two variances, and the drift that the block means clearly show."""
        if self._dof[1] < _LEAST_DOF:
            return
        self._variances = _nonnegative(self._traces, self._squares)
        doubted = self._squares * np.array([1.0, 1.0 - _DEVIATIONS * np.sqrt(2.0 / self._dof[1])])
        self.sigma_px = float(np.sqrt(_nonnegative(self._traces, doubted)[1]))


def _nonnegative(traces: FloatArray, squares: FloatArray) -> FloatArray:
    """Variances (2,) of white noise and walk, neither below zero; the noise stays above it."""
    white = max(squares[0] / traces[0, 0], _LEAST_VARIANCE)
    noise, drift = np.linalg.solve(traces, squares)
    return np.array([max(noise, 1e-3 * white), drift]) if drift > 0.0 else np.array([white, 0.0])


def add_drift_noise(window: Window, rig: RigProjection, sigma_px: float) -> None:
    """Add the process noise of drift to the features of the state with waiting observations.

    A lost feature is stored as a conditional given other variables where they were then. The noise
    makes it outdated, so the store is closed for good.

    Args:
        window: with the observations of the current frame, and its predicted pose.
        rig: projection into the cameras.
        sigma_px: how far in one frame.
    """
    if sigma_px == 0.0 or window.frame % EVERY_FRAMES or not len(window.state_features):
        return
    ids = window.state_features[is_in(window.state_features, window.tracks.ids_waiting())]
    if not len(ids):
        return
    window.lost_features.close()
    obs = window.tracks.observations(ids)
    obs, rig = obs.rows(obs.starts[:-1]), rig.at(window.state)  # where the first camera sees them
    poses = rig.when_taken(obs.frames, *window.state.poses(obs.frames))
    at = Geometry(*poses, window.state.positions_of(ids))
    J = rig.derivatives(obs, at, rig.views(obs, at))[1]
    known = features_of(window.prior.layout)  # its first columns
    order = np.argsort(known)
    noise = np.zeros((len(known), POINT_DIM, POINT_DIM))
    sliding = order[np.searchsorted(known, ids, sorter=order)]
    with contextlib.suppress(np.linalg.LinAlgError):  # not determined: the steps will say so
        # J⁺ J⁺ᵀ = Jᵀ (J Jᵀ)⁻² J
        root = np.linalg.solve(J @ J.transpose(0, 2, 1), J)
        noise[sliding] = EVERY_FRAMES * sigma_px**2 * root.transpose(0, 2, 1) @ root
        window.prior = window.prior.with_noise(noise)
