# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The noise of the pixels, estimated on the way from the residuals of tracks.

Errors of tracked features are correlated from frame to frame: a patch slides slowly off its point.
Averaged over n frames they shrink by less than √n, so that an estimator that takes them for white
with the standard deviation of single residuals is too sure. What counts is the white noise that
leaves the same error after averaging. It is read from the means of blocks of consecutive
observations.

With the whitened residuals e = P ε of a track, P = I - Q Qᵀ the projection off the three directions
H_f = Q R_f of its point, and the rows B that average over its blocks in one camera,

    E ‖B e‖² = σ² tr(B P Bᵀ),

where σ is in units of the value that whitened. The sum has a distribution close to that of χ² with
k = tr(S)² / tr(S²) degrees of freedom, S = B P Bᵀ (Satterthwaite 1946). To be robust, the sum of
each track is cut off at a quantile of that distribution, and its mean is divided by what the cut
leaves of a normal one (winsorised mean; Huber's "proposal 2" of 1964, one step a frame). Errors of
the poses are neglected: after the step they are small beside the noise of a track.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import NoiseConfig
from slam_graph.backend.cost.cost import Cost, TrackFeatures
from slam_graph.backend.cost.feature_tracks import Observations, is_in
from slam_graph.backend.cost.reprojection import Geometry
from slam_graph.backend.cost.track_drift import TrackDrift
from slam_graph.backend.cost.winsorised import winsorised
from slam_graph.kernels.feature_sums import block_sums, extents

BLOCK = 8
"""Consecutive observations of a camera that are averaged. Shorter blocks miss what lasts longer."""
_MIN_OBSERVATIONS = 11
"""Observations that a track needs: of shorter ones the point explains nearly all block means."""
_LEAST_MOTION_PX = 50.0
"""Motion that a track needs: a patch that has hardly moved has not slid off its point yet."""
_MEMORY_S = 20.0
"""Time constant with which tracks are forgotten."""
_PRIOR_DOF = 50.0
"""Degrees of freedom that the setting counts for at the start."""
_LEAST_DOF = 1.0
"""Degrees of freedom that the last estimate counts for, however long ago it was."""
_QUANTILE = 0.95
"""Of the distribution of a track's sum, where the sum is cut off."""
_WALK = _MIN_OBSERVATIONS / np.sqrt(3.0)
"""White noise that is as large, in the mean of so many observations, as a random walk from the
first of them on, in steps of the walk."""
_MAX_RATIO = 4.0
"""Largest ratio of the estimate to the setting, and of the setting to the estimate."""
_DRIFT_STEPS = 2
"""One step of so many asks how far tracks slide off their points: it takes time."""
_CLEARLY = 1.25
"""Ratio of the estimate to the setting, or the inverse, from which the estimate is used."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockMeans:
    """Squared block means of J tracks in one camera.

    Attributes:
        squares: (J,) in units of what is expected, σ² tr(B P Bᵀ).
        dof: (J,) degrees of freedom of the χ² distribution that is close to theirs.
    """

    squares: FloatArray
    dof: FloatArray


class PixelNoise:
    """Standard deviation of the observations of each camera, as the tracks show it.

    Attributes:
        sigma_px: (C,) that the cost takes; that of the settings at the start.
        estimate_px: (C,) that the tracks show.
        drift: how far tracks slide off their points.
    """

    def __init__(self, config: NoiseConfig, cameras: int, with_depth: bool = False) -> None:
        """Begin with the settings.

        Args:
            config: the settings.
            cameras: their number.
            with_depth: whether the last one stands for a depth sensor, which shows no drift.
        """
        self._config = config
        self._tracking = cameras - with_depth
        self.drift = TrackDrift(config)
        self.sigma_px = self.estimate_px = np.full(cameras, config.pixel_sigma)
        self._dof = np.full(cameras, _PRIOR_DOF)
        self._squares = self._dof * self.sigma_px**2
        self._stamp_ns: int | None = None
        self._steps = 0

    def assume(self, sigma_px: float) -> None:
        """Take observations for so noisy from now on."""
        self.sigma_px = self.estimate_px = np.full(len(self.sigma_px), sigma_px)

    def learn(self, cost: Cost, tracks: TrackFeatures | None, stamp_ns: int) -> None:
        """Learn from the tracks of a step.

        Args:
            cost: after the steps.
            tracks: the new features, each of them once; also those that the gate has rejected, or
                noise that is larger than assumed would not be seen.
            stamp_ns: time of the step.
        """
        self._steps += 1
        # a camera that shows nothing for long keeps its last estimate, of little weight
        kept = np.maximum(self._kept_since_last(stamp_ns), _LEAST_DOF / self._dof)
        self._dof, self._squares = kept * self._dof, kept * self._squares
        if tracks is None:
            return
        telling = tracks.obs.counts >= _MIN_OBSERVATIONS
        telling &= _extents_px(tracks.obs, len(self.sigma_px)) >= _LEAST_MOTION_PX
        tracks = tracks.subset(telling)
        asks_drift = self._config.adaptive_drift and self._steps % _DRIFT_STEPS == 0
        asks_noise = self._config.adaptive_pixels != "never"
        if len(tracks.obs) == 0 or not (asks_drift or asks_noise):
            return
        residuals, by_point = _linearized(cost, tracks)
        if asks_noise:
            self._learn_noise(tracks.obs, residuals, by_point)
        if asks_drift and cost.tracks is not None:
            # only these resemble features of the state, which pass the gate in every frame
            passed = is_in(tracks.obs.ids, cost.tracks.obs.ids)
            obs, rows = tracks.obs.subset(passed), passed[tracks.obs.feature]
            self.drift.learn(obs, residuals[rows], by_point[rows], self._tracking, stamp_ns)

    def _kept_since_last(self, stamp_ns: int) -> float:
        """Factor on the weight of earlier tracks, exp(-Δt / memory); 1 in the first step."""
        last, self._stamp_ns = self._stamp_ns, stamp_ns
        return 1.0 if last is None else float(np.exp(-(stamp_ns - last) * 1e-9 / _MEMORY_S))

    def _learn_noise(self, obs: Observations, residuals: FloatArray, by_point: FloatArray) -> None:
        """Learn how noisy each camera is from residuals (N, 2) and their derivatives, in pixels."""
        unit = self.estimate_px  # where the cut is right, whatever the cost takes
        sigma = unit[obs.camera]
        parts = residuals / sigma[:, None], by_point / sigma[:, None, None]
        try:
            found = block_means(obs, *parts, len(self.sigma_px))
        except np.linalg.LinAlgError:  # a point that its observations do not determine
            return
        for camera, means in enumerate(found):
            self._dof[camera] += np.sum(means.dof)
            share = float(means.dof @ winsorised(means.squares, means.dof, _QUANTILE))
            self._squares[camera] += share * unit[camera] ** 2
        setting = self._config.pixel_sigma
        sigma_px = np.sqrt(self._squares / self._dof)
        self.estimate_px = np.clip(sigma_px, setting / _MAX_RATIO, setting * _MAX_RATIO)
        self._squares = self._dof * self.estimate_px**2  # what is beyond does not pile up
        # a random walk that lasts for longer than the blocks is more than they show
        least = min(setting, _WALK * self.drift.sigma_px)
        shown = np.maximum(self.estimate_px, least)
        taken = shown > _CLEARLY * setting
        if self._config.adaptive_pixels == "clear":
            taken |= shown < setting / _CLEARLY
        taken |= self._config.adaptive_pixels == "any"
        self.sigma_px = np.where(taken, shown, setting)


def _extents_px(obs: Observations, cameras: int) -> FloatArray:
    """Diagonals (J,) of the smallest boxes around the tracks, in the camera where it is largest."""
    diagonals = np.empty((len(obs.ids), cameras))
    extents(obs.pixels, obs.camera, obs.starts, diagonals)
    return np.asarray(diagonals.max(axis=1))


def _linearized(cost: Cost, tracks: TrackFeatures) -> tuple[FloatArray, FloatArray]:
    """Residuals (N, 2) and derivatives by the points (N, 2, 3), in pixels."""
    obs, rig = tracks.obs, cost.rig.at(cost.state)
    at = Geometry(*rig.when_taken(obs.frames, *cost.state.poses(obs.frames)), tracks.points)
    views = rig.views(obs, at)
    return obs.pixels - views.pixels, rig.derivatives(obs, at, views)[1]


def block_means(
    obs: Observations, residuals: FloatArray, by_point: FloatArray, cameras: int
) -> list[BlockMeans]:
    """The squared block means of tracks in each camera.

    The observations of other cameras only say where the point is.

    Args:
        obs: N observations of J features, sorted by feature and frame.
        residuals: (N, 2) in standard deviations.
        by_point: (N, 2, 3) derivatives by the position of the feature.
        cameras: their number.

    Raises:
        numpy.linalg.LinAlgError: if observations do not determine their point.
    """
    sums = np.empty((4, len(obs.ids), cameras))
    block_sums(residuals, by_point, obs.camera, obs.frame, obs.starts, BLOCK, sums)
    if not np.all(np.isfinite(sums)):
        raise np.linalg.LinAlgError("a point is not determined by its observations")
    means = []
    for squares, trace, square, _ in sums.transpose(2, 0, 1):
        some = trace > 0.0
        dof = trace[some] ** 2 / square[some]
        means.append(BlockMeans(squares[some] / trace[some], dof))
    return means
