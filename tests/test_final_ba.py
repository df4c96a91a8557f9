# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The bundle adjustment over a whole recording: exact, complete, never in the way."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count, pairwise
from pathlib import Path
from typing import Any
from weakref import WeakSet

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED
from flight import FISHEYE, rig

from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.smoothing import final_adjustment, recording_problem, segment_adjustment
from slam_graph.backend.smoothing.causal_outliers import causal_outliers
from slam_graph.backend.smoothing.final_adjustment import FinalBa, adjust_recording
from slam_graph.backend.smoothing.frame_log import FrameLog
from slam_graph.backend.smoothing.keyframe_states import state_at
from slam_graph.backend.smoothing.learned_imu_noise import _LinearImages
from slam_graph.backend.smoothing.recording_factors import nearest_keyframe
from slam_graph.backend.smoothing.segment_chain import segments
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.backend.smoothing.smoothing_task import SmoothingTask
from slam_graph.backend.smoothing.state_elimination import ChainEquations, EliminatedStates
from slam_graph.config import load_config
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.errors import EstimationError
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.pipeline.run_recording import run
from slam_graph.pipeline.smoothing import Smoothing
from slam_graph.results.run_result import RunResult
from slam_graph.sensors import FeatureFrame
from slam_graph.sensors.camera import Camera
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulation_config import (
    FlightConfig,
    LandmarkConfig,
    SimulatedGnssConfig,
    SimulatedImuConfig,
    SimulationConfig,
    TrackConfig,
)
from slam_graph.simulation.simulator import simulate

LENGTH_S = 8.0
DOUBLE_SPHERE = Camera(160.0, 160.0, 254.0, 256.0, "double_sphere", (-0.2, 0.55), 512, 512)
DEFAULT = FinalBaConfig()


def flight(cameras: int = 1, sigma: float = 0.0, **options: Any) -> SimulatedSequence:
    """A flight whose sensors are as noisy as `sigma` says, relative to real ones."""
    settings = {
        "cameras": cameras,
        "duration_s": LENGTH_S,
        "rate_hz": 10.0,
        "flight": FlightConfig(hover_s=0.0),
        "imu": SimulatedImuConfig(rate_hz=1000.0 if sigma == 0.0 else None, noise_scale=sigma),
        "landmarks": LandmarkConfig(density=10.0),
        "tracks": TrackConfig(features=40, pixel_sigma=sigma),
    }
    return simulate(SimulationConfig(**{**settings, **options}))


@dataclass(frozen=True)
class Kept:
    """The frames of a sequence as a run keeps them."""

    sequence: SimulatedSequence
    log: FrameLog

    @property
    def truth(self) -> Trajectory:
        truth = self.sequence.groundtruth()
        at = np.searchsorted(truth.stamps_ns, self.log.frames_ns)
        np.testing.assert_array_equal(truth.stamps_ns[at], self.log.frames_ns)
        return truth.select(at)

    def adjusted(
        self, causal: Trajectory, config: FinalBaConfig = DEFAULT, report: Any = None
    ) -> FinalBa:
        report = report or (lambda *_: None)
        return adjust_recording(
            self.log, causal, self.sequence.rig, BackendConfig(), config, report
        )


Keep = Callable[[SimulatedSequence], Kept]


@pytest.fixture
def keep(tmp_path: Path) -> Keep:
    def kept(sequence: SimulatedSequence) -> Kept:
        with FrameLog.recording(sequence.rig, DEFAULT, tmp_path) as log:
            for packet in sequence.packets():
                log.add(packet.imu, packet.frame, (1.0, 1.0), packet.aiding)
            log.georeferenced = sequence.aiding.fix_stamps_ns.size > 0
        return Kept(sequence, log)

    return kept


def disturbed(truth: Trajectory, seed: int = 0) -> Trajectory:
    """A trajectory with errors that a causal estimate may have; its first position has none."""
    rng = np.random.default_rng(seed)
    drift = np.cumsum(rng.normal(0.0, 0.005, (len(truth), 3)), axis=0)
    drift -= drift[0]
    assert truth.velocities is not None
    return Trajectory(
        truth.stamps_ns,
        truth.positions + drift,
        truth.quaternions,
        truth.velocities + rng.normal(0.0, 0.05, (len(truth), 3)),
        accel_biases=truth.accel_biases,
        gyro_biases=truth.gyro_biases,
    )


def worst_m(truth: Trajectory, estimate: Trajectory) -> float:
    return float(np.linalg.norm(truth.positions - estimate.positions, axis=1).max())


@pytest.mark.parametrize("cameras", [1, 2])
def test_without_noise_every_frame_is_exact(keep: Keep, cameras: int) -> None:
    kept = keep(flight(cameras))
    result = kept.adjusted(disturbed(kept.truth))
    np.testing.assert_array_equal(result.trajectory.stamps_ns, kept.log.frames_ns)
    assert worst_m(kept.truth, result.trajectory) < 1e-5
    assert ape(kept.truth, result.trajectory, "angle_deg").statistics.max < 1e-4
    alone = kept.adjusted(disturbed(kept.truth), FinalBaConfig(fuse_features=False))
    assert alone.summary.cost_after < 1e-9 * alone.summary.cost_before


def test_the_cost_before_and_after_is_one_quantity(keep: Keep) -> None:
    """It falls; one that begins at its own minimum gains only by points, which are triangulated
    without weights before it."""
    kept = keep(flight(sigma=1.0))
    found = kept.adjusted(disturbed(kept.truth))
    assert found.summary.cost_before > 2.0 * found.summary.cost_after
    again = kept.adjusted(found.trajectory).summary
    assert again.cost_after <= again.cost_before < 1.3 * again.cost_after


@pytest.mark.parametrize("camera", [FISHEYE, DOUBLE_SPHERE], ids=lambda c: c.distortion)
def test_wide_lenses_are_solved(keep: Keep, camera: Camera, tmp_path: Path) -> None:
    write_kalibr(rig(2, camera), tmp_path / "wide.yaml")
    kept = keep(flight(2, calibration=tmp_path / "wide.yaml"))
    result = kept.adjusted(disturbed(kept.truth))
    assert worst_m(kept.truth, result.trajectory) < 1e-5


def test_the_time_before_the_start_is_covered(keep: Keep) -> None:
    kept = keep(flight())
    late = disturbed(kept.truth).select(np.arange(len(kept.truth) // 2, len(kept.truth)))
    result = kept.adjusted(late)
    np.testing.assert_array_equal(result.trajectory.stamps_ns, kept.log.frames_ns)
    offset = result.trajectory.positions[len(kept.truth) // 2] - late.positions[0]
    assert np.linalg.norm(offset) < 1e-5  # it lives in the world of the causal estimate
    assert ape(kept.truth, result.trajectory, "trans_part", "yaw").statistics.max < 1e-5


def test_segments_join_to_one_trajectory(keep: Keep) -> None:
    kept = keep(flight(2, sigma=1.0))
    whole = kept.adjusted(kept.truth)
    config = FinalBaConfig(max_keyframes=20)
    steps: list[tuple[int, int, int]] = []
    cut = kept.adjusted(kept.truth, config, lambda *numbers: steps.append(numbers))
    assert cut.summary.segments > 1
    np.testing.assert_array_equal(cut.trajectory.stamps_ns, whole.trajectory.stamps_ns)
    assert worst_m(whole.trajectory, cut.trajectory) < 0.0135
    assert [step[2] for step in steps] == list(range(1, cut.summary.iterations + 1))
    assert worst_m(kept.truth, whole.trajectory) < 0.0215


def test_segments_in_the_world_of_fixes_know_those_of_all_others(keep: Keep) -> None:
    """Joined segments differ from one adjustment of all keyframes by a fraction of σ, in
    trajectory and covariances, and have no steps where they join."""
    gnss = SimulatedGnssConfig(sigma_m=0.02, rate_hz=5.0, multipath=0.0)
    kept = keep(flight(2, sigma=1.0, gnss=gnss))
    whole = kept.adjusted(kept.truth)
    cut = kept.adjusted(kept.truth, FinalBaConfig(max_keyframes=20))
    assert cut.summary.segments > 2
    away = cut.trajectory.positions - whole.trajectory.positions
    sigmas = whole.history.sigmas()[:, 3:6]
    assert np.sqrt(np.mean(away**2)) < 0.5 * np.sqrt(np.mean(sigmas**2))
    assert np.mean(cut.history.sigmas()[:, 3:6] / sigmas) == pytest.approx(1.0, abs=0.1)
    steps = np.linalg.norm(np.diff(away, axis=0), axis=1)
    assert steps.max() < 0.001


@pytest.mark.parametrize("failing", [1, 2, 3])
def test_a_segment_without_covariances_costs_no_other_one_its_states(
    keep: Keep, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    gnss = SimulatedGnssConfig(sigma_m=0.02, rate_hz=5.0)
    kept = keep(flight(2, sigma=1.0, gnss=gnss))
    covariances, number = recording_problem.with_covariances, count(1)

    def failed(*given: Any) -> Any:
        if next(number) == failing:
            raise np.linalg.LinAlgError
        return covariances(*given)

    monkeypatch.setattr(recording_problem, "with_covariances", failed)
    result = kept.adjusted(kept.truth, FinalBaConfig(max_keyframes=20, fuse_features=False))
    assert next(number) > 3
    np.testing.assert_array_equal(result.trajectory.stamps_ns, kept.log.frames_ns)
    known = np.isfinite(result.history.sigmas()[:, 3])
    assert 0 < np.sum(~known) < len(known)
    assert worst_m(kept.truth, result.trajectory) < 0.03


def test_there_is_one_factor_of_all_states_at_a_time(
    keep: Keep, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A segment of 600 keyframes has 120 MB of them, and as much of what images say."""
    living: WeakSet[EliminatedStates] = WeakSet()
    make, begin, numbers = _LinearImages.factor, EliminatedStates.__init__, list[int]()

    def made(self: _LinearImages, chain: ChainEquations) -> EliminatedStates:
        numbers.append(len(living))
        return make(self, chain)

    def begun(self: EliminatedStates, *given: Any) -> None:
        living.add(self)
        begin(self, *given)

    monkeypatch.setattr(_LinearImages, "factor", made)
    monkeypatch.setattr(EliminatedStates, "__init__", begun)
    kept = keep(flight(sigma=1.0))
    kept.adjusted(disturbed(kept.truth))
    assert numbers
    assert not any(numbers)


@pytest.mark.parametrize("keyframes", [3, 20, 21, 57, 100])
def test_segments_cover_all_keyframes_and_overlap(keyframes: int) -> None:
    ranges = list(segments(keyframes, 20))
    assert ranges[0][0] == 0
    assert ranges[-1][1] == keyframes
    assert all(stop - first <= 20 for first, stop in ranges)
    assert all(a[1] - b[0] >= 10 for a, b in pairwise(ranges))


def test_outliers_and_frames_without_features_are_survived(keep: Keep) -> None:
    tracks = TrackConfig(features=60, outliers=0.1, loss=0.05)
    kept = keep(flight(2, sigma=1.0, tracks=tracks))
    result = kept.adjusted(disturbed(kept.truth))
    assert ape(kept.truth, result.trajectory, "trans_part", "se3").statistics.rmse < 0.009


def test_frames_belong_to_the_keyframe_next_to_them() -> None:
    stamps = np.array([0, 10, 20, 30, 40, 50])
    assert nearest_keyframe(stamps, np.array([0, 4, 5])).tolist() == [0, 0, 0, 1, 1, 2]


# --- as the last stage of a run -------------------------------------------------------------------


@pytest.fixture(scope="module")
def demo() -> RunResult:
    return run(open_dataset("demo"), load_config(overrides=["duration_s=9", BELIEVED]))


@pytest.mark.slow
@pytest.mark.data
def test_it_is_better_than_the_causal_estimate_on_real_tracks(data_dir: Path) -> None:
    truth = data_dir / "euroc_inertial" / "V1_01_easy"
    result = run(open_dataset("demo", groundtruth=truth))
    table = result.metrics
    assert table["final_ba"]["frames"] == table["extent"]["frames"] == 601
    errors = [
        part["accuracy"]["se3"]["ate"]["translation_m"]["rmse"]
        for part in (table, {**table["final_ba"]})
        for part in ([part] if "accuracy" in part else [])
    ]
    assert errors[1] < 0.012
    assert errors[1] < errors[0]


def test_files_and_metrics_hold_it_and_the_causal_estimate_is_as_without(
    demo: RunResult, tmp_path: Path
) -> None:
    off = run(
        open_dataset("demo"),
        load_config(overrides=["duration_s=9", "final_ba.enabled=false", BELIEVED]),
    )
    for result, folder in ((demo, tmp_path / "on"), (off, tmp_path / "off")):
        result.save(folder)
    texts = [(tmp_path / name / "trajectory.tum").read_text() for name in ("on", "off")]
    assert texts[0] == texts[1]
    rows = (tmp_path / "on" / "trajectory_smoothed.tum").read_text().splitlines()
    assert len(rows) == demo.logs.frames == demo.metrics["final_ba"]["frames"]
    assert not (tmp_path / "off" / "trajectory_smoothed.tum").exists()
    assert off.metrics["final_ba"] is None
    assert demo.final_ba is not None
    first = int(np.searchsorted(demo.final_ba.trajectory.stamps_ns, demo.trajectory.stamps_ns[0]))
    moved = demo.final_ba.trajectory.positions[first] - demo.trajectory.positions[0]
    assert np.linalg.norm(moved) < 1e-9


@pytest.mark.parametrize(
    "fault", [RuntimeError("singular"), OSError("disk full"), KeyboardInterrupt(), KeyError("slip")]
)
def test_a_failure_leaves_the_causal_estimate_and_one_warning(
    fault: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> Iterator[tuple[int, int]]:
        raise fault

    monkeypatch.setattr(final_adjustment, "segments", broken)
    result = run(open_dataset("demo"), load_config(overrides=["duration_s=3", "min_coverage=0.1"]))
    interrupted = isinstance(fault, KeyboardInterrupt)
    assert result.status == ("interrupted" if interrupted else "ok")
    assert len(result.history) > 0
    assert result.final_ba is None
    assert result.warnings["final_ba_failed"] == 1


@pytest.mark.parametrize("still_apart", [False, True])
def test_a_minimum_that_contradicts_the_causal_estimate_does_not_go_unsaid(
    still_apart: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is sought again with what fits that estimate; where it does not help, it is said."""
    adjusted, asked = FinalBa.of_worlds, list[bool]()

    def bent(*arguments: Any) -> FinalBa | None:
        found = adjusted(*arguments)
        asked.append(arguments[-1])
        if found is None or (asked[-1] and not still_apart):
            return found
        path, history = found.trajectory, found.history.like()
        covariance = np.diag(np.full(15, 1e-6))
        for k in range(len(path)):
            state = state_at(path, k)
            pose = state.world_T_body.compose(gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * k, 0, 0])))
            history.append(replace(state, world_T_body=pose, covariance=covariance))
        return replace(found, history=history)

    monkeypatch.setattr(FinalBa, "of_worlds", bent)
    result = run(flight(2, 1.0, duration_s=4.0), min_coverage=0.1)
    assert asked == [False, True]
    assert result.warnings["smoothed_contradicts"] == still_apart


@pytest.mark.parametrize("fault", [RuntimeError("singular"), KeyboardInterrupt()])
def test_a_failure_of_the_second_adjustment_leaves_the_first_one_and_says_so(
    fault: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After Ctrl-C, where nothing more is said, there is none."""
    adjusted, first = FinalBa.of_worlds, list[FinalBa | None]()

    def failing(*arguments: Any) -> FinalBa | None:
        if arguments[-1]:
            raise fault
        first.append(adjusted(*arguments))
        return first[-1]

    monkeypatch.setattr(FinalBa, "of_worlds", failing)
    monkeypatch.setattr(Smoothing, "_contradiction", lambda *_: (True, ["it is apart"]))
    result = run(flight(2, 1.0, duration_s=4.0), min_coverage=0.1)
    interrupted = isinstance(fault, KeyboardInterrupt)
    assert result.status == ("interrupted" if interrupted else "ok")
    assert first[0] is not None
    assert result.final_ba is (None if interrupted else first[0])
    assert result.warnings["final_ba_failed"] == interrupted
    assert result.warnings["smoothed_contradicts"] > 0


def test_what_does_not_fit_the_causal_trajectory_is_what_moves(keep: Keep) -> None:
    """A box that rotates and glides by; a feature that one frame alone sees says nothing."""
    kept = keep(flight(2, sigma=1.0, objects={"count": 1, "masks": True}))
    on_box, frames = set[int](), Counter[int]()
    for packet in kept.sequence.packets():
        assert isinstance(packet.frame, FeatureFrame)
        seen = packet.frame.cameras[0]
        assert seen.labels is not None
        on_box.update(seen.ids[seen.labels > 0].tolist())
        frames.update(seen.ids.tolist())
    long = {track for track, count in frames.items() if count > 5}
    task = SmoothingTask.of(kept.sequence.rig, BackendConfig(), DEFAULT)
    found = set(causal_outliers(kept.log, kept.truth, task).tolist())
    assert len(found & on_box & long) > 0.8 * len(on_box & long) > 5
    assert len((found & long) - on_box) < 0.03 * len(long - on_box)
    nothing = kept.truth.select(np.zeros(len(kept.truth), np.bool_))
    assert not len(causal_outliers(kept.log, nothing, task))


def test_where_there_is_nothing_to_gain_the_causal_estimate_is_left_alone() -> None:
    """The recording stands still at first, so that nothing can be triangulated."""
    config = load_config(overrides=["duration_s=1.5", "min_coverage=0"])
    result = run(open_dataset("demo"), config)
    assert result.status == "ok"
    assert len(result.history) > 0
    assert result.final_ba is None
    assert "final_ba_failed" not in result.warnings


def test_what_the_images_do_not_confirm_is_refused(
    keep: Keep, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = keep(flight(2, sigma=1.0))
    monkeypatch.setattr(segment_adjustment, "MAX_PIXEL_RESIDUAL", 0.5)
    with pytest.raises(EstimationError, match="do not fit"):
        kept.adjusted(kept.truth)
