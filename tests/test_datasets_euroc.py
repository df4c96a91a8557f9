# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""EuRoC folders: real ones, and every way in which one can be broken."""

import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from recordings import (
    FRAME_PERIOD_NS,
    IMU_PERIOD_NS,
    START_NS,
    edit_line,
    edit_text,
    write_euroc,
    write_groundtruth,
    write_imu,
    write_lines,
)

from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.formats.euroc import EurocSequence
from slam_graph.datasets.sequence import ReaderOptions
from slam_graph.datasets.streams.pairing import ABSENT, group_by_time
from slam_graph.errors import DataError
from slam_graph.sensors.measurements import CameraFrame


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_euroc(tmp_path / "flight")


def run_through(path: Path) -> tuple[EurocSequence, list[CameraFrame]]:
    sequence = EurocSequence(path)
    frames = []
    for packet in sequence.packets():
        assert isinstance(packet.frame, CameraFrame)
        frames.append(packet.frame)
    return sequence, frames


def one_line(error: pytest.ExceptionInfo[DataError], *parts: str) -> None:
    """The message is one line and names all of `parts`."""
    message = str(error.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


# --- cameras in time ------------------------------------------------------------------------------


def test_camera_missing_a_frame_is_none_and_counted(folder: Path) -> None:
    edit_line(folder / "mav0" / "cam0" / "data.csv", 5, None)
    sequence, frames = run_through(folder)
    assert [frame.images[0] is None for frame in frames] == [k == 3 for k in range(8)]
    assert all(frame.images[1] is not None for frame in frames)
    assert frames[3].stamp_ns == START_NS + 3 * FRAME_PERIOD_NS + 300
    assert sequence.diagnostics.counts == {"camera_frame_missing": 1}
    assert sequence.info().frames == len(frames) == 8


def test_frames_beyond_the_tolerance_stay_apart(folder: Path) -> None:
    sequence = EurocSequence(folder, stereo_tolerance_s=1e-7)
    assert sequence.info().frames == 16


def test_grouping_never_mixes_neighbours() -> None:
    """Random clocks with dropped frames: groups are close in time, whole, and in order."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        ideal = np.arange(50) * FRAME_PERIOD_NS
        cameras = []
        for _ in range(3):
            kept = rng.random(50) > 0.2
            cameras.append((ideal + rng.integers(0, 10**6, 50))[kept])
        groups = group_by_time(cameras, 10**9)
        assert np.all(np.diff(groups.stamps_ns) > 0)
        assert not groups.skipped
        for c, stamps in enumerate(cameras):
            members = groups.members[:, c]
            assert np.array_equal(members[members != ABSENT], np.arange(len(stamps)))
            error = stamps[members[members != ABSENT]] - groups.stamps_ns[members != ABSENT]
            assert np.max(np.abs(error)) < 10**6


def test_camera_rows_out_of_order_are_dropped(folder: Path) -> None:
    index = folder / "mav0" / "cam0" / "data.csv"
    rows = index.read_text().splitlines()
    edit_line(index, 4, rows[2])
    sequence, frames = run_through(folder)
    assert sequence.diagnostics.counts["camera_out_of_order"] == 1
    assert len(frames) == 8


# --- the IMU --------------------------------------------------------------------------------------


def imu_file(folder: Path) -> Path:
    return folder / "mav0" / "imu0" / "data.csv"


def imu_row(folder: Path, line: int) -> str:
    return imu_file(folder).read_text().splitlines()[line - 1]


@pytest.mark.parametrize("bad", ["nan", "inf", "-inf"])
def test_imu_not_finite_is_dropped(folder: Path, bad: str) -> None:
    stamp = imu_row(folder, 30).split(",")[0]
    edit_line(imu_file(folder), 30, f"{stamp},0,{bad},0,0,0,9.81")
    sequence, frames = run_through(folder)
    assert sequence.diagnostics.counts == {"imu_not_finite": 1}
    assert int(stamp) not in sequence.imu().stamps_ns
    assert len(frames) == 8


def test_imu_duplicate_and_out_of_order_are_dropped(folder: Path) -> None:
    clean = EurocSequence(folder).imu()
    edit_line(imu_file(folder), 40, imu_row(folder, 40) + "\n" + imu_row(folder, 40))
    edit_line(imu_file(folder), 60, imu_row(folder, 60) + "\n" + imu_row(folder, 50))
    sequence, frames = run_through(folder)
    assert sequence.diagnostics.counts == {"imu_duplicate": 1, "imu_out_of_order": 1}
    assert np.array_equal(sequence.imu().accel, clean.accel)
    assert len(frames) == 8


def test_one_stamp_from_the_future_does_not_block_the_rest(folder: Path) -> None:
    clean = EurocSequence(folder).imu()
    values = imu_row(folder, 40).partition(",")[2]
    edit_line(imu_file(folder), 40, f"{START_NS * 2},{values}")
    sequence, frames = run_through(folder)
    assert sequence.diagnostics.counts == {"imu_out_of_order": 1}
    assert np.array_equal(sequence.imu().stamps_ns, np.delete(clean.stamps_ns, 38))
    assert len(frames) == 8


def test_imu_gap_and_frame_without_imu_are_counted(folder: Path) -> None:
    lines = imu_file(folder).read_text().splitlines()
    first = 1 + 20 + 2 * FRAME_PERIOD_NS // IMU_PERIOD_NS + 1  # the sample after frame 2
    del lines[first : first + 15]  # until after frame 3
    imu_file(folder).write_text("\n".join(lines) + "\n")
    sequence, frames = run_through(folder)
    assert sequence.diagnostics.counts == {"imu_gap": 1, "frame_without_imu": 1}
    assert len(frames) == 8


def test_frames_outside_the_imu_are_delivered_and_counted(folder: Path) -> None:
    write_imu(folder / "mav0", START_NS + FRAME_PERIOD_NS, 30)
    sequence, frames = run_through(folder)
    assert len(frames) == 8
    assert sequence.diagnostics.counts == {"frame_without_imu": 1 + 3}


def test_faults_before_the_start_are_not_counted(folder: Path) -> None:
    edit_line(imu_file(folder), 3, imu_row(folder, 3).rsplit(",", 1)[0] + ",nan")
    sequence = EurocSequence(folder)
    assert list(sequence.packets(START_NS + 2 * 10**9)) == []
    assert not sequence.diagnostics.counts


def test_bad_cell_names_file_and_line(folder: Path) -> None:
    edit_line(imu_file(folder), 33, imu_row(folder, 33).rsplit(",", 1)[0] + ",9.8x")
    with pytest.raises(DataError) as error:
        run_through(folder)
    one_line(error, "imu0/data.csv:33", "'9.8x' in column 7 is not a number")


@pytest.mark.parametrize("stamp", ["9223372036854775807", "-9223372036854775808"])
def test_stamps_whose_differences_do_not_fit_are_refused(folder: Path, stamp: str) -> None:
    sequence, _ = run_through(folder)
    truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    for file in (imu_file(folder), truth):
        values = file.read_text().splitlines()[29].partition(",")[2]
        edit_line(file, 30, f"{stamp},{values}")
    with pytest.raises(DataError, match=r"imu0/data\.csv:30: .* is not a time in nanoseconds"):
        run_through(folder)
    with pytest.raises(DataError, match=r"estimate0/data\.csv:30: .* is not a time in nanoseconds"):
        sequence.groundtruth()


def test_states_beyond_any_number_of_use_are_dropped(folder: Path) -> None:
    truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    edit_line(truth, 4, truth.read_text().splitlines()[3].replace(",0.2,", ",1e200,"))
    sequence, _ = run_through(folder)
    sequence.groundtruth()
    assert sequence.diagnostics.counts["groundtruth_not_finite"] == 1


def test_missing_column_names_file_and_line(folder: Path) -> None:
    edit_line(imu_file(folder), 2, imu_row(folder, 2).rsplit(",", 1)[0])
    with pytest.raises(DataError) as error:
        run_through(folder)
    one_line(error, "imu0/data.csv:2")


def test_blank_lines_and_line_ends_do_not_matter(folder: Path) -> None:
    clean = EurocSequence(folder).imu()
    text = imu_file(folder).read_text().replace("\n", "\r\n") + "\r\n# done\r\n"
    imu_file(folder).write_bytes(text.encode())
    again = EurocSequence(folder)
    assert np.array_equal(again.imu().gyro, clean.gyro)
    assert again.info().imu_samples == len(clean)


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    peaks = []
    for k, count in enumerate((5_000, 40_000)):
        root = write_euroc(tmp_path / str(k))
        write_imu(root / "mav0", START_NS, count)
        sequence = EurocSequence(root)
        tracemalloc.start()
        assert sum(len(block) for block in sequence.imu_blocks()) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


# --- what is not there ----------------------------------------------------------------------------


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError) as error:
        EurocSequence(tmp_path / "nowhere")
    one_line(error, "nowhere", "no such folder")


@pytest.mark.parametrize("part", ["imu0/data.csv", "imu0/sensor.yaml", "cam1/sensor.yaml"])
def test_missing_file(folder: Path, part: str) -> None:
    (folder / "mav0" / part).unlink()
    with pytest.raises(DataError) as error:
        EurocSequence(folder)
    one_line(error, part)


@pytest.mark.parametrize("part", ["imu0", "cam0", "state_groundtruth_estimate0"])
def test_empty_csv(folder: Path, part: str) -> None:
    file = folder / "mav0" / part / "data.csv"
    file.write_text(file.read_text().splitlines()[0] + "\n")
    with pytest.raises(DataError) as error:
        EurocSequence(folder)
    one_line(error, f"{part}/data.csv", "no ")


def test_images_without_index(folder: Path) -> None:
    (folder / "mav0" / "cam1" / "data.csv").unlink()
    with pytest.raises(DataError) as error:
        EurocSequence(folder)
    one_line(error, "cam1/data.csv")


def test_bad_camera_row(folder: Path) -> None:
    edit_line(folder / "mav0" / "cam1" / "data.csv", 4, "soon,1.png")
    with pytest.raises(DataError) as error:
        EurocSequence(folder)
    one_line(error, "cam1/data.csv:4", "soon")


def test_too_many_cameras(folder: Path) -> None:
    with pytest.raises(DataError) as error:
        EurocSequence(folder, ReaderOptions(cameras=3))
    one_line(error, "3 cameras", "has 2")


def test_no_groundtruth(folder: Path) -> None:
    os.rename(folder / "mav0" / "state_groundtruth_estimate0", folder / "elsewhere")
    sequence, _ = run_through(folder)
    assert sequence.groundtruth() is None
    assert not sequence.info().has_groundtruth
    options = ReaderOptions(groundtruth=folder / "elsewhere" / "data.csv")
    given = EurocSequence(folder, options).groundtruth()
    assert given is not None


# --- calibration ----------------------------------------------------------------------------------


def test_unknown_distortion_model(folder: Path) -> None:
    file = folder / "mav0" / "cam1" / "sensor.yaml"
    edit_text(file, "radial-tangential", "fov")
    with pytest.raises(DataError) as error:
        EurocSequence(folder)
    one_line(error, "cam1/sensor.yaml:15", "'fov'", "equidistant")


def test_calibration_that_is_no_rotation(folder: Path) -> None:
    file = folder / "mav0" / "cam0" / "sensor.yaml"
    edit_text(file, "data: [0.0, 0.0, 1.0", "data: [0.1, 0.0, 1.0")
    with pytest.raises(DataError) as error:
        EurocSequence(folder)
    one_line(error, "cam0/sensor.yaml:5", "not a rotation")


def test_other_calibration(folder: Path, tmp_path: Path) -> None:
    own = EurocSequence(folder)
    write_kalibr(own.rig.select(1), tmp_path / "mono.yaml")
    (folder / "mav0" / "cam0" / "sensor.yaml").unlink()
    sequence = EurocSequence(folder, ReaderOptions(calibration=tmp_path / "mono.yaml"))
    assert sequence.info().cameras == 1
    assert sequence.rig.cameras[0].body_T_camera.equals(own.rig.cameras[0].body_T_camera, 1e-12)
    with pytest.raises(DataError):
        EurocSequence(folder, ReaderOptions(2, tmp_path / "mono.yaml"))


# --- real recordings ------------------------------------------------------------------------------


@pytest.mark.data
def test_inertial_recordings_open_without_images(data_dir: Path) -> None:
    sequence = EurocSequence(data_dir / "euroc_inertial" / "V2_01_easy")
    info, imu, truth = sequence.info(), sequence.imu(), sequence.groundtruth()
    assert truth is not None
    assert truth.accel_biases is not None
    assert (info.frames, info.imu_samples, len(truth)) == (0, 22621, 22401)
    assert (info.start_ns, info.end_ns) == (imu.stamps_ns[0], imu.stamps_ns[-1])
    assert list(sequence.packets()) == []


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("at", [0, 500, 1021, 1022, 1023, 1024, 2040])
def test_stamps_from_the_future_cost_themselves_only(folder: Path, at: int, count: int) -> None:
    """Wherever they are in the blocks in which a file is read."""
    write_imu(folder / "mav0", START_NS - 20 * IMU_PERIOD_NS, 2100)
    write_groundtruth(folder / "mav0", 7, 2100)
    for name in ("imu0", "state_groundtruth_estimate0"):
        path = folder / "mav0" / name / "data.csv"
        lines = path.read_text().splitlines()
        for k in range(at + 1, at + 1 + count):
            stamp, _, rest = lines[k].partition(",")
            lines[k] = f"{int(stamp) + 100 * 10**9},{rest}"
        write_lines(path, lines)
    sequence, _ = run_through(folder)
    truth = sequence.groundtruth()
    assert truth is not None
    assert (len(sequence.imu()), len(truth)) == (2100 - count, 2100 - count)
    assert sequence.diagnostics.counts["groundtruth_out_of_order"] == count
