# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""NEES after an alignment: the covariance is that of what the alignment leaves.

On a linear problem whose causal and smoothed estimates are optimal: poses with measurements between
neighbours and between poses that are further apart, so that later data improve earlier poses.
"""

from dataclasses import dataclass
from typing import cast

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, skew
from slam_graph.backend.smoothing.adjustment_figures import FinalBaSummary
from slam_graph.backend.smoothing.final_adjustment import FinalBa
from slam_graph.backend.world_gauge import gauge_motion
from slam_graph.evaluation.alignment_covariance import aligned_by_smoothed
from slam_graph.evaluation.consistency import mean_bounds
from slam_graph.evaluation.evaluation_report import nees_of_run
from slam_graph.geometry.state_history import StateHistory
from slam_graph.geometry.trajectory import NavState, Trajectory

POSES, FAR, DRAWS = 20, 6, 300
SPACING_NS, BEGIN_NS = 50_000_000, 1_000_000_000
SIGMAS = np.array([1e-3, 1e-3, 2e-3, 4e-3, 4e-3, 2e-3])
"""Of a measurement between neighbours, and of roll, pitch and nothing else of the first pose."""
FIXED = 1e-7
FALSE_ALARMS = 1e-4


@dataclass(frozen=True, eq=False)
class Problem:
    """Errors (6 POSES) of all poses, with axes of the world, and whitened measurements of them."""

    truth: Trajectory
    rows: FloatArray
    known: tuple[int, ...]
    """Rows known when each pose is estimated."""

    @staticmethod
    def random(rng: np.random.Generator) -> "Problem":
        stamps = BEGIN_NS + SPACING_NS * np.arange(POSES)
        positions = np.cumsum(rng.normal(0.0, 0.5, (POSES, 3)), axis=0)
        truth = Trajectory(stamps, positions, Rotation.random(POSES, random_state=1).as_quat())
        first = np.zeros((6, 6 * POSES))
        first[:, :6] = np.diag(1.0 / np.where(np.arange(6) < 2, SIGMAS, FIXED))
        rows, known = [first], []
        for k in range(POSES):
            for since, noise in ((1, 1.0), (FAR, 0.7)):
                if k >= since:
                    rows.append(between(positions, k - since, k) / (noise * SIGMAS[:, None]))
            known.append(6 * len(rows))
        return Problem(truth, np.vstack(rows), tuple(known))

    def gains(self, k: int) -> tuple[FloatArray, FloatArray]:
        """From noise to the errors of poses 0 to k, as known at pose k, and their covariance."""
        J = self.rows[: self.known[k], : 6 * (k + 1)]
        P = np.linalg.inv(J.T @ J)
        return P @ J.T, np.asarray(P, dtype=np.float64)

    def in_body(self, k: int, P: FloatArray) -> FloatArray:
        R = Rotation.from_quat(self.truth.quaternions[k]).as_matrix()
        turn = np.kron(np.eye(2), R)
        return np.asarray(turn.T @ P @ turn)

    def history(self, errors: FloatArray, covariances: list[FloatArray]) -> StateHistory:
        """States with errors (POSES, 6), truth less estimate, and covariances in the body."""
        history = StateHistory()
        for k, (e, P) in enumerate(zip(errors, covariances, strict=True)):
            turn = Rotation.from_rotvec(-e[:3]) * Rotation.from_quat(self.truth.quaternions[k])
            pose = gtsam.Pose3(gtsam.Rot3(turn.as_matrix()), self.truth.positions[k] - e[3:])
            whole = np.eye(15)
            whole[:6, :6] = P
            zero = np.zeros(3)
            stamp_ns = int(self.truth.stamps_ns[k])
            history.append(
                NavState(stamp_ns, pose, zero, accel_bias=zero, gyro_bias=zero, covariance=whole)
            )
        return history

    def after_alignment(self, P: FloatArray) -> FloatArray:
        """The (POSES, 6, 6) covariances that an alignment of positions leaves, by projection."""
        positions = self.truth.positions
        N = gauge_motion(positions - positions.mean(axis=0)).reshape(-1, 4)
        W = np.where(np.arange(6 * POSES)[:, None] % 6 < 3, 0.0, N)
        T = np.eye(6 * POSES) - N @ np.linalg.solve(W.T @ W, W.T)
        P = T @ P @ T.T
        own = [slice(6 * k, 6 * k + 6) for k in range(POSES)]
        return np.array([self.in_body(k, P[rows, rows]) for k, rows in enumerate(own)])


def between(positions: FloatArray, i: int, j: int) -> FloatArray:
    """How the error of pose j differs from what that of pose i makes of it, as rows."""
    rows = np.zeros((6, 6 * len(positions)))
    rows[:, 6 * j : 6 * j + 6] = np.eye(6)
    rows[:, 6 * i : 6 * i + 6] = -np.eye(6)
    rows[3:, 6 * i : 6 * i + 3] = skew((positions[j] - positions[i])[None])[0]
    return rows


@pytest.fixture(scope="module")
def drawn() -> dict[str, FloatArray]:
    """NEES (DRAWS, POSES) of orientation and position, causal and smoothed."""
    rng = np.random.default_rng(4)
    problem = Problem.random(rng)
    steps = [problem.gains(k) for k in range(POSES)]
    whole, P = steps[-1]
    own = [slice(6 * k, 6 * k + 6) for k in range(POSES)]
    causal = [problem.in_body(k, steps[k][1][own[k], own[k]]) for k in range(POSES)]
    smooth = [problem.in_body(k, P[own[k], own[k]]) for k in range(POSES)]
    aligned, found = problem.after_alignment(P), []
    for _ in range(DRAWS):
        noise = rng.normal(size=len(problem.rows))
        errors = [steps[k][0][own[k]] @ noise[: problem.known[k]] for k in range(POSES)]
        history = problem.history(np.array(errors), causal)
        best = problem.history((whole @ noise).reshape(-1, 6), smooth)
        final_ba = FinalBa(best, cast(FinalBaSummary, None), aligned)
        for states, smoothed in ((history, final_ba), (best, final_ba), (history, None)):
            result, alignment = nees_of_run(problem.truth, states, False, smoothed)
            assert alignment == ("first_pose" if smoothed is None else "yaw")
            found.append((result.orientation, result.position))
    return {
        f"{name}.{part}": np.array([pair[column] for pair in found[start::3]])
        for start, name in enumerate(("causal", "smoothed", "first_pose"))
        for column, part in enumerate(("orientation", "position"))
    }


@pytest.mark.parametrize("part", ["orientation", "position"])
@pytest.mark.parametrize("name", ["causal", "smoothed", "first_pose"])
def test_errors_after_alignment_are_as_large_as_the_covariances_say(
    drawn: dict[str, FloatArray], name: str, part: str
) -> None:
    """At every pose; under `first_pose` from the second on, as the first defines the world."""
    means = drawn[f"{name}.{part}"].mean(axis=0)[1 if name == "first_pose" else 0 :]
    low, high = mean_bounds(3, DRAWS, 1.0 - FALSE_ALARMS)
    assert np.all((means > low) & (means < high)), means


def test_a_smoothed_covariance_that_is_none_is_left_out() -> None:
    problem = Problem.random(np.random.default_rng(4))
    own = [slice(6 * k, 6 * k + 6) for k in range(POSES)]
    _, P = problem.gains(POSES - 1)
    smooth = [problem.in_body(k, P[own[k], own[k]]) for k in range(POSES)]
    aligned = problem.after_alignment(P)
    causal = problem.history(np.zeros((POSES, 6)), smooth)
    smooth[-1] = smooth[-1] - 2 * np.linalg.eigvalsh(smooth[-1])[0] * np.eye(6)
    best = problem.history(np.zeros((POSES, 6)), smooth)
    found = aligned_by_smoothed(
        problem.truth, causal, FinalBa(best, cast(FinalBaSummary, None), aligned)
    )
    assert found is not None
    assert np.isfinite(found[1]).all(axis=(1, 2)).tolist() == [True] * (POSES - 1) + [False]
