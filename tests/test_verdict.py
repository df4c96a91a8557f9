# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The verdict on a run: a wrong calibration does not end `ok`, a right one does."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from groups import slow
from typer.testing import CliRunner

from benchmarks.wrong_setups import WronglySetUp, focal_length
from slam_graph.cli.main import app
from slam_graph.datasets import kalibr_text
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.faults.injection import inject
from slam_graph.datasets.memory_sequence import dataset_from_arrays
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.diagnosis import Diagnosis, run_evidence
from slam_graph.diagnostics import Diagnostics
from slam_graph.pipeline import clock_watch, recovery, run_doubts, verdict
from slam_graph.pipeline.run_recording import run
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations
from slam_graph.sensors.rig import Rig, RigCamera
from slam_graph.simulation.simulator import simulate

CAUSAL = ("final_ba.enabled=false",)
RATE_HZ = 10.0
"""Of the frames of simulated flights: half as many as usual tell the same, in half the time."""


def changed(rig: Rig, change: Callable[[RigCamera], RigCamera], first: int = 0) -> Rig:
    """A rig whose cameras from one number on are changed."""
    cameras = [c if k < first else change(c) for k, c in enumerate(rig.cameras)]
    return Rig(tuple(cameras), rig.imu)


def with_double_baseline(rig: Rig) -> Rig:
    origin = rig.cameras[0].body_T_camera.translation()

    def away(camera: RigCamera) -> RigCamera:
        pose = camera.body_T_camera
        place = origin + 2.0 * (pose.translation() - origin)
        return replace(camera, body_T_camera=gtsam.Pose3(pose.rotation(), place))

    return changed(rig, away, 1)


def with_longer_lenses(rig: Rig, factor: float = 1.1) -> Rig:
    def longer(camera: RigCamera) -> RigCamera:
        lens = camera.camera
        return replace(camera, camera=replace(lens, fx=factor * lens.fx, fy=factor * lens.fy))

    return changed(rig, longer)


def turned(rig: Rig, degrees: float = 5.0) -> Rig:
    turn = gtsam.Pose3(gtsam.Rot3.Rx(np.deg2rad(degrees)), np.zeros(3))
    return changed(rig, lambda c: replace(c, body_T_camera=turn * c.body_T_camera))


def inverted(rig: Rig) -> Rig:
    return changed(rig, lambda c: replace(c, body_T_camera=c.body_T_camera.inverse()))


def exchanged(rig: Rig) -> Rig:
    return Rig((rig.cameras[1], rig.cameras[0]), rig.imu)


def flown(
    wrong: Callable[[Rig], Rig] = lambda rig: rig,
    gyro: float = 1.0,
    accel: float = 1.0,
    duration_s: float = 16.0,
    trajectory: str = "random",
) -> RecordedSequence:
    """A flight without a start that is given, with a wrong calibration or IMU."""
    sequence = simulate(
        trajectory=trajectory,
        duration_s=duration_s,
        rate_hz=RATE_HZ,
        seed=3,
        flight={"hover_s": 0.0},
    )
    return seen_by(sequence, wrong(sequence.rig), gyro, accel)


def seen_by(
    sequence: RecordedSequence, rig: Rig, gyro: float = 1.0, accel: float = 1.0
) -> RecordedSequence:
    """The recording under another calibration, and with factors on what the IMU measures."""
    imu, frames = sequence.imu(), []
    for frame in sequence.frames():
        assert isinstance(frame, FeatureFrame)
        seen = zip(frame.cameras, rig.cameras, strict=True)
        cameras = [replace(s, normalized=c.camera.undistort(s.pixels)) for s, c in seen]
        frames.append(FeatureFrame(frame.stamp_ns, tuple(cameras)))
    return dataset_from_arrays(
        rig,
        imu_stamps_ns=imu.stamps_ns,
        gyro=gyro * imu.gyro,
        accel=accel * imu.accel,
        features=frames,
        groundtruth=sequence.groundtruth(),
    )


@pytest.mark.data
@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (with_double_baseline, "calibrated baseline is"),
        slow(with_longer_lenses, "calibrated focal length is"),
        slow(exchanged, "the cameras are exchanged"),
    ],
)
def test_a_wrong_calibration_is_suspect(
    wrong: Callable[[Rig], Rig], named: str, data_dir: Path, tmp_path: Path
) -> None:
    recording = data_dir / "euroc" / "MH_01_easy_17s"
    calibration = tmp_path / "wrong.yaml"
    calibration.write_text(kalibr_text(wrong(open_dataset(recording).rig)), encoding="utf-8")
    done = CliRunner().invoke(
        app,
        [
            *("run", str(recording), "--calibration", str(calibration), "--no-final-ba"),
            *("--no-progress", "--duration", "7", "--output", str(tmp_path)),
        ],
    )
    assert done.exit_code == 4, done.output
    assert named in done.stderr
    assert "slam-graph doctor" in done.stderr


@pytest.mark.parametrize(
    ("trajectory", "seed", "cameras"), [("figure8", 2, 2), slow("random", 3, 1)]
)
def test_a_right_one_is_not_even_if_it_is_doubted(
    trajectory: str, seed: int, cameras: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_doubts, "_MAX_REJECTED", -1.0)  # every run is diagnosed
    sequence = simulate(
        trajectory=trajectory, cameras=cameras, duration_s=10.0, rate_hz=RATE_HZ, seed=seed
    )
    result = run(sequence, overrides=CAUSAL)
    assert result.status == "ok", result.message


@pytest.mark.slow
def test_a_fault_that_nothing_in_the_run_shows_is_suspect() -> None:
    result = run(flown(lambda rig: with_longer_lenses(rig, 1.1)), overrides=CAUSAL)
    assert result.status == "suspect", result.message
    assert "calibrated focal length is 1." in result.message


def test_a_failure_of_the_clock_watch_costs_no_diagnosis(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: object) -> Diagnosis:
        raise ValueError("no clocks")

    monkeypatch.setattr(clock_watch.ClockWatch, "finish", fails)
    settings = (*CAUSAL, "min_coverage=0.1")
    result = run(flown(with_longer_lenses, duration_s=10.0), overrides=settings)
    assert result.warnings["diagnosis_failed"] == 1
    assert result.status == "suspect", result.message
    assert "calibrated focal length is 1." in result.message


@pytest.mark.parametrize("wrong", [slow(lambda rig: rig), slow(with_longer_lenses), turned])
def test_a_quick_diagnosis_says_what_the_whole_diagnosis_says(wrong: Callable[[Rig], Rig]) -> None:
    """Where the calibration is right or nearly so; there is nothing else that it is for."""
    recording = flown(wrong)
    frames = [f for f in recording.frames() if isinstance(f, FeatureFrame)]
    of = recording.rig, frames, recording.imu()
    quick, whole = Diagnosis.nearby(*of), Diagnosis.of_tracks(*of)
    kinds = [[f.kind for f in found.setup_faults] for found in (quick, whole)]
    assert kinds[0] == kinds[1]


@pytest.mark.parametrize(
    ("recording", "named"),
    [
        slow(lambda: flown(gyro=float(np.rad2deg(1.0))), "its unit is degrees/s"),
        (lambda: flown(inverted), "the calibration is inverted"),
    ],
)
def test_a_wrong_setup_that_never_starts_is_refused_soon(
    recording: Callable[[], RecordedSequence], named: str
) -> None:
    result = run(recording(), overrides=CAUSAL)
    assert result.status == "failed"
    assert named in result.message
    assert "slam-graph doctor" in result.message
    waited_s = result.logs.frames / RATE_HZ
    assert waited_s < 11.0, "at the second look at the latest"


def test_nothing_is_refused_if_that_is_not_wanted() -> None:
    recording = flown(gyro=float(np.rad2deg(1.0)), duration_s=8.0)
    result = run(recording, overrides=(*CAUSAL, "limits.refuse_wrong_setup=false"))
    assert result.status == "not_initialized"
    assert "its unit is degrees/s" in result.message


def test_a_right_setup_that_waits_is_not_refused() -> None:
    """It has too few features for a start, and moves enough to show a fault."""
    sequence = simulate(
        trajectory="random",
        duration_s=12.0,
        rate_hz=RATE_HZ,
        seed=3,
        flight={"hover_s": 0.0},
        tracks={"features": 8},
    )
    result = run(sequence, overrides=(*CAUSAL, "backend.initialization.mode=motion"))
    assert result.status == "not_initialized", result.message


def test_an_accelerometer_in_g_does_not_end_well() -> None:
    """A start at rest would take gravity for whatever is measured."""
    sequence = simulate(trajectory="figure8", duration_s=10.0, rate_hz=RATE_HZ, seed=1)
    imu = sequence.imu()
    recording = dataset_from_arrays(
        sequence.rig,
        imu_stamps_ns=imu.stamps_ns,
        gyro=imu.gyro,
        accel=imu.accel / 9.81,
        features=[f for f in sequence.frames() if isinstance(f, FeatureFrame)],
    )
    result = run(recording, overrides=CAUSAL)
    assert result.status != "ok"
    assert "its unit is g" in result.message


def test_a_failed_run_names_the_likeliest_cause() -> None:
    sequence = simulate(trajectory="figure8", cameras=2, duration_s=10.0, rate_hz=RATE_HZ, seed=1)
    sequence.rig = changed(
        sequence.rig, lambda camera: replace(camera, body_T_camera=camera.body_T_camera.inverse())
    )
    result = run(sequence, overrides=(*CAUSAL, "limits.refuse_wrong_setup=false"))
    assert result.status in ("not_initialized", "diverged", "low_coverage")
    assert "slam-graph doctor says: the camera is turned" in result.message
    assert "likeliest cause" not in result.message, "it would contradict what is certain"


@pytest.mark.parametrize("fault", [slow("extrinsics"), "gyroscope"])
def test_a_wrong_setup_that_starts_is_refused_where_its_estimate_is_lost(fault: str) -> None:
    """A start at rest shows nothing of it."""
    sequence = simulate(trajectory="figure8", cameras=2, duration_s=20.0, rate_hz=RATE_HZ, seed=1)
    rig = inverted(sequence.rig) if fault == "extrinsics" else sequence.rig
    axes, imu = [0, 1, 2] if fault == "extrinsics" else [1, 0, 2], sequence.imu()
    recording = dataset_from_arrays(
        rig,
        imu_stamps_ns=imu.stamps_ns,
        gyro=imu.gyro[:, axes],
        accel=imu.accel,
        features=[f for f in sequence.frames() if isinstance(f, FeatureFrame)],
    )
    result = run(recording, overrides=CAUSAL)
    assert result.status == "failed"
    assert result.message.startswith("the estimate was lost"), result.message
    assert "slam-graph doctor" in result.message
    assert not result.segments.lasted
    assert result.logs.frames / RATE_HZ < 11.0


def test_a_good_run_is_diagnosed_at_its_end_only(monkeypatch: pytest.MonkeyPatch) -> None:
    after, nearby = list[int](), verdict.Verdict._nearby

    def counted(judged: verdict.Verdict, rig: Rig) -> Diagnosis:
        after.append(judged._result.logs.frames)
        return nearby(judged, rig)

    monkeypatch.setattr(verdict.Verdict, "_nearby", counted)
    sequence = simulate(trajectory="figure8", cameras=2, duration_s=8.0, rate_hz=RATE_HZ, seed=2)
    result = run(sequence, overrides=CAUSAL)
    assert result.status == "ok", result.message
    assert after == [result.logs.frames]


def test_a_wrong_setup_is_refused_six_seconds_after_its_start_where_that_is_enough() -> None:
    sequence = simulate(trajectory="figure8", cameras=2, duration_s=14.0, rate_hz=RATE_HZ, seed=1)
    result = run(seen_by(sequence, with_double_baseline(sequence.rig)), overrides=CAUSAL)
    assert result.status == "failed"
    assert "the estimate is wrong: the calibrated baseline is" in result.message
    begun_s = (result.segments[0].begin_ns - result.input.start_ns) * 1e-9
    assert 6.0 <= result.logs.frames / RATE_HZ - begun_s < 7.0


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(
    ("algorithm", "wrong", "named", "after_s"),
    [
        ("msckf", partial(with_longer_lenses, factor=1.3), "calibrated focal length is", 12.0),
        ("okvis", partial(turned, degrees=10.0), "the camera is turned by", 12.0),
        ("msckf", partial(turned, degrees=10.0), "the camera is turned by", 24.0),
    ],
)
def test_a_wrong_setup_under_which_an_estimate_lasts_is_refused_after_some_seconds(
    algorithm: str,
    wrong: Callable[[Rig], Rig],
    named: str,
    after_s: float,
    data_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not at the end of a recording that may be long; by a later diagnosis if none is before."""
    later = tuple(ns for ns in verdict._EARLY_CHECKS_NS if ns >= after_s * 1e9)
    monkeypatch.setattr(verdict, "_EARLY_CHECKS_NS", later)
    path = data_dir / "euroc_inertial/V2_01_easy"
    sequence = simulate(
        trajectory=str(path), real_imu=True, cameras=1, duration_s=40.0, rate_hz=RATE_HZ, seed=0
    )
    recording = seen_by(sequence, wrong(sequence.rig))
    result = run(recording, algorithm=algorithm, overrides=CAUSAL)
    assert result.status == "failed"
    assert named in result.message
    begun_s = (result.segments[0].begin_ns - result.input.start_ns) * 1e-9
    assert after_s - 1.0 < result.logs.frames / RATE_HZ - begun_s < after_s + 1.0


@pytest.mark.slow
@pytest.mark.data
def test_a_start_that_is_corrected_under_a_wrong_lens_is_diagnosed_at_once(data_dir: Path) -> None:
    recording = open_dataset(data_dir / "euroc/MH_01_easy_17s")
    longer = WronglySetUp(recording, focal_length(1.3))
    result = run(longer, algorithm="okvis", overrides=CAUSAL)
    assert result.status == "failed"
    assert "the estimate is wrong: the calibrated focal length is" in result.message
    assert result.warnings["start_corrected"] == 1
    begun_s = (result.segments[0].begin_ns - result.input.start_ns) * 1e-9
    assert result.logs.frames / 20.0 - begun_s < 1.0  # of the start that was solved again


@pytest.mark.parametrize("at_s", [slow(2.5), 4.5])
def test_a_good_flight_that_is_lost_soon_is_not_refused(at_s: float) -> None:
    """Whatever happened then, the calibration does not explain it."""
    flight = simulate(trajectory="figure8", cameras=2, duration_s=14.0, rate_hz=RATE_HZ, seed=2)
    result = run(inject(flight, [f"kidnapped:at_s={at_s},duration_s=2.5"]), overrides=CAUSAL)
    assert result.segments.lost
    assert result.status == "ok", result.message


@pytest.mark.parametrize(
    ("duration_s", "faults"),
    [
        (8.0, ["imu_zeros:at_s=4,duration_s=1", "frames_dropped:at_s=6,duration_s=0.5"]),
        slow(9.0, ["frames_dropped:at_s=6.6,duration_s=0.7", "gyro_outlier:at_s=3.5"]),
    ],
)
def test_faults_that_leave_little_to_compare_make_no_calibration_wrong(
    duration_s: float, faults: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A standstill and seconds of motion: other mountings and axes fit, the given ones too."""
    monkeypatch.setattr(run_doubts, "_MAX_REJECTED", -1.0)  # every run is diagnosed
    recording = open_dataset("demo", faults=faults)
    result = run(recording, overrides=CAUSAL, duration_s=duration_s)
    assert result.status in ("ok", "low_coverage"), result.message  # a take-off without IMU


@pytest.mark.parametrize("with_imu", [True, slow(False)])
def test_a_run_that_contradicts_itself_is_suspect(
    monkeypatch: pytest.MonkeyPatch, with_imu: bool
) -> None:
    """The message says what shows, if the diagnosis finds nothing. Without an IMU nothing shows."""
    monkeypatch.setattr(run_evidence, "MOST_SHIFT", 0.01)
    monkeypatch.setattr(run_evidence, "USUAL_SHIFT", 0.01)
    monkeypatch.setattr(run_evidence, "USUAL_NOISE_AT_LIMIT", -1.0)
    sequence = simulate(cameras=2, duration_s=6.0, rate_hz=RATE_HZ, seed=2, with_imu=with_imu)
    result = run(sequence, algorithm="msckf")
    assert result.status == ("suspect" if with_imu else "ok")
    assert ("away from the causal one" in result.message) == with_imu
    assert result.evidence is not None
    assert (result.evidence["position_shift"] is not None) == with_imu


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["limits.recovery=false", "the segment is too short"])
def test_what_follows_the_loss_that_ends_a_run_is_not_compared(
    ending: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The platform is somewhere else then, which no calibration explains."""
    asked: list[list[tuple[int, int]]] = []
    diagnose = Diagnosis.of_tracks

    def noted(*arguments: Any) -> Diagnosis:
        asked.append(list(arguments[4]))
        return diagnose(*arguments)

    monkeypatch.setattr(Diagnosis, "of_tracks", noted)
    monkeypatch.setattr(recovery, "_MOST_SHORT", 1)
    jump_s = 4.5
    flight = simulate(trajectory="figure8", cameras=2, duration_s=12.0, seed=1)
    jumped = inject(flight, [f"kidnapped:at_s={jump_s},duration_s=2.5"])
    settings = (*CAUSAL, ending) if "=" in ending else CAUSAL
    result = run(jumped, overrides=settings)
    assert result.status == "diverged"
    assert len(result.segments) == 1
    assert asked == [result.segments.losses]
    (begin_ns, end_ns) = asked[0][0]
    seconds = [(at - result.input.start_ns) * 1e-9 for at in (begin_ns, end_ns)]
    assert seconds[0] < jump_s < seconds[1]
    assert seconds[1] == pytest.approx(result.logs.frames / 20.0, abs=0.06), "the last frame"
    assert "slam-graph doctor says" not in result.message


@pytest.mark.slow
@pytest.mark.parametrize(("all_used", "status"), [(True, "suspect"), (False, "ok")])
def test_what_the_estimator_used_must_show_a_fault_as_well(all_used: bool, status: str) -> None:
    """Most features are on a body that looks like the world to a camera that is turned by 8°."""
    flight = simulate(trajectory="random", duration_s=9.0, rate_hz=RATE_HZ, seed=1)
    result = run(flight, algorithm="msckf", overrides=CAUSAL)
    assert result.status == "ok"
    judged, none = verdict.Verdict(result, Diagnostics()), np.zeros(0, np.int64)
    camera, turn = flight.rig.cameras[0].camera, gtsam.Rot3.Rx(np.deg2rad(8.0)).matrix()
    for packet in flight.packets():
        assert isinstance(packet.frame, FeatureFrame)
        seen = packet.frame.cameras[0]
        on_body = seen.ids % 10 > 3
        rays = np.column_stack([seen.normalized, np.ones(len(seen))])
        rays[on_body] = rays[on_body] @ turn.T
        normalized = rays[:, :2] / rays[:, 2:]
        moved = FeatureObservations(seen.ids, camera.distort(normalized)[0], normalized)
        frame = FeatureFrame(packet.frame.stamp_ns, (moved,))
        used = seen.ids if all_used else seen.ids[~on_body]
        places = np.zeros((len(used), 3))
        judged.frame(EstimatedFrame(packet, frame, None, used, places, none, (1.0, 1.0), True))
    judged.finish()
    assert result.status == status, result.message
