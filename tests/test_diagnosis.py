# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A sound recording has no faults; one that is made up is found, and found first."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from groups import slow
from typer.testing import CliRunner

import slam_graph as sg
from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.cli.main import app
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.faults.injection import inject
from slam_graph.datasets.memory_sequence import dataset_from_arrays
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.diagnosis import Diagnosis
from slam_graph.diagnosis.finding import Finding, no_surer
from slam_graph.diagnosis.gathering import Part, uninterrupted
from slam_graph.diagnosis.imu_checks import check_units
from slam_graph.diagnosis.stereo_geometry import check_stereo
from slam_graph.diagnosis.stereo_matching import StereoMatches
from slam_graph.sensors.measurements import FeatureFrame, ImuData
from slam_graph.sensors.rig import Rig, RigCamera

Recorded = tuple[Rig, list[FeatureFrame], ImuData]
Poses = Callable[[list[gtsam.Pose3]], list[gtsam.Pose3]]

TURN_5 = gtsam.Pose3(gtsam.Rot3.Rx(np.deg2rad(5.0)), np.zeros(3))


def taken(recording: RecordedSequence) -> Recorded:
    """A recording of tracks, in memory."""
    frames = [frame for frame in recording.frames() if isinstance(frame, FeatureFrame)]
    return recording.rig, frames, recording.imu()


@pytest.fixture(scope="module")
def real_tracks() -> Recorded:
    """Real tracks and IMU of one camera: 14 s of the demo, after its start."""
    rig, frames, imu = taken(sg.open_dataset("demo"))
    begin_ns = frames[0].stamp_ns + 12_000_000_000
    return rig, [f for f in frames if 0 <= f.stamp_ns - begin_ns <= 14_000_000_000], imu


@pytest.fixture(scope="module")
def stereo_tracks() -> Recorded:
    """Tracks of two cameras in livelier motion, simulated."""
    return taken(sg.simulate(trajectory="random", duration_s=14, seed=3))


def judged(
    recorded: Recorded,
    rig: Rig | None = None,
    gyro: FloatArray | None = None,
    accel: FloatArray | None = None,
) -> Diagnosis:
    """The diagnosis with another calibration, or with rates and forces mapped by (3, 3)."""
    calibrated, frames, imu = recorded
    eye = np.eye(3)
    mapped = ImuData(
        imu.stamps_ns,
        imu.gyro @ (eye if gyro is None else gyro).T,
        imu.accel @ (eye if accel is None else accel).T,
    )
    return Diagnosis.of_tracks(
        rig or calibrated, [normalized_by(rig or calibrated, frame) for frame in frames], mapped
    )


def normalized_by(rig: Rig, frame: FeatureFrame) -> FeatureFrame:
    """A frame as it is read with a calibration: its pixels are what was recorded."""
    cameras = (
        replace(seen, normalized=mounted.camera.undistort(seen.pixels))
        for seen, mounted in zip(frame.cameras, rig.cameras, strict=True)
    )
    return FeatureFrame(frame.stamp_ns, tuple(cameras))


def first(diagnosis: Diagnosis, kind: str) -> dict[str, object]:
    """The figures of the first finding, which must be a fault of this kind."""
    assert diagnosis.faults, [finding.what for finding in diagnosis.findings]
    found = diagnosis.faults[0]
    assert found.kind == kind, found.what
    assert found.fix
    assert found.what in diagnosis.best_guess()
    return dict(found.values)


def changed(rig: Rig, change: Callable[[RigCamera], RigCamera]) -> Rig:
    return Rig(tuple(change(mounted) for mounted in rig.cameras), rig.imu)


def posed(rig: Rig, change: Poses) -> Rig:
    poses = change([mounted.body_T_camera for mounted in rig.cameras])
    cameras = zip(rig.cameras, poses, strict=True)
    return Rig(tuple(replace(c, body_T_camera=pose) for c, pose in cameras), rig.imu)


def magnified(mounted: RigCamera, factor: float) -> RigCamera:
    lens = mounted.camera
    return replace(mounted, camera=replace(lens, fx=lens.fx * factor, fy=lens.fy * factor))


def test_sound_tracks_have_no_faults(real_tracks: Recorded, stereo_tracks: Recorded) -> None:
    for recorded in (real_tracks, stereo_tracks):
        diagnosis = judged(recorded)
        assert not diagnosis.faults, diagnosis.best_guess()
        assert any(finding.kind == "camera_and_gyroscope" for finding in diagnosis.findings)
    assert any(finding.kind == "scale" for finding in diagnosis.findings)


def test_a_quick_diagnosis_rules_out_what_it_would_have_seen(stereo_tracks: Recorded) -> None:
    rig, frames, imu = stereo_tracks
    wrong = changed(rig, lambda c: magnified(c, 1.1))
    large = {"focal_length": 0.2, "baseline": 0.7, "mounting": 6.0}

    def diagnosed(rig: Rig, seconds: float) -> Diagnosis:
        end_ns = frames[0].stamp_ns + round(seconds * 1e9)
        seen = [normalized_by(rig, frame) for frame in frames if frame.stamp_ns < end_ns]
        return Diagnosis.nearby(rig, seen, imu)

    assert diagnosed(rig, 14.0).rules_out(large)
    assert not diagnosed(rig, 14.0).rules_out({"mounting": 0.01})  # it is not known so well
    assert not diagnosed(wrong, 14.0).rules_out({"mounting": 6.0})  # something is wrong
    assert not diagnosed(rig, 1.0).rules_out({"focal_length": 0.2})  # too short to be compared
    found = diagnosed(rig, 14.0).findings
    assert not Diagnosis([*found, Finding("imu_rate", "warning", "")]).rules_out(large)
    assert not Diagnosis(found).rules_out(large | {"baseline": 0.3})  # known to 6 % only


def test_an_unknown_mounting_is_found_and_no_fault(stereo_tracks: Recorded) -> None:
    rig = changed(
        stereo_tracks[0],
        lambda c: replace(c, body_T_camera=TURN_5 * c.body_T_camera, rotation_known=False),
    )
    diagnosis = judged(stereo_tracks, rig)
    assert not diagnosis.faults, diagnosis.best_guess()
    (found,) = (finding for finding in diagnosis.findings if finding.kind == "mounting")
    right = stereo_tracks[0].cameras[0].body_T_camera.rotation()
    turn = right.between(gtsam.Rot3(np.array(found.values["body_R_camera"])))
    assert np.linalg.norm(gtsam.Rot3.Logmap(turn)) < np.deg2rad(0.5)


@pytest.mark.parametrize(
    ("unit", "kind"),
    [
        (1 / 9.81, "accelerometer_unit"),
        slow(1e3, "accelerometer_unit"),
        (-1.0, "accelerometer_sign"),
    ],
)
def test_forces_in_another_unit_or_sign(real_tracks: Recorded, unit: float, kind: str) -> None:
    first(judged(real_tracks, accel=unit * np.eye(3)), kind)


def test_forces_without_gravity(real_tracks: Recorded) -> None:
    rig, frames, imu = real_tracks
    linear = ImuData(imu.stamps_ns, imu.gyro, imu.accel - np.mean(imu.accel, axis=0))
    first(Diagnosis.of_tracks(rig, frames, linear), "accelerometer_gravity")


def test_sensors_that_always_measure_the_same(real_tracks: Recorded) -> None:
    rig, frames, imu = real_tracks
    first(judged(real_tracks, gyro=np.zeros((3, 3))), "gyroscope_constant")
    diagnosis = Diagnosis.nearby(rig, frames, ImuData(imu.stamps_ns, 0.0 * imu.gyro, imu.accel))
    first(diagnosis, "gyroscope_constant")
    stuck = np.repeat(imu.accel[:1], len(imu), axis=0)
    diagnosis = Diagnosis.of_tracks(rig, frames, ImuData(imu.stamps_ns, imu.gyro, stuck))
    first(diagnosis, "accelerometer_constant")


def test_scale_of_the_gyroscope_is_not_taken_for_a_turn(stereo_tracks: Recorded) -> None:
    diagnosis = judged(stereo_tracks, gyro=1.1 * np.eye(3))
    assert first(diagnosis, "gyroscope_scale")["factor"] == pytest.approx(1.1, rel=0.02)
    assert len(diagnosis.faults) == 1


@pytest.mark.parametrize(
    ("unit", "force", "said"),
    [(9.80665e-3, 9.81, "is mg"), (1e-2, 9.81, "is cm/s²"), (1e-2, 9.90, "is cm/s² or mg")],
)
def test_units_that_differ_by_two_percent(unit: float, force: float, said: str) -> None:
    """They are told apart where the force is that of gravity, and both are named in between."""
    stamps_ns = np.arange(2000, dtype=np.int64) * 5_000_000
    measured = np.random.default_rng(1).normal([0.0, 0.0, force], 0.05, (2000, 3))
    found, factor = check_units(ImuData(stamps_ns, 0.0 * measured, measured / unit))
    assert found[0].what.endswith(said)
    assert factor == pytest.approx(unit, rel=0.02)


def test_a_fault_is_no_surer_than_those_before() -> None:
    faults = [Finding("a", "error", "", sure="likely"), Finding("b", "info", "", sure="hint")]
    assert no_surer(Finding("c", "error", ""), faults).sure == "likely"
    assert no_surer(Finding("c", "info", ""), faults).sure == "certain"
    assert no_surer(Finding("c", "error", "", sure="hint"), faults).sure == "hint"


def test_rates_in_degrees(real_tracks: Recorded) -> None:
    values = first(judged(real_tracks, gyro=np.rad2deg(1.0) * np.eye(3)), "gyroscope_unit")
    assert values["factor"] == pytest.approx(57.3, rel=0.1)


@pytest.mark.parametrize(
    ("axes", "text"),
    [(np.diag([1.0, -1.0, 1.0]), "(x, -y, z)"), slow(np.eye(3)[[1, 0, 2]], "(y, x, z)")],
)
def test_left_handed_gyroscope(real_tracks: Recorded, axes: FloatArray, text: str) -> None:
    assert first(judged(real_tracks, gyro=axes), "gyroscope_axes")["axes"] == text


@pytest.mark.slow
def test_axes_of_the_accelerometer(real_tracks: Recorded) -> None:
    swapped = np.eye(3)[[1, 0, 2]]
    assert first(judged(real_tracks, accel=swapped), "accelerometer_axes")["axes"] == "(y, x, z)"


def test_mounting(real_tracks: Recorded) -> None:
    rig = real_tracks[0]
    inverse = posed(rig, lambda poses: [pose.inverse() for pose in poses])
    assert first(judged(real_tracks, inverse), "mounting")["explanation"] == "inverse"
    turned = posed(rig, lambda poses: [pose * TURN_5 for pose in poses])
    values = first(judged(real_tracks, turned), "mounting")
    assert values["explanation"] == "other"
    assert values["degrees"] == pytest.approx(5.0, abs=1.0)


def test_axes_of_the_whole_imu(real_tracks: Recorded) -> None:
    quarter = gtsam.Rot3.Rz(np.pi / 2).matrix()
    values = first(judged(real_tracks, gyro=quarter, accel=quarter), "mounting")
    assert values["explanation"] == "axes"


@pytest.mark.parametrize("offset_s", [slow(0.05), slow(-0.05), 0.012])
def test_time_offset_is_found_to_milliseconds(real_tracks: Recorded, offset_s: float) -> None:
    rig = changed(real_tracks[0], lambda c: replace(c, time_offset_s=c.time_offset_s + offset_s))
    diagnosis = judged(real_tracks, rig)
    assert abs(float(str(first(diagnosis, "time_offset")["time_offset_s"]))) < 2e-3
    assert "backend.calibration.time_offset=true" in diagnosis.best_guess()


@pytest.mark.parametrize("factor", [slow(1.1), slow(1.3), 0.9])
def test_focal_length(stereo_tracks: Recorded, factor: float) -> None:
    rig = changed(stereo_tracks[0], lambda c: magnified(c, factor))
    assert first(judged(stereo_tracks, rig), "focal_length")["factor"] == pytest.approx(
        factor, rel=0.03
    )


@pytest.mark.parametrize(
    ("seed", "factor", "seconds"),
    [slow(3, 0.9, 14), slow(4, 0.9, 14), slow(3, 0.7, 14), (4, 0.7, 7)],
)
def test_focal_length_of_a_wide_lens(
    tmp_path: Path, seed: int, factor: float, seconds: float
) -> None:
    """Points at its edge have no bearing under a focal length that is too short."""
    rig = sg.simulate(cameras=1, duration_s=1.0).rig
    wide = replace(
        rig.cameras[0].camera,
        fx=191.0,
        fy=191.0,
        cx=255.0,
        cy=257.0,
        width=512,
        height=512,
        distortion="equidistant",
        coefficients=(0.0034, 0.0008, -0.0021, 0.0002),
    )
    chain = tmp_path / "wide.yaml"
    write_kalibr(changed(rig, lambda c: replace(c, camera=wide)), chain)
    flight = sg.simulate(calibration=chain, trajectory="random", duration_s=seconds, seed=seed)
    recorded = taken(flight)
    assert not judged(recorded).faults
    short = changed(recorded[0], lambda c: magnified(c, factor))
    found = first(judged(recorded, short), "focal_length")["factor"]
    assert found == pytest.approx(factor, rel=0.03)


@pytest.mark.parametrize("factor", [slow(2.0), 0.5])
def test_baseline(stereo_tracks: Recorded, factor: float) -> None:
    def longer(poses: list[gtsam.Pose3]) -> list[gtsam.Pose3]:
        relative = poses[0].between(poses[1])
        moved = gtsam.Pose3(relative.rotation(), factor * relative.translation())
        return [poses[0], poses[0] * moved]

    values = first(judged(stereo_tracks, posed(stereo_tracks[0], longer)), "baseline")
    assert values["factor"] == pytest.approx(factor, rel=0.15)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        slow(lambda poses: poses[::-1], "the poses of the cameras are exchanged"),
        (lambda poses: [poses[0], poses[1].inverse()], "the pose of cam1 is inverted"),
        (lambda poses: [poses[0], poses[1] * TURN_5], "off by 5."),
    ],
)
def test_stereo_geometry(stereo_tracks: Recorded, change: Poses, said: str) -> None:
    diagnosis = judged(stereo_tracks, posed(stereo_tracks[0], change))
    first(diagnosis, "stereo_geometry")
    assert said in diagnosis.best_guess()


def test_exchanged_cameras_explain_a_mounting(stereo_tracks: Recorded) -> None:
    """The first camera in the place of the second one is one fault, and no turn beside it."""
    rig = Rig(stereo_tracks[0].cameras[::-1], stereo_tracks[0].imu)
    diagnosis = judged(stereo_tracks, rig)
    first(diagnosis, "stereo_geometry")
    assert "exchange" in diagnosis.best_guess()
    assert [finding.kind for finding in diagnosis.faults] == ["stereo_geometry"]


def test_both_focal_lengths_without_a_gyroscope(stereo_tracks: Recorded) -> None:
    rig, frames, _ = stereo_tracks
    matches = [StereoMatches.of_tracks(frame) for frame in frames[::30]]
    found = check_stereo(matches, changed(rig, lambda c: magnified(c, 1.3)))
    assert "focal lengths of both cameras are 1.2" in found[0].what  # they are known to a tenth


@pytest.mark.slow
def test_focal_length_of_the_second_camera(stereo_tracks: Recorded) -> None:
    one, two = stereo_tracks[0].cameras
    diagnosis = judged(stereo_tracks, Rig((one, magnified(two, 1.1)), stereo_tracks[0].imu))
    first(diagnosis, "stereo_geometry")
    assert "focal length of cam1" in diagnosis.best_guess()


@pytest.mark.slow
def test_shutter_that_rolls() -> None:
    flight = sg.simulate(
        trajectory="random", duration_s=10, seed=3, shutter_readout_s=0.03, cameras=1
    )
    recorded = taken(flight)
    assert not judged(recorded).faults
    still = changed(recorded[0], lambda c: replace(c, readout_s=0.0, rolling_shutter=False))
    values = first(judged(recorded, still), "rolling_shutter")
    assert values["readout_s"] == pytest.approx(0.03, abs=0.005)


def jumping(part: Recorded, other: Recorded, between: tuple[int, int]) -> Recorded:
    """A recording with that of another flight inside of a time."""

    def inside(stamps_ns: IntArray) -> BoolArray:
        return (between[0] < stamps_ns) & (stamps_ns < between[1])

    rig, frames, imu = part
    moved = {frame.stamp_ns: frame for frame in other[1]}
    frames = [moved[f.stamp_ns] if inside(np.array(f.stamp_ns)) else f for f in frames]
    rows = inside(imu.stamps_ns)[:, None]
    samples = np.where(rows, other[2].gyro, imu.gyro), np.where(rows, other[2].accel, imu.accel)
    return rig, frames, ImuData(imu.stamps_ns, *samples)


@pytest.mark.parametrize("look", [slow(Diagnosis.of_tracks), Diagnosis.nearby])
def test_what_was_lost_does_not_count(
    stereo_tracks: Recorded, look: Callable[..., Diagnosis]
) -> None:
    """Whatever happens while an estimate is lost, the comparisons say the same."""
    second = 1_000_000_000
    begin, end = (stereo_tracks[1][0].stamp_ns + s * second for s in (6, 8))
    margin = round(0.35 * second)  # of the samples around frames
    other = taken(sg.simulate(trajectory="random", duration_s=14, seed=5))
    jumped = jumping(stereo_tracks, other, (begin + margin, end - margin))
    assert not np.array_equal(jumped[2].gyro, stereo_tracks[2].gyro)

    def compared(recorded: Recorded) -> list[Finding]:
        kinds = ("camera_and_gyroscope", "scale")  # others are of the IMU as a whole
        found = look(*recorded, lost=[(begin, end)])
        assert not found.faults, found.best_guess()
        return [finding for finding in found.findings if finding.kind in kinds]

    assert compared(jumped) == compared(stereo_tracks)
    assert len(compared(jumped)) == 2


@pytest.mark.slow
def test_a_jump_that_nobody_noticed_does_not_turn_axes() -> None:
    """It spoils one of two windows, and wrong axes spoil every window."""
    flight = sg.simulate(trajectory="random", duration_s=16, seed=20)
    diagnosis = judged(taken(inject(flight, ["kidnapped:at_s=6,duration_s=3.7"])))
    assert not diagnosis.faults, diagnosis.best_guess()


def test_pieces_have_no_gaps(real_tracks: Recorded) -> None:
    """Neither of frames nor of samples, and each piece has its own samples around its frames."""
    _, frames, imu = real_tracks
    first_ns = frames[0].stamp_ns
    at = [first_ns + round(s * 1e9) for s in (3.0, 4.0, 7.0, 7.5, 10.0, 11.5)]
    seen = [f for f in frames if not at[0] < f.stamp_ns < at[1]]
    rows = (imu.stamps_ns < at[2]) | (imu.stamps_ns > at[3])
    part = Part(seen, ImuData(imu.stamps_ns[rows], imu.gyro[rows], imu.accel[rows]))
    pieces = uninterrupted(part, [(at[4], at[5])])
    assert len(pieces) == 4
    kept = [frame for piece in pieces for frame in piece.frames]
    assert kept == [f for f in seen if not at[4] < f.stamp_ns < at[5]]
    for piece in pieces:
        stamps = np.array([frame.stamp_ns for frame in piece.frames])
        assert max(np.diff(stamps).max() / 5e8, np.diff(piece.imu.stamps_ns).max() / 2e8) <= 1.0
        assert stamps[0] - piece.imu.stamps_ns[0] <= 3e8
        assert piece.imu.stamps_ns[-1] - stamps[-1] <= 3e8
    assert uninterrupted(Part([], imu)) == []


def test_clocks_that_do_not_belong_together(real_tracks: Recorded) -> None:
    rig, frames, imu = real_tracks
    later = ImuData(imu.stamps_ns + 100_000_000_000, imu.gyro, imu.accel)
    diagnosis = Diagnosis.of_tracks(rig, frames, later)
    assert [finding.kind for finding in diagnosis.errors] == ["clocks_apart"]


def test_what_stands_still_has_no_faults() -> None:
    """Nor has what has no frames or samples at all a traceback."""
    resting = taken(sg.simulate(duration_s=4, flight={"hover_s": 10.0}))
    diagnosis = judged(resting)
    assert not diagnosis.faults, diagnosis.best_guess()
    assert any(finding.kind == "turns_too_little" for finding in diagnosis.findings)
    nothing = Diagnosis.of_tracks(resting[0], [], ImuData.empty())
    assert nothing.errors


@pytest.fixture(scope="module")
def rendered() -> RecordedSequence:
    """A second of rendered stereo images, in memory."""
    flight = sg.simulate(kind="images", duration_s=1.0, rate_hz=10, flight={"hover_s": 0.0})
    frames = list(flight.frames())
    imu = flight.imu()
    return dataset_from_arrays(
        flight.rig,
        imu_stamps_ns=imu.stamps_ns,
        gyro=imu.gyro,
        accel=imu.accel,
        image_stamps_ns=np.array([frame.stamp_ns for frame in frames]),
        images=[[frame.images[c] for frame in frames] for c in range(2)],  # type: ignore[union-attr]
    )


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        ("image_blank:at_s=0.2,duration_s=0.6", "image_blank"),
        ("image_overexposed:at_s=0.2,duration_s=0.6", "image_overexposed"),
        ("image_blurred:at_s=0.2,duration_s=0.6", "image_blurred"),
        ("image_frozen:at_s=0.2,duration_s=0.6", "image_repeated"),
        ("camera_lost:camera=1,at_s=0.2,duration_s=0.6", "images_missing"),
    ],
)
def test_images(rendered: RecordedSequence, fault: str, kind: str) -> None:
    sound = Diagnosis.quick(rendered)
    assert not sound.faults, sound.best_guess()
    first(Diagnosis.quick(inject(rendered, [fault])), kind)


def test_command_names_the_fault_and_its_exit_code_says_so(tmp_path: Path) -> None:
    flight = sg.simulate(trajectory="random", duration_s=8, seed=4, cameras=1)
    flight.save(tmp_path / "flight")
    sound = CliRunner().invoke(app, ["doctor", str(tmp_path / "flight")])
    assert sound.exit_code == 0, sound.stdout
    assert "nothing wrong was found" in sound.stdout
    wrong = changed(flight.rig, lambda c: replace(c, time_offset_s=0.05))
    write_kalibr(wrong, tmp_path / "chain.yaml")
    words = ["doctor", str(tmp_path / "flight"), "--calibration", str(tmp_path / "chain.yaml")]
    found = CliRunner().invoke(app, [*words, "--json"])
    assert found.exit_code == 1
    table = json.loads(found.stdout)
    assert table["errors"] == 1
    assert table["findings"][0]["kind"] == "time_offset"


@pytest.mark.slow
def test_real_images_have_no_faults(data_dir: Path) -> None:
    for name in ("euroc/V1_01_easy_static_2s", "euroc/MH_01_easy_17s"):
        diagnosis = Diagnosis.of(sg.open_dataset(data_dir / name))
        assert not diagnosis.faults, diagnosis.best_guess()
    kinds = {finding.kind for finding in diagnosis.findings}
    assert {"camera_and_gyroscope", "stereo", "scale"} <= kinds


@pytest.mark.slow
def test_doubled_baseline_of_real_images(data_dir: Path) -> None:
    recording = sg.open_dataset(data_dir / "euroc/MH_01_easy_17s")
    one, two = recording.rig.cameras
    relative = one.body_T_camera.between(two.body_T_camera)
    moved = gtsam.Pose3(relative.rotation(), 2.0 * relative.translation())
    far = replace(two, body_T_camera=one.body_T_camera * moved)
    recording.rig = Rig((one, far), recording.rig.imu)
    assert first(Diagnosis.of(recording), "baseline")["factor"] == pytest.approx(2.0, rel=0.1)
