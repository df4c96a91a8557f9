# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded feature tracks: GTSAM's wheel, OpenVINS' simulation, and our own recordings."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from recordings import edit_line, edit_text, write_euroc, write_lines, write_openvins

from slam_graph.datasets import open_dataset
from slam_graph.datasets.calibration.euroc_calibration import read_euroc_rig
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.formats.eqvio import EqvioTracks, wheel_tracks
from slam_graph.datasets.formats.openvins_sim import OpenvinsSimulation
from slam_graph.datasets.formats.track_recorder import TrackRecorder
from slam_graph.datasets.formats.track_recording import TrackRecordingSequence
from slam_graph.datasets.sequence import ReaderOptions
from slam_graph.errors import DataError
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.simulation_config import SimulationConfig, TrackConfig
from slam_graph.simulation.simulator import simulate


def features(sequence: OpenvinsSimulation | EqvioTracks) -> list[FeatureFrame]:
    return [p.frame for p in sequence.packets() if isinstance(p.frame, FeatureFrame)]


# --- the file in GTSAM's wheel --------------------------------------------------------------------


def test_wheel_holds_what_it_should() -> None:
    sequence = EqvioTracks(wheel_tracks())
    info = sequence.info()
    assert (info.frames, info.imu_samples, info.cameras) == (601, 6001, 1)
    assert sequence.groundtruth() is None
    assert sequence.initial_state() is None
    imu = sequence.imu()
    assert set(np.diff(imu.stamps_ns)) == {5_000_000}
    assert 9.5 < np.mean(np.linalg.norm(imu.accel[:100], axis=1)) < 10.1
    assert sum(len(frame.cameras[0]) for frame in features(sequence)) == 13316


def test_wheel_reports_a_bad_cell(tmp_path: Path) -> None:
    file = tmp_path / "tracks.csv"
    write_lines(file, wheel_tracks().read_text().splitlines()[:100])
    bad = file.read_text().splitlines()[59].replace("vision_feature,", "vision_feature,x")
    edit_line(file, 60, bad)
    with pytest.raises(DataError, match=r"tracks\.csv:60: .*not a time"):
        list(EqvioTracks(file).packets())


def test_wheel_reports_a_missing_calibration(tmp_path: Path) -> None:
    file = tmp_path / "tracks.csv"
    lines = wheel_tracks().read_text().splitlines()[:100]
    file.write_text("\n".join(line for line in lines if "camera_fx" not in line))
    with pytest.raises(DataError, match="camera_fx"):
        EqvioTracks(file)


@pytest.mark.data
def test_wheel_is_the_start_of_v1_01(data_dir: Path) -> None:
    """Its calibration, IMU and stamps are EuRoC's own."""
    euroc = data_dir / "euroc" / "V1_01_easy_static_2s" / "mav0"
    truth = data_dir / "euroc_inertial" / "V1_01_easy"
    sequence = EqvioTracks(wheel_tracks(), ReaderOptions(groundtruth=truth))
    expected = read_euroc_rig(euroc, ["cam0"]).cameras[0]
    ours = sequence.rig.cameras[0]
    assert ours.body_T_camera.equals(expected.body_T_camera, 1e-9)
    assert (ours.camera.fx, ours.camera.cy) == (expected.camera.fx, expected.camera.cy)
    table = np.loadtxt(euroc / "imu0" / "data.csv", delimiter=",", skiprows=1, max_rows=400)
    imu = sequence.imu()[:400]
    assert np.array_equal(np.hstack([imu.gyro, imu.accel]), table[:, 1:])
    trajectory = sequence.groundtruth()
    assert trajectory is not None
    stamps = np.array([frame.stamp_ns for frame in features(sequence)])
    nearest = trajectory.stamps_ns[np.searchsorted(trajectory.stamps_ns, stamps - 10_000)]
    assert np.max(np.abs(nearest - stamps)) < 200


# --- OpenVINS' simulation -------------------------------------------------------------------------


@pytest.fixture
def simulated(tmp_path: Path) -> Path:
    return write_openvins(tmp_path / "simulated")


def test_stamps_are_exact_and_pixels_undistorted(simulated: Path) -> None:
    frames = features(OpenvinsSimulation(simulated))
    assert [frame.stamp_ns for frame in frames] == [10**11 + k * 10**8 + 1 for k in range(6)]
    assert [len(seen) for frame in frames for seen in frame.cameras] == [12] * 12


def test_initial_state_and_its_prior(simulated: Path) -> None:
    state = OpenvinsSimulation(simulated).initial_state()
    assert state is not None
    assert state.covariance is not None
    assert state.stamp_ns == 99_900_000_000
    assert state.world_T_body.rotation().equals(gtsam.Rot3.Quaternion(0.8, 0, 0, 0.6), 1e-12)
    np.testing.assert_array_equal(state.gyro_bias, [0.01, 0.02, 0.03])
    np.testing.assert_array_equal(state.accel_bias, [0.04, 0.05, 0.06])
    sigmas = np.sqrt(np.diag(state.covariance))[::3]
    np.testing.assert_allclose(sigmas, [0.02, 0.5, 1e-3, 0.04, 0.03])
    edit_line(simulated / "init_state.csv", 1, "# no prior")
    plain = OpenvinsSimulation(simulated).initial_state()
    assert plain is not None
    assert plain.covariance is not None
    sigmas = np.sqrt(np.diag(plain.covariance))[::3]
    np.testing.assert_allclose(sigmas, [0.017, 0.05, 0.01, 0.02, 0.02])


def test_faulty_tracks_are_dropped_and_counted(simulated: Path) -> None:
    file = simulated / "tracks.csv"
    rows = file.read_text().splitlines()
    stamp = rows[1].split(",")[0]
    extra = [f"{stamp},0,99,nan,5.0", rows[1]]
    file.write_text("\n".join([*rows[:13], *extra, *rows[13:], rows[30]]) + "\n")
    sequence = OpenvinsSimulation(simulated)
    frames = features(sequence)
    expected = {"track_not_finite": 1, "track_duplicate": 1, "frame_out_of_order": 1}
    assert sequence.diagnostics.counts == expected
    assert len(frames) == sequence.info().frames == 6
    assert [len(frame.cameras[0]) for frame in frames] == [12] * 6


@pytest.mark.parametrize(
    ("row", "what"),
    [
        ("100.0,0,5,ten,5.0", "'ten' in column 4"),
        ("soon,0,5,10.0,5.0", "'soon' is not a time"),
        ("100.0,7,5,10.0,5.0", "camera 7"),
        ("100.0,0,5", "cannot read the row"),
    ],
)
def test_bad_track_row_names_file_and_line(simulated: Path, row: str, what: str) -> None:
    edit_line(simulated / "tracks.csv", 20, row)
    with pytest.raises(DataError) as error:
        features(OpenvinsSimulation(simulated))
    assert "tracks.csv:20: " in str(error.value)
    assert what in str(error.value)


@pytest.mark.parametrize("name", ["tracks.csv", "imu.csv", "calib.yaml"])
def test_missing_part(simulated: Path, name: str) -> None:
    (simulated / name).unlink()
    with pytest.raises(DataError, match=name):
        OpenvinsSimulation(simulated)


@pytest.mark.parametrize("name", ["tracks.csv", "imu.csv", "groundtruth.csv", "init_state.csv"])
def test_empty_part(simulated: Path, name: str) -> None:
    (simulated / name).write_text("#t\n")
    with pytest.raises(DataError, match=f"{name}: no (data rows|usable state)"):
        read_everything(simulated)


def test_tracks_stream(tmp_path: Path) -> None:
    peaks = []
    for frames in (400, 1600):
        sequence = OpenvinsSimulation(write_openvins(tmp_path / str(frames), frames, 20))
        tracemalloc.start()
        assert sum(1 for _ in sequence.frames()) == frames
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


def read_everything(path: Path) -> None:
    sequence = OpenvinsSimulation(path)
    sequence.groundtruth()
    sequence.initial_state()


# --- our own recording ----------------------------------------------------------------------------


def record(source: OpenvinsSimulation, path: Path) -> None:
    truth, start = source.groundtruth(), source.initial_state()
    with TrackRecorder(path, source.rig, groundtruth=truth, initial_state=start) as recorder:
        for packet in source.packets():
            assert isinstance(packet.frame, FeatureFrame)
            recorder.write(packet.imu, packet.frame)


def test_recording_is_bit_exact(simulated: Path, tmp_path: Path) -> None:
    source = OpenvinsSimulation(simulated)
    record(source, tmp_path / "deep" / "recorded")
    replay = TrackRecordingSequence(tmp_path / "deep" / "recorded")
    for a, b in zip(source.packets(), replay.packets(), strict=True):
        assert isinstance(a.frame, FeatureFrame)
        assert isinstance(b.frame, FeatureFrame)
        assert a.frame.stamp_ns == b.frame.stamp_ns
        for name in ("stamps_ns", "gyro", "accel"):
            assert getattr(a.imu, name).tobytes() == getattr(b.imu, name).tobytes()
        for x, y in zip(a.frame.cameras, b.frame.cameras, strict=True):
            for name in ("ids", "pixels", "normalized"):
                assert getattr(x, name).tobytes() == getattr(y, name).tobytes()
    assert replay.info().name == "recorded"
    compare_extras(source, replay)


def compare_extras(source: OpenvinsSimulation, replay: TrackRecordingSequence) -> None:
    a, b = source.groundtruth(), replay.groundtruth()
    assert a is not None
    assert b is not None
    for name in ("stamps_ns", "positions", "quaternions", "velocities", "accel_biases"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
    x, y = source.initial_state(), replay.initial_state()
    assert x is not None
    assert y is not None
    for name in NavState.__dataclass_fields__:
        u, v = getattr(x, name), getattr(y, name)
        assert np.array_equal(u.matrix(), v.matrix()) if name == "world_T_body" else np.all(u == v)


def test_empty_frames_and_packets_are_kept(simulated: Path, tmp_path: Path) -> None:
    rig = OpenvinsSimulation(simulated).rig
    nothing = (FeatureObservations.empty(), FeatureObservations.empty())
    with TrackRecorder(tmp_path / "empty", rig) as recorder:
        for stamp in (10, 20):
            recorder.write(ImuData.empty(), FeatureFrame(stamp, nothing))
    replay = TrackRecordingSequence(tmp_path / "empty")
    assert [p.frame.stamp_ns for p in replay.packets()] == [10, 20]
    assert replay.groundtruth() is None
    assert replay.initial_state() is None
    with TrackRecorder(tmp_path / "none", rig):
        pass
    assert TrackRecordingSequence(tmp_path / "none").info().frames == 0


def test_a_part_has_the_samples_of_the_whole(simulated: Path, tmp_path: Path) -> None:
    """Also where blocks before the part are skipped; its first packet has those of a second."""
    rig, period_ns = OpenvinsSimulation(simulated).rig, 5_000_000
    nothing = (FeatureObservations.empty(), FeatureObservations.empty())
    with TrackRecorder(tmp_path / "long", rig) as recorder:
        for k in range(600):
            stamps = (20 * k + np.arange(1, 21)) * period_ns
            values = 0.1 * np.random.default_rng(k).normal(size=(20, 3))
            recorder.write(ImuData(stamps, values, values), FeatureFrame(int(stamps[-1]), nothing))
    replay = TrackRecordingSequence(tmp_path / "long")
    whole = replay.imu()
    assert len(whole) == 12_000
    for first in (0, 203, 204, 205, 206, 212, 213, 214, 215, 420, 599):
        part = [packet.imu for packet in replay.packets(20 * (first + 1) * period_ns)]
        begin = max(0, 20 * (first + 1) - 201)
        expected = whole.gyro[begin:]
        assert np.array_equal(np.concatenate([imu.gyro for imu in part]), expected)
        assert all(np.array_equal(imu.gyro, imu.accel) for imu in part)


def test_recording_keeps_nothing_of_a_frame_in_memory(simulated: Path, tmp_path: Path) -> None:
    rig, seen = OpenvinsSimulation(simulated).rig, FeatureObservations.empty()
    with TrackRecorder(tmp_path / "long", rig) as recorder:
        tracemalloc.start()
        used = []
        for first, stop in ((0, 100), (100, 1100)):
            for stamp in range(first, stop):
                recorder.write(ImuData.empty(), FeatureFrame(stamp, (seen, seen)))
            used.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert used[1] - used[0] < 1000  # a byte a frame


def test_recording_is_whole_or_not_there(simulated: Path, tmp_path: Path) -> None:
    rig = OpenvinsSimulation(simulated).rig
    before = sorted(tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt):
        record_and_interrupt(tmp_path / "cut", rig)
    assert sorted(tmp_path.iterdir()) == before


def record_and_interrupt(path: Path, rig: Rig) -> None:
    with TrackRecorder(path, rig):
        assert not path.exists()
        raise KeyboardInterrupt


def test_recorder_refuses_nonsense(simulated: Path, tmp_path: Path) -> None:
    source = OpenvinsSimulation(simulated)
    with pytest.raises(DataError, match="exists already"):
        TrackRecorder(simulated, source.rig)
    frame = features(source)[0]
    with TrackRecorder(tmp_path / "out", source.rig) as recorder:
        recorder.write(ImuData.empty(), frame)
        with pytest.raises(DataError, match="cannot be recorded after"):
            recorder.write(ImuData.empty(), frame)
        with pytest.raises(DataError, match="1 cameras"):
            recorder.write(ImuData.empty(), FeatureFrame(2 * frame.stamp_ns, frame.cameras[:1]))


@pytest.mark.parametrize("name", ["frames.bin", "features.bin", "imu.bin", "calibration.yaml"])
def test_damaged_recording_is_refused(simulated: Path, tmp_path: Path, name: str) -> None:
    record(OpenvinsSimulation(simulated), tmp_path / "recorded")
    file = tmp_path / "recorded" / name
    file.write_bytes(file.read_bytes()[:50])
    with pytest.raises(DataError, match=name):
        TrackRecordingSequence(tmp_path / "recorded")
    file.unlink()
    with pytest.raises(DataError, match=name):
        TrackRecordingSequence(tmp_path / "recorded")


def test_damaged_extras_and_versions_are_refused(simulated: Path, tmp_path: Path) -> None:
    record(OpenvinsSimulation(simulated), tmp_path / "recorded")
    (tmp_path / "recorded" / "groundtruth.npz").write_bytes(b"PK nonsense")
    with pytest.raises(DataError, match=r"groundtruth\.npz"):
        TrackRecordingSequence(tmp_path / "recorded").groundtruth()
    edit_text(tmp_path / "recorded" / "meta.yaml", "version: 1", "version: 99")
    with pytest.raises(DataError, match=r"meta\.yaml:2: .*version 99"):
        TrackRecordingSequence(tmp_path / "recorded")


def test_another_calibration_moves_the_normalised_points(simulated: Path, tmp_path: Path) -> None:
    source = OpenvinsSimulation(simulated)
    record(source, tmp_path / "recorded")
    other = read_euroc_rig(write_euroc(tmp_path / "flight") / "mav0", ["cam0", "cam1"])
    write_kalibr(other, tmp_path / "other.yaml")
    replay = TrackRecordingSequence(
        tmp_path / "recorded", ReaderOptions(1, tmp_path / "other.yaml")
    )
    frame = next(iter(replay.frames()))
    assert isinstance(frame, FeatureFrame)
    seen = frame.cameras[0]
    expected = replay.rig.cameras[0].camera.undistort(seen.pixels)
    assert np.array_equal(seen.normalized, expected, equal_nan=True)


def test_descriptors_are_replayed_bit_by_bit(tmp_path: Path) -> None:
    tracks = TrackConfig(features=20, descriptors=True)
    source = simulate(SimulationConfig(duration_s=1.0, rate_hz=10.0, tracks=tracks))
    source.save(tmp_path / "recorded")
    replay = TrackRecordingSequence(tmp_path / "recorded")
    frames = [f for f in source.frames() if isinstance(f, FeatureFrame)]
    for first in (0, 4):
        again = list(replay.frames(frames[first].stamp_ns if first else None))
        assert len(again) == len(frames) - first
        for said, read in zip(frames[first:], again, strict=True):
            assert isinstance(read, FeatureFrame)
            looks, expected = read.cameras[0].descriptors, said.cameras[0].descriptors
            assert looks is not None
            assert expected is not None
            assert looks.shape == (len(said.cameras[0]), 32)
            np.testing.assert_array_equal(looks, expected)
            assert read.cameras[1].descriptors is None
    file = tmp_path / "recorded" / "descriptors.bin"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(DataError, match="descriptors"):
        TrackRecordingSequence(tmp_path / "recorded")


def test_a_recording_is_known_by_its_files_and_its_description_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    simulate(cameras=1, duration_s=0.5).save(folder)
    for text, said in (("name: [1\n", r"meta.yaml:\d+: not valid"), ("a: 1\n", "format")):
        (folder / "meta.yaml").write_text(text)
        with pytest.raises(DataError, match=said):
            open_dataset(folder)


def test_another_lens_does_not_see_everything(tmp_path: Path) -> None:
    """What is beyond its edge is left out and counted."""
    flight = simulate(cameras=1, duration_s=0.5)
    flight.save(tmp_path / "flight")
    mounted = flight.rig.cameras[0]
    lens = replace(mounted.camera, fx=120.0, fy=120.0, distortion="equidistant")
    lens = replace(lens, coefficients=(0.0, 0.0, 0.0, 0.0))
    write_kalibr(Rig((replace(mounted, camera=lens),), flight.rig.imu), tmp_path / "wide.yaml")
    recording = open_dataset(tmp_path / "flight", calibration=tmp_path / "wide.yaml")
    seen = [f.cameras[0] for f in recording.frames() if isinstance(f, FeatureFrame)]
    assert all(np.isfinite(c.normalized).all() for c in seen)
    assert recording.diagnostics.counts["feature_outside_lens"] > 0
    assert sum(map(len, seen)) > 0
