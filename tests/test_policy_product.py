# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The law of the table: under no combination of policies does a measurement count twice.

Without any error, all linearisation points are true, and so the problem is linear. There the
posterior of every combination that is accepted holds no more information than the batch solution
of all measurements so far, and as much where nothing is thrown away. The combinations are generated
from the policies' own types and registries; two policies that are registered here are among them.
"""

import itertools
from collections import Counter
from collections.abc import Iterator

import gtsam
import numpy as np
import pytest
from flight import rig, room
from groups import slow_but
from gtsam.symbol_shorthand import B, V, X
from linear_flight import CONFIG, batch_problem, exact_recording
from scipy.linalg import eigvalsh, solve_triangular

from benchmarks.policy_combinations import Options, combinations, values_of
from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend.backend_config import BackendConfig, TriangulationConfig
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.selection_policies import (
    FEATURE_POLICIES,
    POSE_SELECTIONS,
    FeaturePolicy,
    PoseSelection,
    WaitingTracks,
)
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.policies import AlgorithmConfig, CostPolicy
from slam_graph.backend.solve.state import dims_of
from slam_graph.backend.window import Window
from slam_graph.sensors.measurements import Packet
from slam_graph.sensors.rig import Rig

FRAMES, POINTS = 8, 25
CHECKED_FRAMES = (4, 7)
TOLERANCE = 1e-5
"""Relative error of variances that rounding leaves."""
FEW, MANY = 3, 1000
TRIANGULATION = TriangulationConfig(min_parallax_rad=0.0, max_depth_m=1e6)
LOOSE = BackendConfig(
    noise=CONFIG.noise,
    gating=CONFIG.gating,
    initialization=CONFIG.initialization,
    triangulation=TRIANGULATION,
)


def without_second_newest(window: Window, policy: CostPolicy, rig: RigProjection) -> PoseSelection:
    """Drops a pose out of the middle; what it saw is used."""
    past = window.past
    return PoseSelection(past if len(past) <= policy.max_past_poses else [*past[:-2], past[-1]])


def _seen_thrice(tracks: WaitingTracks) -> BoolArray:
    return (tracks.lengths >= 3) | tracks.leaving


FROM_OUTSIDE = ("second_newest_leaves", "seen_thrice")
"""A pose selection and a feature policy that are not of the package."""


@pytest.fixture(scope="module", autouse=True)
def outside() -> Iterator[None]:
    poses, features = FROM_OUTSIDE
    with (
        POSE_SELECTIONS.registered(poses, without_second_newest),
        FEATURE_POLICIES.registered(features, FeaturePolicy(_seen_thrice)),
    ):
        yield


CHOICES: tuple[Options, ...] = (
    values_of("cost.max_past_poses", (FEW, MANY)),
    values_of("cost.recent_frames", (1, 3)),
    {
        "held0": {"cost.max_state_features": 0},
        "held5": {"cost.max_state_features": 5, "cost.state_feature_frames": 3},
        "all held": {"cost.max_state_features": None, "cost.state_feature_frames": 3},
    },
    values_of("cost.keep_lost_features", (False, True)),
    values_of("cost.max_features_per_step", (4, CostPolicy().max_features_per_step)),
)
ONE_STEP: Options = {"one step": {"gauss_newton.max_steps": 1}}
STEPS: Options = {
    **ONE_STEP,
    "steps": {"gauss_newton.max_steps": 3},
    "damped": {"gauss_newton.max_steps": 3, "gauss_newton.damping": "levenberg_marquardt"},
}


def accepted(past_poses: str, features: str) -> Iterator[AlgorithmConfig]:
    """All algorithms that are accepted with a selection of poses and a feature policy."""
    from_outside = (
        past_poses in FROM_OUTSIDE or features in FROM_OUTSIDE
    )  # for these, one kind of step
    return combinations(
        values_of("cost.past_poses", (past_poses,)),
        values_of("cost.features", (features,)),
        *CHOICES,
        ONE_STEP if from_outside else STEPS,
        values_of("marginalization.first_estimates", (True,) if from_outside else (True, False)),
    )


COMPLETE = ("once", "every_step")
"""Feature policies that use every observation if no pose leaves."""


def throws_nothing_away(algorithm: AlgorithmConfig) -> bool:
    """Whether every measurement is used in the end."""
    cost = algorithm.cost
    return (
        cost.max_past_poses == MANY
        and cost.max_features_per_step >= POINTS
        and cost.features in COMPLETE
        and cost.past_poses != "keyframes"
    )


class Batch:
    """What all measurements up to a frame say, linearised by GTSAM at the truth."""

    frames, points = FRAMES, POINTS

    def __init__(self, mounted: Rig) -> None:
        self._mounted, self._points = mounted, room(self.points, np.random.default_rng(3))
        self._states, self.flown = exact_recording(mounted, self.frames, self._points)
        self.flown = self.recorded()
        self.start = self._states[0]
        self._roots: dict[int, tuple[list[slice], list[int], FloatArray]] = {}

    def recorded(self) -> list[Packet]:
        """What of the flight is recorded."""
        return self.flown

    def _root(self, frame: int) -> tuple[list[slice], list[int], FloatArray]:
        flown = self.flown[: frame + 1]
        graph, values = batch_problem(self.start, flown, self._mounted, self._points, self._states)
        keys = list(values.keys())
        ordering = gtsam.Ordering()
        for key in keys:
            ordering.push_back(key)
        A, _ = graph.linearize(values).jacobian(ordering)
        ends = np.cumsum([0, *dims_of(keys).values()]).tolist()
        R = np.linalg.qr(A, mode="r")
        inverse = solve_triangular(R, np.eye(len(R)))
        return [slice(a, b) for a, b in itertools.pairwise(ends)], keys, inverse

    def covariance(self, frame: int, keys: list[int]) -> FloatArray:
        """(n, n) over some variables."""
        if frame not in self._roots:
            self._roots[frame] = self._root(frame)
        slices, known, inverse = self._roots[frame]
        rows = np.concatenate([inverse[slices[known.index(key)]] for key in keys])
        return rows @ rows.T


@pytest.fixture(scope="module")
def batches() -> list[tuple[Rig, Batch]]:
    """With one camera and with two."""
    return [(mounted, Batch(mounted)) for mounted in (rig(1), rig(2))]


@pytest.mark.parametrize(
    "features", slow_but({"state", FROM_OUTSIDE[1]}, [*FEATURE_POLICIES, FROM_OUTSIDE[1]])
)
@pytest.mark.parametrize(
    "past_poses",
    slow_but({"most_recent", FROM_OUTSIDE[0]}, [*POSE_SELECTIONS, FROM_OUTSIDE[0]]),
)
def test_no_measurement_counts_twice(
    past_poses: str, features: str, batches: list[tuple[Rig, Batch]]
) -> None:
    faults: list[str] = []
    seen: Counter[str] = Counter()
    for number, algorithm in enumerate(accepted(past_poses, features)):
        mounted, truth = batches[number % 2]
        estimator = Estimator(mounted, algorithm, LOOSE)
        estimator.start(truth.start)
        for i, packet in enumerate(truth.flown):
            estimator.add_imu(packet.imu)
            state = estimator.add_frame(packet.frame)
            window = estimator.window
            assert state is not None
            assert window is not None
            if i not in CHECKED_FRAMES:
                continue
            keys = [X(k) for k in window.past] + [X(i), V(i), B(i)]
            # variances over those of the batch, in any direction
            ratios = eigvalsh(estimator.covariance_of(keys), truth.covariance(i, keys))
            seen["checked"] += 1
            if ratios[0] < 1.0 - TOLERANCE:
                faults.append(f"frame {i}: variance x {ratios[0]:.6f} under {algorithm}")
            complete = i == CHECKED_FRAMES[-1] and throws_nothing_away(algorithm)
            if complete:
                seen["complete"] += 1
                if ratios[-1] > 1.0 + TOLERANCE:
                    faults.append(f"frame {i}: variance x {ratios[-1]:.6f} under {algorithm}")
    assert seen["checked"] > 0
    assert seen["complete"] > 0 or past_poses == "keyframes" or features not in COMPLETE
    assert not faults, "\n".join(faults[:5]) + f"\n{len(faults)} of {seen['checked']}"
