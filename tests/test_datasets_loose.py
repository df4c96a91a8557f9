# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Videos and image folders: where their times come from, and what is wrong with them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import FRAME_PERIOD_NS, START_NS, edit_line, edit_text, write_lines
from recordings_loose import (
    CHAIN,
    SIZE,
    STAMPS_NS,
    pictures,
    write_flight_video,
    write_image_folder,
    write_inertial,
    write_times,
    write_video,
)
from typer.testing import CliRunner

from slam_graph.cli.main import app
from slam_graph.datasets.data_checks import check_sequence
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.frontend_protocol import build_frontend
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors.measurements import CameraFrame

WITHOUT_IMU = CHAIN.replace(CHAIN.splitlines()[1] + "\n", "")


def frames_of(sequence: RecordedSequence) -> list[CameraFrame]:
    frames = list(sequence.frames())
    assert all(isinstance(frame, CameraFrame) for frame in frames)
    return frames  # type: ignore[return-value]


def same_pictures(frames: list[CameraFrame], numbers: list[int]) -> bool:
    expected = pictures()
    return len(frames) == len(numbers) and all(
        np.array_equal(frame.images[0], expected[k])
        for frame, k in zip(frames, numbers, strict=True)
    )


def refused(path: Path, match: str, **sources: object) -> None:
    with pytest.raises(DataError, match=match) as error:
        open_dataset(path, sources={key: str(value) for key, value in sources.items()})
    assert "\n" not in str(error.value)


# --- video ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["flight.mkv", "flight.avi"])
def test_a_video_comes_as_it_was_written(tmp_path: Path, name: str) -> None:
    path = write_video(tmp_path, name)
    times = write_times(tmp_path / "when.txt", in_seconds=True)
    sequence = open_dataset(path, sources={"stamps": str(times)})
    frames = frames_of(sequence)
    assert same_pictures(frames, list(range(8)))
    assert [frame.stamp_ns for frame in frames] == STAMPS_NS
    info = sequence.info()
    assert (info.format, info.name, info.frames, info.imu_samples) == ("video", "flight", 8, 0)
    part = list(sequence.frames(STAMPS_NS[3], STAMPS_NS[5]))
    assert same_pictures(part, [3, 4, 5])  # type: ignore[arg-type]
    assert not sequence.diagnostics.counts


def test_the_imu_of_a_video_lies_beside_it(tmp_path: Path) -> None:
    path = write_flight_video(tmp_path)
    sequence = open_dataset(path)
    assert sequence.info().imu_samples == 95
    assert sequence.imu().stamps_ns[20] == START_NS
    told = write_inertial(tmp_path / "other.csv", in_seconds=True)
    again = open_dataset(path, sources={"imu": str(told)})
    assert np.array_equal(again.imu().stamps_ns, sequence.imu().stamps_ns)
    assert np.array_equal(again.imu().accel, sequence.imu().accel)


def test_without_times_the_container_is_taken_at_its_word(tmp_path: Path) -> None:
    path = write_video(tmp_path)
    sequence = open_dataset(path)
    stamps = [frame.stamp_ns for frame in frames_of(sequence)]
    assert stamps == [k * 50_000_000 for k in range(8)]
    assert sequence.diagnostics.counts == {"stamps_assumed": 1}
    told = open_dataset(path, sources={"rate": "10"})
    assert [frame.stamp_ns for frame in frames_of(told)] == [k * 10**8 for k in range(8)]
    assert not told.diagnostics.counts


def test_a_stream_without_a_frame_rate_needs_times(tmp_path: Path) -> None:
    path = write_video(tmp_path, "flight.mjpeg", "MJPG")
    refused(path, "container has no frame rate; give --source stamps=FILE or")
    times = write_times(tmp_path / "when.csv")
    sequence = open_dataset(path, sources={"stamps": str(times)})
    assert [frame.stamp_ns for frame in frames_of(sequence)] == STAMPS_NS


@pytest.mark.parametrize("count", [6, 9])
def test_more_or_less_times_than_frames(tmp_path: Path, count: int) -> None:
    path = write_video(tmp_path)
    write_times(path.with_suffix(".csv"), count=count)
    sequence = open_dataset(path)
    assert same_pictures(frames_of(sequence), list(range(min(count, 8))))
    assert sequence.diagnostics.counts == {"stamps_differ": 1}


def test_times_that_go_back_cost_one_frame(tmp_path: Path) -> None:
    path = write_flight_video(tmp_path)
    edit_line(path.with_suffix(".csv"), 4, str(STAMPS_NS[2] + 10**10))
    edit_line(path.with_suffix(".csv"), 8, str(STAMPS_NS[1]))
    sequence = open_dataset(path)
    assert same_pictures(frames_of(sequence), [0, 1, 3, 4, 5, 7])
    assert sequence.diagnostics.counts == {"camera_out_of_order": 2}


def test_a_cut_video_is_read_to_its_end(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_video(tmp_path, "flight.avi")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    write_times(path.with_suffix(".csv"))
    sequence = open_dataset(path)
    frames = frames_of(sequence)
    assert 3 <= len(frames) < 8
    assert same_pictures(frames, list(range(len(frames))))
    assert sequence.diagnostics.counts == {"video_ended_early": 1}
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("content", [b"", b"not a video", b"\x00" * 1000])
def test_what_is_not_a_video(
    tmp_path: Path, content: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write_video(tmp_path)
    path.write_bytes(content)
    refused(path, r"flight\.mkv: this video cannot be opened")
    assert capfd.readouterr().err == ""


def test_a_video_of_another_size(tmp_path: Path) -> None:
    path = write_flight_video(tmp_path)
    edit_text(path.with_suffix(".yaml"), "[64, 48]", "[32, 24]")
    refused(path, r"64x48 \(2 times as large\), the calibration is for 32x24")


def test_a_video_without_calibration(tmp_path: Path) -> None:
    path = write_flight_video(tmp_path)
    path.with_suffix(".yaml").unlink()
    refused(path, r"no calibration \(flight.yaml\) beside the images; give --calibration")


def test_decoding_stops_with_the_reader(tmp_path: Path) -> None:
    frames = open_dataset(write_flight_video(tmp_path)).frames()
    next(frames)
    frames.close()


# --- image folders --------------------------------------------------------------------------------


def test_an_image_folder(tmp_path: Path) -> None:
    """Times without names belong to the images by number: frame9 before frame10."""
    sequence = open_dataset(write_image_folder(tmp_path / "walk"))
    frames = frames_of(sequence)
    assert same_pictures(frames, list(range(8)))
    assert [frame.stamp_ns for frame in frames] == STAMPS_NS
    assert (sequence.info().format, sequence.info().imu_samples) == ("images", 95)
    assert not sequence.diagnostics.counts


def test_times_that_name_the_images(tmp_path: Path) -> None:
    path = write_image_folder(tmp_path / "walk")
    names = ["frame8.png", "images/frame6.png", "gone.png"]
    rows = [f"{t}, {name}" for t, name in zip(STAMPS_NS, names, strict=False)]
    write_lines(path / "timestamps.csv", ["time [ns],name", *rows])
    sequence = open_dataset(path)
    frames = frames_of(sequence)
    assert same_pictures(frames[:2], [2, 0])
    assert frames[2].images == (None,)
    assert sequence.diagnostics.counts == {"image_unreadable": 1}


@pytest.mark.parametrize("in_seconds", [False, True])
def test_names_that_are_times(tmp_path: Path, in_seconds: bool) -> None:
    path = write_image_folder(tmp_path / "walk", inertial=False)
    (path / "timestamps.csv").unlink()
    for k, stamp in enumerate(STAMPS_NS):
        name = f"{stamp // 10**9}.{stamp % 10**9 // 10**6:03d}" if in_seconds else str(stamp)
        (path / "images" / f"frame{k + 6}.png").rename(path / "images" / f"{name}.png")
    frames = frames_of(open_dataset(path))
    assert same_pictures(frames, list(range(8)))
    difference = np.array([frame.stamp_ns for frame in frames]) - STAMPS_NS
    assert np.max(np.abs(difference)) < 10**6
    assert in_seconds or not difference.any()


def test_images_without_times_need_a_rate(tmp_path: Path) -> None:
    path = write_image_folder(tmp_path / "walk", inertial=False)
    (path / "timestamps.csv").unlink()
    refused(path, "no times of these images .* --source stamps=FILE or --source rate=HZ")
    frames = frames_of(open_dataset(path, sources={"rate": "20"}))
    assert [frame.stamp_ns for frame in frames] == [k * FRAME_PERIOD_NS for k in range(8)]


def write_three_folders(path: Path) -> Path:
    """Images of two cameras and depth, without times, that tell their number."""
    for name, unit in (("left", np.uint8(1)), ("right", np.uint8(1)), ("depth", np.uint16(100))):
        (path / name).mkdir(parents=True)
        for k in range(10):
            image = np.full((SIZE[1], SIZE[0]), (k + 1) * unit, unit.dtype)
            cv2.imwrite(str(path / name / f"{k}.png"), image)
    first, _, noise = WITHOUT_IMU.partition("imu0:")
    second = first.replace("cam0:", f"cam1:\n  T_cn_cnm1: {np.eye(4).tolist()}")
    depth = "depth0: {range_m: [0, 8]}\n"
    (path / "calibration.yaml").write_text(f"{first}{second}{depth}imu0:{noise}")
    return path


@pytest.mark.parametrize("told", ["rate", "times"])
def test_a_missing_file_shifts_no_other_one(tmp_path: Path, told: str) -> None:
    """Whatever the times are from, images of one name belong together."""
    path = write_three_folders(tmp_path)
    for gone in ("right/4.png", "depth/2.png", "left/7.png"):
        (path / gone).unlink()
    if told == "times":
        write_times(path / "timestamps.csv", count=9)
    sequence = open_dataset(path, sources={"rate": "20"} if told == "rate" else None)
    found = []
    for frame in frames_of(sequence):
        left, right = frame.images
        assert left is not None
        values = [left, right, None if frame.depth is None else frame.depth * 10]
        found.append([None if image is None else round(float(image[0, 0])) for image in values])
    expected = [[k, None if k == 5 else k, None if k == 3 else k] for k in range(1, 11) if k != 8]
    assert found == expected
    assert sequence.diagnostics.counts == {"camera_frame_missing": 3}


def test_images_of_other_names_are_as_many_or_refused(tmp_path: Path) -> None:
    path = write_three_folders(tmp_path)
    for k in range(10):
        (path / "right" / f"{k}.png").rename(path / "right" / f"r{k}.png")
    frames = frames_of(open_dataset(path, sources={"rate": "20"}))
    pairs = [[image[0, 0] for image in frame.images if image is not None] for frame in frames]
    assert pairs == [[k, k] for k in range(1, 11)]
    (path / "right" / "r3.png").unlink()
    refused(path, "right: 9 images, none with the name of one of the 10 in", rate=20)


def test_a_camera_of_an_euroc_folder_is_an_image_folder(tmp_path: Path) -> None:
    path = tmp_path / "cam0"
    (path / "data").mkdir(parents=True)
    for stamp, picture in zip(STAMPS_NS, pictures(), strict=True):
        cv2.imwrite(str(path / "data" / f"{stamp}.png"), picture)
    write_lines(path / "data.csv", ["#t,name", *(f"{s},{s}.png" for s in STAMPS_NS)])
    (path / "calibration.yaml").write_text(WITHOUT_IMU)
    frames = frames_of(open_dataset(path))
    assert same_pictures(frames, list(range(8)))
    assert [frame.stamp_ns for frame in frames] == STAMPS_NS


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ({"stamps": "nowhere.csv"}, "nowhere.csv: no such file"),
        ({"rate": "often"}, "rate=often is not a number"),
        ({"rate": "0"}, "rate=0 is not"),
        ({"rate": "20", "stamps": "nowhere.csv"}, "no such file|both given"),
        ({"cam0": "/cam0"}, "unknown source 'cam0'; known: stamps, rate, imu"),
    ],
)
def test_sources_that_make_no_sense(tmp_path: Path, sources: dict[str, str], message: str) -> None:
    refused(write_image_folder(tmp_path / "walk"), message, **sources)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], r"timestamps.csv: no time stamps"),
        (["#time", "1.5", "soon"], r"timestamps.csv:3: 'soon' is not a time"),
        (["0.1", "0.2", "0.3"], r"3 times without names, 8 images"),
        ([str(33 * k) for k in range(8)], r"stamps are 33 ns apart; whole numbers are nanoseconds"),
    ],
)
def test_tables_of_times_that_cannot_be_used(
    tmp_path: Path, lines: list[str], message: str
) -> None:
    path = write_image_folder(tmp_path / "walk")
    write_lines(path / "timestamps.csv", lines)
    refused(path, message)


def test_colour_and_sixteen_bits_become_grey_and_other_sizes_are_counted(tmp_path: Path) -> None:
    path = write_image_folder(tmp_path / "walk")
    first, second = pictures()[:2]
    cv2.imwrite(str(path / "images" / "frame6.png"), cv2.cvtColor(first, cv2.COLOR_GRAY2BGR))
    cv2.imwrite(str(path / "images" / "frame7.png"), second.astype(np.uint16) * 256 + 99)
    cv2.imwrite(str(path / "images" / "frame10.png"), np.zeros((20, 30), np.uint8))
    file = path / "images" / "frame8.png"
    file.write_bytes(file.read_bytes()[:700])
    sequence = open_dataset(path)
    images = [frame.images[0] for frame in frames_of(sequence)]
    assert np.array_equal(images[0], first)
    assert np.array_equal(images[1], second)
    assert [image is None for image in images] == [k in (2, 4) for k in range(8)]
    assert sequence.diagnostics.counts == {"image_unreadable": 1, "image_wrong_size": 1}


# --- without an IMU -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["video", "images"])
def test_one_camera_alone_says_what_it_waits_for(tmp_path: Path, kind: str) -> None:
    """The calibration then does not need to say where an IMU is."""
    if kind == "video":
        path = write_video(tmp_path)
        path.with_suffix(".yaml").write_text(WITHOUT_IMU)
    else:
        path = write_image_folder(tmp_path / "walk", inertial=False)
        (path / "calibration.yaml").write_text(WITHOUT_IMU)
    sequence = open_dataset(path)
    assert sequence.info().frames == 8
    assert sequence.rig.cameras[0].camera.width == SIZE[0]
    assert [len(packet.imu) for packet in sequence.packets()] == [0] * 8
    tracker = build_frontend(sequence.rig, FrontendConfig(), 0, Diagnostics(), "images")
    features = [tracker.track(packet.frame).cameras[0] for packet in sequence.packets()]
    assert all(len(seen) > 0 for seen in features)
    result = run(sequence)
    assert result.status == "not_initialized"
    assert "waiting for frames that share 20 features" in result.message
    with pytest.raises(ConfigError, match="has no IMU; use constant_velocity"):
        run(sequence, overrides=["backend.dynamics.model=imu"])


def test_a_check_tells_what_was_noticed_on_opening(tmp_path: Path) -> None:
    path = write_video(tmp_path)
    edit_text(path.with_suffix(".yaml"), "camera_model", "shutter: rolling\n  camera_model")
    findings = [found.what for found in check_sequence(open_dataset(path))]
    for kind in ("stamps_assumed", "rolling_shutter"):
        assert any(what.startswith(f"{kind}: 1 times") for what in findings)


def test_a_refused_run_leaves_no_folder(tmp_path: Path) -> None:
    path = write_image_folder(tmp_path / "walk", inertial=False)
    arguments = ["run", str(path), "--no-progress", "--output", str(tmp_path / "results")]
    arguments += ["--set", "backend.dynamics.model=imu"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 1
    assert "no IMU" in str(done.exception)
    assert not list((tmp_path / "results").iterdir())


def test_with_an_imu_the_calibration_must_say_where_it_is(tmp_path: Path) -> None:
    path = write_image_folder(tmp_path / "walk")
    (path / "calibration.yaml").write_text(WITHOUT_IMU)
    refused(path, "missing key 'T_cam_imu'")
