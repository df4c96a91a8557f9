# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Tracks against the reported poses: true ones fit, wrong velocities do not, jumps are found."""

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.track_fit import Fit, TrackFit
from slam_graph.datasets import RecordedSequence
from slam_graph.datasets.faults.injection import inject
from slam_graph.geometry import NavState, interpolate
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors import FeatureFrame
from slam_graph.simulation.simulator import simulate

Shift = Callable[[float], FloatArray]
NONE = np.zeros(0, np.int64)
JUMP_S = 3.02


@pytest.fixture(scope="module", params=[1, 2])
def flight(request: pytest.FixtureRequest) -> RecordedSequence:
    return simulate(trajectory="figure8", cameras=request.param, duration_s=6.0, seed=2)


def still(_: float) -> FloatArray:
    return np.zeros(3)


def fits(
    flight: RecordedSequence, shift: Shift, scale: float = 1.0, measured: Shift | None = None
) -> list[Fit]:
    """Fits along the true flight, displaced by a function of the time in s.

    Args:
        flight: with its tracks.
        shift: of the reported poses.
        scale: standard deviation of the observations.
        measured: what of it the IMU has measured; not known if not given.
    """
    truth = flight.groundtruth()
    assert truth is not None
    frames = [f for f in flight.frames() if isinstance(f, FeatureFrame)]
    stamps = np.array([frame.stamp_ns for frame in frames])
    near, valid = interpolate(truth, stamps)
    track_fit, found = TrackFit(scale), []
    before_s = 0.0
    for k, frame in enumerate(np.array(frames, object)[valid]):
        t = (frame.stamp_ns - stamps[0]) * 1e-9
        pose = gtsam.Pose3(near.pose(k).rotation(), near.positions[k] + shift(t))
        state = NavState(
            frame.stamp_ns, pose, np.zeros(3), accel_bias=np.zeros(3), gyro_bias=np.zeros(3)
        )
        predicted = None
        if measured is not None:
            corrected = shift(t) - shift(before_s) - (measured(t) - measured(before_s))
            predicted = gtsam.Pose3(pose.rotation(), pose.translation() - corrected)
        before_s = t
        fit = track_fit.add(state, frame, flight.rig, scale, NONE, None, predicted)
        if fit is not None:
            found.append(fit)
    return found


def share(found: list[Fit]) -> float:
    return sum(fit.unfit for fit in found) / sum(fit.tested for fit in found)


def test_tracks_fit_the_true_motion(flight: RecordedSequence) -> None:
    found = fits(flight, lambda _: np.zeros(3))
    assert sum(fit.tested for fit in found) > 200
    assert share(found) < 0.02
    assert not any(fit.jumped for fit in found)


def test_tracks_do_not_fit_a_wrong_velocity(flight: RecordedSequence) -> None:
    """An even velocity, of which one camera sees only what is across its rays."""
    found = fits(flight, lambda t: np.array([0.3, 0.0, 0.8]) * t)
    assert share(found) > 0.5
    assert not any(fit.jumped for fit in found)


def test_a_jump_is_found_once_and_only_where_it_is(flight: RecordedSequence) -> None:
    found = fits(flight, lambda t: np.array([0.5, -0.3, 0.4]) * (t > JUMP_S))
    at = [k for k, fit in enumerate(found) if fit.jumped]
    assert len(at) == 1
    step_s = 6.0 / len(found)
    assert JUMP_S < (at[0] + 1) * step_s < JUMP_S + 1.3


def test_an_estimate_that_corrects_itself_does_not_jump(flight: RecordedSequence) -> None:
    """The IMU has measured nothing of it."""

    def shift(t: float) -> FloatArray:
        return np.array([0.5, -0.3, 0.4]) * (t > JUMP_S)

    assert not any(fit.jumped for fit in fits(flight, shift, measured=still))
    assert sum(fit.jumped for fit in fits(flight, shift, measured=shift)) == 1


def test_a_pose_that_is_wrong_for_a_moment_is_no_jump(flight: RecordedSequence) -> None:
    found = fits(flight, lambda t: np.array([0.5, -0.3, 0.4]) * (JUMP_S < t < JUMP_S + 0.4))
    assert not any(fit.jumped for fit in found)


def driven(seed: int, duration_s: float) -> RecordedSequence:
    """With an IMU, and fixes that are more uncertain than the motion over a second."""
    return simulate(
        trajectory="car",
        seed=seed,
        duration_s=duration_s,
        rate_hz=10.0,
        tracks={"features": 60},
        gnss={"sigma_m": 1.0, "rate_hz": 2.0},
    )


def test_what_fixes_correct_is_no_contradiction() -> None:
    """Poses that were reported jump by decimetres with each of the first fixes."""
    result = run(driven(6, 11.0), overrides=["final_ba.enabled=false", BELIEVED])
    assert result.status == "ok"
    assert result.georeferenced
    assert len(result.segments) == 1


@pytest.mark.slow
def test_a_loss_is_noticed_though_fixes_correct_the_poses() -> None:
    kidnapped = inject(driven(8, 20.0), ["kidnapped:at_s=12,duration_s=2"])
    result = run(kidnapped, overrides=["final_ba.enabled=false"])
    ((begin_ns, _),) = result.segments.losses
    assert 10.5 < (begin_ns - result.input.start_ns) * 1e-9 < 14.5
