# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The estimator: one loop of cost construction, Gauss-Newton steps and marginalization.

Every recursive algorithm is this loop under a policy (`policies.py`). See docs/engine.md.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, X
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from slam_graph.backend.config import BackendConfig
from slam_graph.backend.cost import Cost, Linearization, NewFeatures
from slam_graph.backend.gauss_newton import minimize
from slam_graph.backend.imu import (
    ImuBuffer,
    imu_factor,
    predict,
    preintegrate,
    preintegration_params,
)
from slam_graph.backend.initialization import Initializer, Start, current_covariance, start_from
from slam_graph.backend.marginalization import marginalize
from slam_graph.backend.policies import POSE_CHOICES, AlgorithmConfig
from slam_graph.backend.reprojection import RigProjection
from slam_graph.backend.selection import choose_features
from slam_graph.backend.square_root import SquareRootInformation
from slam_graph.backend.state import State, imu_state_keys, stacked_poses
from slam_graph.backend.tracks import TrackWindow, is_in
from slam_graph.backend.triangulation import triangulate
from slam_graph.backend.zero_velocity import StandstillDetector, zero_velocity_factors
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.measurements import FeatureFrame, ImuData
from slam_graph.sensors.rig import Rig

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class Estimator:
    """A visual-inertial estimator under the policies of one algorithm.

    Feed it IMU samples and feature frames in the order of time; every frame gives the state then.

    Attributes:
        timings: seconds that each module took in the last step.
    """

    def __init__(
        self,
        rig: Rig,
        algorithm: AlgorithmConfig,
        config: BackendConfig | None = None,
        diagnostics: Diagnostics | None = None,
    ) -> None:
        self.rig = rig
        self.algorithm = algorithm
        self.config = config or BackendConfig()
        self.diagnostics = diagnostics or Diagnostics()
        self.timings: dict[str, float] = {}
        self.waiting_for = "the first frame"
        noise = self.config.noise
        self._params = preintegration_params(rig.imu, noise.gravity, noise.imu_scale)
        self._projection = RigProjection(rig)
        self._choose_poses = POSE_CHOICES[algorithm.cost.past_poses]
        self._time_offset_ns = round(rig.cameras[0].time_offset_s * 1e9)
        self._imu = ImuBuffer()
        self._standstill = StandstillDetector(self.config.zero_velocity)
        self._still = False
        # the matrices are small: waking threads for them costs many times what they save
        self._threads = ThreadpoolController()
        self._state = State()
        self._tracks = TrackWindow()
        self._prior = SquareRootInformation.empty()
        self._current: NavState | None = None
        self._frame = -1
        self._past: list[int] = []
        self._initializer: Initializer | None = Initializer(
            self._projection, self._params, algorithm, self.config
        )
        self._features = np.zeros(0, np.int64)  # ids of the features in the state, ascending

    # --- the outside -----------------------------------------------------------------------------

    @property
    def initialized(self) -> bool:
        """Whether there is a state."""
        return self._current is not None

    def start(self, state: NavState) -> None:
        """Begin from a known state.

        Args:
            state: with its covariance.

        Raises:
            EstimationError: if the state has no covariance.
        """
        if state.covariance is None:
            raise EstimationError("a start state needs a covariance")
        self._adopt(start_from(state, self.config))

    def add_imu(self, imu: ImuData) -> None:
        """Add IMU samples that follow those already given."""
        self._imu.add(imu)

    def add_frame(self, frame: FeatureFrame) -> NavState | None:
        """Take the features of one time and estimate the state then.

        Returns:
            The causal estimate with its covariance, or None as long as there is no state.
        """
        with self._threads.limit(limits=1, user_api="blas"):
            return self._add_frame(frame)

    def _add_frame(self, frame: FeatureFrame) -> NavState | None:
        stamp_ns = frame.stamp_ns + self._time_offset_ns
        self._still = self._standstill.is_still(self._imu, stamp_ns, frame)
        if self._current is None:
            self._try_to_start(stamp_ns, frame)
        elif stamp_ns > self._current.stamp_ns:
            self._current = self._step(stamp_ns, frame)
        if self._current is None:
            return None
        self._imu.forget_before(stamp_ns - round(2e9))
        return replace(self._current, stamp_ns=frame.stamp_ns)

    def landmarks(self) -> tuple[IntArray, FloatArray]:
        """Ids (N,) and world positions (N, 3) of the features in the state."""
        points = [self._state.estimate.atPoint3(L(j)) for j in self._features.tolist()]
        return self._features, np.array(points).reshape(-1, 3)

    def _try_to_start(self, stamp_ns: int, frame: FeatureFrame) -> None:
        assert self._initializer is not None
        start = self._initializer.try_to_start(
            self._imu, stamp_ns, frame, self._standstill.since_ns
        )
        self.waiting_for = self._initializer.waiting_for
        if start is not None:
            self._adopt(start)

    def _adopt(self, start: Start) -> None:
        """Go on from a start."""
        self._current, self._frame = start.current, start.frame
        self._state, self._prior, self._features = start.state, start.prior, start.features
        self._initializer = None

    # --- the loop --------------------------------------------------------------------------------

    def _step(self, stamp_ns: int, frame: FeatureFrame) -> NavState:
        """One turn of the loop: the three modules, in order."""
        self.timings = {}
        with self._timed("propagation"):
            dynamics = self._propagate(stamp_ns, frame)
        with self._timed("cost"):
            keep_poses, oldest_leaving = self._poses_that_stay()
            cost, linear = self._construct(dynamics, oldest_leaving)
        with self._timed("gauss_newton"):
            posterior = minimize(cost, self.algorithm.gauss_newton, linear)
        with self._timed("marginalization"):
            keep = [L(j) for j in self._features_that_stay(cost)]
            keep += [X(i) for i in keep_poses] + list(imu_state_keys(self._frame))
            self._prior = marginalize(posterior, self._state, keep, self.algorithm.marginalization)
            self._forget(keep_poses, cost)
        return self._state.nav_state(self._frame, stamp_ns, current_covariance(self._prior))

    @contextmanager
    def _timed(self, module: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.timings[module] = self.timings.get(module, 0.0) + time.perf_counter() - start

    # --- module 1 --------------------------------------------------------------------------------

    def _propagate(self, stamp_ns: int, frame: FeatureFrame) -> list[gtsam.NonlinearFactor]:
        """Predict the state at the new frame and return the factors that say how it got there."""
        assert self._current is not None
        previous = self._state.nav_state(self._frame, self._current.stamp_ns, None)
        samples = self._imu.between(previous.stamp_ns, stamp_ns)
        pim = preintegrate(
            samples, self._state.estimate.atConstantBias(B(self._frame)), self._params
        )
        i, j = self._frame, self._frame + 1
        self._state.insert_imu_state(j, predict(previous, pim, stamp_ns))
        self._tracks.add(j, frame)
        self._past.append(i)
        self._frame = j
        factors: list[gtsam.NonlinearFactor] = [imu_factor(i, j, pim)]
        if self._still:
            factors += zero_velocity_factors(i, j, self.config.zero_velocity)
        return factors

    def _poses_that_stay(self) -> tuple[list[int], int | None]:
        """Past frames whose poses stay, and the oldest one if it leaves."""
        past = self._past
        if self._still:
            return past[:-1], None  # the new pose replaces the last one, which it equals
        stay = self._choose_poses(past, self.algorithm.cost.max_past_poses)
        return stay, past[0] if past[0] not in stay else None

    def _construct(
        self, dynamics: list[gtsam.NonlinearFactor], oldest_leaving: int | None
    ) -> tuple[Cost, Linearization | None]:
        """The cost of this step, gated, and its first linearisation."""
        cost = Cost(self._state, self._projection, self.config, self._prior, dynamics)
        if self._still:
            return cost, None
        layout = cost.layout()
        predicted = cost.prior_at_estimate().updated(cost.factor_rows(layout))
        seen = np.intersect1d(self._features, self._tracks.ids_in(self._frame), True)
        cost.tracked = self._tracks.observations(seen, [self._frame])
        cost.fresh = self._new_features(oldest_leaving, len(seen))
        linear = cost.linearize()
        tracked_ok, fresh_ok = cost.gate(linear, predicted.covariance(), layout)
        return self._gated(cost, linear, tracked_ok, fresh_ok)

    def _new_features(self, oldest_leaving: int | None, in_state: int) -> NewFeatures | None:
        """Triangulated features that enter the cost now."""
        policy = self.algorithm.cost
        self._tracks.consume(self._features)
        choice = choose_features(
            self._tracks, self._frame, oldest_leaving, policy.max_state_features - in_state, policy
        )
        ids = np.union1d(choice.ended, choice.lasting)
        if len(ids) == 0:
            return None
        obs = self._tracks.observations(ids)
        rotations, positions = stacked_poses(self._state.estimate, obs.frames)
        result = triangulate(obs, self._projection, rotations, positions, self.config.triangulation)
        lasting = is_in(ids, choice.lasting)
        self._tracks.consume(ids[~lasting])
        self.diagnostics.counts["feature_not_triangulated"] += int(np.sum(~result.good & ~lasting))
        fresh = NewFeatures(obs, result.points, lasting)
        return fresh.subset(result.good) if result.good.any() else None

    def _gated(
        self,
        cost: Cost,
        linear: Linearization,
        tracked_ok: NDArray[np.bool_],
        fresh_ok: NDArray[np.bool_],
    ) -> tuple[Cost, Linearization]:
        """Leave out what the χ² test rejects, and make variables of the features that stay."""
        self.diagnostics.counts["rejected_by_gate"] += int(np.sum(~tracked_ok) + np.sum(~fresh_ok))
        linear = linear.subset(tracked_ok, fresh_ok)
        if linear.tracked is not None and cost.tracked is not None:
            cost.tracked = cost.tracked.rows(tracked_ok)
        if cost.fresh is not None:
            self._tracks.consume(cost.fresh.obs.ids)
            cost.fresh = cost.fresh.subset(fresh_ok)
            for j, point in zip(cost.fresh.obs.ids, cost.fresh.points, strict=True):
                if cost.fresh.in_state[np.searchsorted(cost.fresh.obs.ids, j)]:
                    self._state.insert_point(int(j), point)
        return cost, linear

    # --- module 3 --------------------------------------------------------------------------------

    def _features_that_stay(self, cost: Cost) -> list[int]:
        """The features of the state that the current frame sees, old and new."""
        if self._still:
            return self._features.tolist()
        tracked = cost.tracked
        ids = np.unique(tracked.ids[tracked.feature]) if tracked is not None else self._features[:0]
        if cost.fresh is not None:
            ids = np.union1d(ids, cost.fresh.obs.ids[cost.fresh.in_state])
        self._features = ids
        return [int(j) for j in ids]

    def _forget(self, keep_poses: list[int], cost: Cost) -> None:
        """Drop the observations of the frames that left."""
        self._tracks.retain([*keep_poses, self._frame])
        self._past = list(keep_poses)
