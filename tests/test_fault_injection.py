# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Faults that are put into a recording: where they strike, and that they leave the rest alone."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from recordings import FRAME_PERIOD_NS, START_NS, write_euroc
from typer.testing import CliRunner

from slam_graph.cli.main import app
from slam_graph.datasets import RecordedSequence, dataset_from_arrays, open_dataset
from slam_graph.datasets.faults.fault import FAULTS, Fault
from slam_graph.datasets.faults.injection import inject
from slam_graph.errors import ConfigError, DataError
from slam_graph.sensors import CameraFrame, FeatureFrame, ImuData
from slam_graph.simulation import simulate

AT_S, FOR_S = 1.0, 0.5
OF_FILES = ("image_size", "image_16_bit", "image_colour")


@pytest.fixture(scope="module")
def tracks() -> RecordedSequence:
    """Three seconds of two cameras."""
    return simulate(trajectory="figure8", cameras=2, duration_s=3.0, tracks={"features": 30})


@pytest.fixture(scope="module")
def images(tracks: RecordedSequence) -> RecordedSequence:
    """Random images at the times of the tracks."""
    stamps = np.array([frame.stamp_ns for frame in tracks.frames()])
    imu, rng = tracks.imu(), np.random.default_rng(0)
    shots = [
        rng.integers(0, 200, (len(stamps), c.camera.height, c.camera.width), np.uint8)
        for c in tracks.rig.cameras
    ]
    return dataset_from_arrays(
        tracks.rig,
        imu_stamps_ns=imu.stamps_ns,
        gyro=imu.gyro,
        accel=imu.accel,
        image_stamps_ns=stamps,
        images=shots,
    )


def fault_of(name: str) -> Fault:
    """A fault that strikes for half a second."""
    kind = FAULTS[name]
    share = {"share": 0.5} if "share" in kind.model_fields else {}
    return kind(at_s=AT_S, duration_s=FOR_S, **share)


def contents(frame: CameraFrame | FeatureFrame) -> list[bytes]:
    """What a frame holds."""
    if isinstance(frame, CameraFrame):
        return [b"" if image is None else image.tobytes() for image in frame.images]
    return [seen.pixels.tobytes() for seen in frame.cameras]


def split(recording: RecordedSequence, at_ns: int) -> tuple[list[object], list[object]]:
    """All that is recorded before a time, and from then on."""
    frames = [(frame.stamp_ns, contents(frame)) for frame in recording.frames()]
    imu = recording.imu()
    samples = list(zip(imu.stamps_ns, np.hstack([imu.gyro, imu.accel]).tolist(), strict=True))
    everything = [*frames, *samples]
    return [x for x in everything if x[0] < at_ns], [x for x in everything if x[0] >= at_ns]


@pytest.mark.parametrize(
    ("name", "content"),
    [*product(FAULTS, ["images"]), *product([n for n in FAULTS if n not in OF_FILES], ["tracks"])],
)
def test_a_fault_changes_what_it_covers_and_nothing_before(
    name: str, content: str, request: pytest.FixtureRequest
) -> None:
    """Before a fault begins the recording is as it was; then it differs."""
    recording = request.getfixturevalue(content)
    at_ns = recording.info().start_ns + round(AT_S * 1e9)
    before, after = split(recording, at_ns)
    faulty_before, faulty_after = split(inject(recording, [fault_of(name)]), at_ns)
    assert faulty_before == before
    lossless = name in ("imu_duplicated", "image_16_bit", "image_colour")
    if not lossless:
        assert faulty_after != after


@pytest.mark.parametrize("name", ["image_16_bit", "image_colour"])
def test_readers_take_images_of_other_kinds(images: RecordedSequence, name: str) -> None:
    """Deeper images and coloured ones of the same content read as the same image."""
    for frame, faulty in zip(
        images.frames(), inject(images, [fault_of(name)]).frames(), strict=True
    ):
        for image, found in zip(frame.images, faulty.images, strict=True):
            np.testing.assert_array_equal(image, found)


def test_images_of_another_size_are_missing_and_counted(images: RecordedSequence) -> None:
    """As a reader does with such files."""
    faulty = inject(images, [fault_of("image_size")])
    before = faulty.diagnostics.counts["image_wrong_size"]
    missing = sum(image is None for frame in faulty.frames() for image in frame.images)
    assert missing > 0
    assert faulty.diagnostics.counts["image_wrong_size"] - before == missing


def test_faults_of_files_are_refused_on_tracks(tracks: RecordedSequence) -> None:
    """Rather than ignored."""
    with pytest.raises(DataError, match="image files"):
        list(inject(tracks, [fault_of("image_size")]).frames())


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("imu_duplicated", "imu_duplicate"),
        ("imu_out_of_order", "imu_out_of_order"),
        ("imu_nan", "imu_not_finite"),
        ("imu_missing", "imu_gap"),
        ("imu_dropped", "imu_sample_missing"),
    ],
)
def test_the_imu_is_cleaned_as_by_a_reader(tracks: RecordedSequence, name: str, kind: str) -> None:
    """What a reader counts is counted, and stamps increase."""
    faulty = inject(tracks, [f"{name}:at_s={AT_S}"])
    before = faulty.diagnostics.counts[kind]
    imu = faulty.imu()
    assert faulty.diagnostics.counts[kind] > before
    assert np.all(np.diff(imu.stamps_ns) > 0)


def test_a_camera_without_images_is_counted_as_by_a_reader(images: RecordedSequence) -> None:
    faulty = inject(images, [f"camera_lost:at_s={AT_S},camera=1"])
    before = faulty.diagnostics.counts["camera_frame_missing"]
    missing = sum(image is None for frame in faulty.frames() for image in frame.images)
    assert missing > 0
    assert faulty.diagnostics.counts["camera_frame_missing"] - before == missing


def test_being_kidnapped_takes_time_out_of_everything(tracks: RecordedSequence) -> None:
    """Frames, IMU and truth go on without a gap in time, from another place."""
    faulty = inject(tracks, [f"kidnapped:at_s=2,duration_s={FOR_S}"])
    info, shorter = tracks.info(), faulty.info()
    assert info.end_ns - shorter.end_ns == round(FOR_S * 1e9)
    stamps = np.array([frame.stamp_ns for frame in faulty.frames()])
    assert stamps[-1] == shorter.end_ns
    assert np.diff(stamps).max() < 2 * np.diff(stamps).min()
    truth = faulty.groundtruth()
    assert truth is not None
    np.testing.assert_array_equal(np.isin(stamps, truth.stamps_ns), True)
    jump = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
    assert jump.max() > 3 * np.median(jump)


def test_faults_strike_in_their_order(tracks: RecordedSequence) -> None:
    """A sample that is dropped cannot be an outlier any more."""
    imu: ImuData = inject(tracks, ["imu_outlier:at_s=1", "imu_missing:at_s=0.9"]).imu()
    assert np.abs(imu.accel).max() < 1e3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("imu_mising", "did you mean 'imu_missing'"),
        ("imu_missing:at=3", "did you mean 'at_s'"),
        ("imu_missing:at_s", "NAME:setting=value"),
        ("imu_late:by_s=x", "by_s"),
        ("imu_late:by_s=1e300", "by_s"),
        ("imu_missing:at_s=2001-13-41", "at_s"),
        ("imu_missing:at_s=" + "[" * 3000, "at_s"),
        ("imu_missing:seed=" + "9" * 5000, "seed"),
        ("imu_zeros:seed=-1", "seed"),
        ("imu_zeros:at_s=1,at_s=2", "at_s is there twice"),
    ],
)
def test_wrong_texts_are_named(tracks: RecordedSequence, text: str, message: str) -> None:
    """In one line that says what there is."""
    with pytest.raises(ConfigError, match=message):
        inject(tracks, [text])


def test_a_fault_that_never_begins_is_refused(tracks: RecordedSequence) -> None:
    """Rather than ignored."""
    with pytest.raises(DataError, match=r"never begins: the recording has 3\.0 s"):
        inject(tracks, ["imu_missing:at_s=900"])
    inject(tracks, ["clock_jump:at_s=1,by_s=20", "imu_missing:at_s=22"])  # they follow each other
    with pytest.raises(DataError, match="ImuMissing with at_s=22"):
        inject(tracks, ["imu_missing:at_s=22", "clock_jump:at_s=1,by_s=20"])


def test_a_fault_of_a_camera_that_is_not_there_is_refused(tracks: RecordedSequence) -> None:
    """Rather than ignored."""
    with pytest.raises(DataError, match="the recording has 2"):
        inject(tracks, ["camera_lost:camera=2"])
    lost = inject(tracks, [f"camera_lost:at_s={AT_S},camera=null"])
    assert any(not any(len(seen) for seen in frame.cameras) for frame in lost.frames())


def test_a_run_on_a_faulty_recording(tmp_path: object) -> None:
    """From the command line; what was lost is counted."""
    found = CliRunner().invoke(
        app,
        f"run demo --duration 3 --inject imu_dropped:at_s=1 --no-final-ba --output {tmp_path}",
    )
    assert found.exit_code == 0, found.output
    wrong = CliRunner().invoke(app, f"run demo --inject nothing --output {tmp_path}")
    assert isinstance(wrong.exception, ConfigError)


@pytest.mark.parametrize(
    ("fault", "shift_s", "lost"),
    [
        ("frames_dropped:at_s=0.1,duration_s=0.1", 0.0, 2),
        ("clock_jump:at_s=0.1,by_s=2.0", 2.0, 0),
        ("kidnapped:at_s=0.1,duration_s=0.1", -0.1, 2),
        ("image_other_place:at_s=0.1,duration_s=0.1", 0.0, 0),
    ],
)
def test_masks_and_true_objects_stay_with_their_frames(
    tmp_path: Path, fault: str, shift_s: float, lost: int
) -> None:
    """Also where a fault gives frames other stamps; masks that a fault belies are named."""
    path = write_euroc(tmp_path / "flight", cameras=1)
    stamps = [START_NS + k * FRAME_PERIOD_NS for k in range(8)]
    (path / "masks").mkdir()
    rows = "".join(f"{stamp},{k + 1},0,0,60,40\n" for k, stamp in enumerate(stamps))
    (path / "masks" / "boxes.csv").write_text(rows)
    truth = "".join(f"{stamp},1,{k},0,0,0,0,0,1\n" for k, stamp in enumerate(stamps))
    (path / "objects_truth.csv").write_text(truth)
    faulty = open_dataset(path, faults=[fault])
    assert faulty.labels_over_time() is not None
    warned = int(fault.startswith("image_other"))
    assert faulty.diagnostics.counts["masks_without_fault"] == warned
    frames = [frame.stamp_ns for frame in faulty.frames()]
    numbers = [k + 1 for k in range(8) if not 2 <= k < 2 + lost]
    assert [int(image[5, 5]) for s in frames if (image := faulty.label_image(s)) is not None] == (
        numbers
    )
    assert frames[-1] == stamps[-1] + round(shift_s * 1e9)
    assert faulty.object_truth()[1].stamps_ns[-1] == frames[-1]
