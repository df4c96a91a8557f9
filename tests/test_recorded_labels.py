# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of tracks with labels of masks, and with features that move: files, replay, runs."""

import errno
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from slam_graph.cli.main import app
from slam_graph.config import load_config
from slam_graph.datasets import TrackRecorder, open_dataset
from slam_graph.datasets.formats.recorded_objects import ObjectColumns
from slam_graph.datasets.formats.track_recording import TrackRecordingSequence
from slam_graph.datasets.streams.mask_images import classes_text
from slam_graph.errors import DataError
from slam_graph.experiment.tasks import RecordTask, find_sources
from slam_graph.frontend import FrontendConfig, build_frontend
from slam_graph.pipeline import run
from slam_graph.pipeline.tracking import packets_of
from slam_graph.results import RunInput, RunResult
from slam_graph.sensors import FeatureFrame, FeatureObservations, ImuData
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulator import euroc_rig, simulate

FILES = ("labels.bin", "moving.bin", "moving_frames.bin")


def seen(first: int, labels: list[int] | None, count: int = 3) -> FeatureObservations:
    """Some features."""
    pixels = np.arange(2.0 * count).reshape(-1, 2) + first
    known = None if labels is None else np.array(labels, np.int64)
    return FeatureObservations(np.arange(first, first + count), pixels, pixels / 100, labels=known)


def frames() -> list[FeatureFrame]:
    """Frames without masks, with them, with features that move, and without features."""
    other, none = seen(0, None), FeatureObservations.empty()
    return [
        FeatureFrame(100, (seen(0, None), other)),
        FeatureFrame(200, (seen(0, [0, 7, 65535]), other)),
        FeatureFrame(300, (seen(0, None), other), moving=(seen(5, None), seen(6, None, 2))),
        FeatureFrame(400, (none, none)),
        FeatureFrame(500, (seen(1, [0, 0, 2]), other), moving=(seen(5, [1, 0, 2]), none)),
    ]


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    with TrackRecorder(
        tmp_path / "recorded", euroc_rig(), notes=classes_text({7: "car"})
    ) as recorder:
        for frame in frames():
            recorder.write(ImuData.empty(), frame)
    return tmp_path / "recorded"


def assert_same(read: FeatureObservations, said: FeatureObservations) -> None:
    for name in ("ids", "pixels", "normalized"):
        assert getattr(read, name).tobytes() == getattr(said, name).tobytes()
    if said.labels is None:
        assert read.labels is None or len(read) == 0
    else:
        assert read.labels is not None
        assert read.labels.tolist() == said.labels.tolist()


@pytest.mark.parametrize("first", range(5))
def test_labels_and_moving_features_are_replayed(recorded: Path, first: int) -> None:
    said = frames()[first:]
    read = list(TrackRecordingSequence(recorded).frames(said[0].stamp_ns))
    for a, b in zip(read, said, strict=True):
        assert isinstance(a, FeatureFrame)
        moving = b.moving or (FeatureObservations.empty(),) * 2
        for x, y in zip((*a.cameras, *a.moving), (*b.cameras, *moving), strict=True):
            assert_same(x, y)


def test_classes_are_recorded(recorded: Path) -> None:
    assert TrackRecordingSequence(recorded).mask_classes == {7: "car"}


def test_a_recording_without_labels_has_the_files_it_always_had(tmp_path: Path) -> None:
    with TrackRecorder(tmp_path / "plain", euroc_rig()) as recorder:
        recorder.write(ImuData.empty(), frames()[0])
    names = {path.name for path in (tmp_path / "plain").iterdir()}
    assert names == {"meta.yaml", "calibration.yaml", "frames.bin", "features.bin", "imu.bin"}
    meta = yaml.safe_load((tmp_path / "plain" / "meta.yaml").read_text())
    assert meta["version"] == 1
    assert not {"labels", "moving_features"} & meta.keys()
    (frame,) = TrackRecordingSequence(tmp_path / "plain").frames()
    assert isinstance(frame, FeatureFrame)
    assert frame.cameras[0].labels is None
    assert frame.moving == ()


@pytest.mark.parametrize("name", FILES)
def test_damaged_files_are_refused(recorded: Path, name: str) -> None:
    file = recorded / name
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(DataError, match=name):
        TrackRecordingSequence(recorded)
    file.unlink()
    with pytest.raises(DataError, match=f"{name}: missing"):
        TrackRecordingSequence(recorded)


@pytest.mark.parametrize("name", FILES)
def test_nonsense_in_files_is_refused(recorded: Path, name: str) -> None:
    file = recorded / name
    file.write_bytes(b"\xfe" * file.stat().st_size)
    with pytest.raises(DataError, match=name):
        list(TrackRecordingSequence(recorded).frames())


@pytest.mark.parametrize("label", [-1, 65536, 70000, 2**32 + 5])
@pytest.mark.parametrize("moves", [False, True])
def test_labels_that_no_mask_can_have_are_not_recorded(
    tmp_path: Path, label: int, moves: bool
) -> None:
    wrong, other = seen(0, [0, label, 1]), seen(0, None)
    frame = FeatureFrame(100, (seen(0, [0, 0, 0]) if moves else wrong, other))
    if moves:
        frame = replace(frame, moving=(wrong, other))
    with (
        pytest.raises(DataError, match=f"label {label} "),
        TrackRecorder(tmp_path / "wrong", euroc_rig()) as recorder,
    ):
        recorder.write(ImuData.empty(), frame)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("cameras", [1, 3])
def test_features_that_move_in_other_cameras_are_not_recorded(tmp_path: Path, cameras: int) -> None:
    """The frames before are kept if the caller goes on."""
    good, other = frames()[2], seen(0, None)
    bad = FeatureFrame(400, (other, other), moving=(other,) * cameras)
    with TrackRecorder(tmp_path / "kept", euroc_rig()) as recorder:
        recorder.write(ImuData.empty(), good)
        with pytest.raises(DataError, match=f"in {cameras} cameras"):
            recorder.write(ImuData.empty(), bad)
    (read,) = TrackRecordingSequence(tmp_path / "kept").frames()
    assert isinstance(read, FeatureFrame)
    assert [len(part) for part in read.moving] == [3, 2]


def test_files_are_closed_where_the_end_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(columns: ObjectColumns) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    opened = []
    own = TrackRecorder._open
    monkeypatch.setattr(
        TrackRecorder, "_open", lambda self, name: opened.append(own(self, name)) or opened[-1]
    )
    monkeypatch.setattr(ObjectColumns, "finish", full)
    with (
        pytest.raises(DataError, match="No space left"),
        TrackRecorder(tmp_path / "full", euroc_rig()) as recorder,
    ):
        recorder.write(ImuData.empty(), frames()[1])
    assert len(opened) == 4
    assert all(file.closed for file in opened)
    assert list(tmp_path.iterdir()) == []


def test_what_moves_is_replayed_only_where_it_is_wanted() -> None:
    frame = frames()[-1]
    for wanted in (True, False):
        frontend = build_frontend(euroc_rig(), FrontendConfig(keep_moving=wanted), content="tracks")
        assert len(frontend.track(frame).moving) == 2 * wanted
    frontend = build_frontend(euroc_rig(), FrontendConfig(keep_moving=True), content="tracks")
    frontend.drop(np.array([1, 5]))
    left = frontend.track(frame)
    assert left.cameras[0].ids.tolist() == [2, 3]
    assert left.moving[0].ids.tolist() == [6, 7]


# --- runs ----------------------------------------------------------------------------------------


def test_an_open_recording_is_run_with_fewer_cameras(recorded: Path) -> None:
    """What moves is left out with the cameras that are; a frame with no more cameras is kept."""
    recording = open_dataset(recorded)
    result = run(recording, cameras="mono", overrides={"objects.enabled": True})
    assert result.status == "not_initialized", result.message
    info, config = recording.info(), load_config()
    for count in (1, 2):
        rig = recording.rig.select(count)
        asked = RunInput(info, config, rig, info.start_ns, info.end_ns)
        for packet, said in zip(packets_of(recording, asked), frames(), strict=True):
            assert isinstance(packet.frame, FeatureFrame)
            assert len(packet.frame.cameras) == count
            assert packet.frame.whole.cameras[0].ids.tolist() == said.whole.cameras[0].ids.tolist()


def estimated(
    sequence: SimulatedSequence | TrackRecordingSequence, recorder: TrackRecorder | None = None
) -> RunResult:
    wanted = {"objects.enabled": True, "final_ba.enabled": False}
    overrides = {**wanted, "backend.noise.pixel_sigma": 0.5}
    return run(sequence, overrides=overrides, recorder=recorder)


def assert_same_objects(one: RunResult, other: RunResult) -> None:
    assert one.objects is not None
    assert other.objects is not None
    assert one.objects.numbers == other.objects.numbers
    assert len(one.objects.numbers)
    for number in one.objects.numbers:
        first, second = one.objects.states(number), other.objects.states(number)
        assert [(s.stamp_ns, s.label) for s in first] == [(s.stamp_ns, s.label) for s in second]
        for a, b in zip(first, second, strict=True):
            # mountings are rounded to 1e-15 in a file, which grows: this is a tenth of the error
            assert a.world_T_object.equals(b.world_T_object, 1e-3)


@pytest.mark.slow
def test_a_recording_of_two_boxes_with_labels_is_run_like_the_simulation(tmp_path: Path) -> None:
    objects = {"count": 2, "motion": "mixed", "masks": True}
    sequence = simulate(
        duration_s=4.0, rate_hz=10.0, seed=0, tracks={"pixel_sigma": 0.5}, objects=objects
    )
    sequence.save(tmp_path / "boxes")
    replay = open_dataset(tmp_path / "boxes")
    assert isinstance(replay, TrackRecordingSequence)
    for said, read in zip(sequence.frames(), replay.frames(), strict=True):
        assert isinstance(said, FeatureFrame)
        assert isinstance(read, FeatureFrame)
        for a, b in zip(read.cameras, said.cameras, strict=True):
            assert_same(a, b)
    result = estimated(replay)
    assert_same_objects(result, estimated(sequence))
    found = result.metrics["moving_objects"]
    assert {row["label"] for row in found["objects"].values()} == {1, 2}
    assert found["accuracy"]["identity_switches"] == 0
    assert "masks_unused" not in result.warnings


def test_masks_that_are_named_take_the_place_of_labels(recorded: Path) -> None:
    masks = recorded / "masks"
    masks.mkdir()
    (masks / "boxes.csv").write_text("200,3,0,0,100,100\n")
    assert open_dataset(recorded).masks == 0, "labels say more than masks that are just there"
    named = open_dataset(recorded, sources={"masks": str(masks)})
    assert named.masks == 1
    assert named.mask_classes == {}


@pytest.mark.slow
def test_a_run_on_images_with_masks_is_recorded_with_labels(tmp_path: Path) -> None:
    sequence = simulate(
        kind="images", duration_s=3.0, rate_hz=10.0, objects={"count": 1, "masks": True}
    )
    truth, start = sequence.groundtruth(), sequence.initial_state()
    with TrackRecorder(tmp_path / "tracks", sequence.rig, None, truth, start) as recorder:
        result = estimated(sequence, recorder)
    replay = TrackRecordingSequence(tmp_path / "tracks")
    read = [frame for frame in replay.frames() if isinstance(frame, FeatureFrame)]
    on_object = [part.labels for f in read for part in (f.cameras[0], f.moving[0])]
    assert all(labels is not None for labels in on_object)
    assert sum(int(np.sum(labels)) for labels in on_object if labels is not None) > 100
    assert_same_objects(estimated(replay), result)


def test_the_front_end_alone_records_labels(tmp_path: Path) -> None:
    sequence = simulate(
        kind="images", duration_s=0.5, rate_hz=10.0, objects={"count": 1, "masks": True}
    )
    sequence.save(tmp_path / "flight")
    tracks, picture = tmp_path / "tracks", tmp_path / "tracks.png"
    arguments = ["frontend", str(tmp_path / "flight"), "--record", str(tracks)]
    done = CliRunner().invoke(app, [*arguments, "--picture", str(picture)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    for frame in TrackRecordingSequence(tracks).frames():
        assert isinstance(frame, FeatureFrame)
        assert frame.cameras[0].labels is not None


def test_a_comparison_records_labels_and_what_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a folder of masks that is named, from a relative path; it is told when it has changed."""
    sequence = simulate(
        kind="images", duration_s=0.5, rate_hz=10.0, objects={"count": 1, "masks": True}
    )
    sequence.save(tmp_path / "flight")
    (masks,) = (tmp_path / "flight").rglob("masks")
    masks = masks.rename(tmp_path / "named")
    (masks / "classes.csv").write_text("1,box\n")
    monkeypatch.chdir(tmp_path)

    def task(objects: bool, sensors: dict[str, str]) -> RecordTask:
        (source,) = find_sources([tmp_path / "flight"], None, (), None, sensors)
        config = load_config(overrides=[f"objects.enabled={str(objects).lower()}"])
        return RecordTask(source=source, seed=0, config=config, root=tmp_path / "tracks")

    wanted = task(True, {"masks": "named"})
    assert wanted.source.sources == {"masks": str(masks)}
    wanted.do()
    replay = TrackRecordingSequence(wanted.folder)
    assert replay.mask_classes == {1: "box"}
    for frame in replay.frames():
        assert isinstance(frame, FeatureFrame)
        assert frame.cameras[0].labels is not None
    assert wanted.folder == task(True, {"masks": "named"}).folder
    (masks / "classes.csv").write_text("1,another box\n")
    others = [task(True, {"masks": "named"}), task(True, {}), task(False, {"masks": "named"})]
    assert len({wanted.folder, *(other.folder for other in others)}) == 4
    others[2].do()
    assert not (others[2].folder / "labels.bin").exists()


def test_a_source_without_named_sensors_is_told_apart_as_before() -> None:
    (source,) = find_sources(["sim:figure8"], 1.0)
    assert not {"sources", "written"} & source.identity().keys()
    assert {"name", "recording", "simulation", "extent"} <= source.identity().keys()


def test_masks_are_not_read_where_nothing_is_recorded(tmp_path: Path) -> None:
    sequence = simulate(
        kind="images", duration_s=0.5, rate_hz=10.0, objects={"count": 1, "masks": True}
    )
    sequence.save(tmp_path / "flight")
    masks = tmp_path / "masks"
    masks.mkdir()
    (masks / "boxes.csv").write_text("100,nonsense,0,0,1,1\n" * 2)
    picture = str(tmp_path / "tracks.png")
    arguments = ["frontend", str(tmp_path / "flight"), "--source", f"masks={masks}"]
    done = CliRunner().invoke(app, [*arguments, "--picture", picture], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    arguments += ["--record", str(tmp_path / "tracks")]
    done = CliRunner().invoke(app, [*arguments, "--picture", picture])
    assert done.exit_code != 0


def test_simulated_labels_are_those_of_the_first_camera() -> None:
    sequence = simulate(duration_s=0.5, rate_hz=10.0, objects={"count": 1, "masks": True})
    for frame in sequence.frames():
        assert isinstance(frame, FeatureFrame)
        first, second = frame.cameras
        assert first.labels is not None
        assert set(np.unique(first.labels)) <= {0, 1}
        assert second.labels is None
