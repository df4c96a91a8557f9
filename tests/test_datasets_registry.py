# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Guessing formats, ground truth in its formats, and the checks of a recording."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from recordings import (
    CAMERA_YAML,
    START_NS,
    edit_line,
    edit_text,
    write_euroc,
    write_groundtruth,
    write_lines,
    write_openvins,
)

from slam_graph.datasets.data_checks import check_sequence
from slam_graph.datasets.dataset_registry import DATASETS, open_dataset
from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError


def test_formats_are_guessed(tmp_path: Path) -> None:
    write_euroc(tmp_path / "flight")
    write_openvins(tmp_path / "simulated")
    assert open_dataset(str(tmp_path / "flight")).info().format == "euroc"
    assert open_dataset(tmp_path / "flight" / "mav0").info().format == "euroc"
    assert open_dataset(tmp_path / "simulated").info().format == "openvins_sim"
    assert open_dataset("demo").info().format == "eqvio"
    assert open_dataset("demo").info().name == "demo", "where its results lie"


def test_unknown_path_names_all_formats(tmp_path: Path) -> None:
    with pytest.raises(DataError) as error:
        open_dataset(tmp_path)
    assert not [name for name in DATASETS if f"{name}: " not in str(error.value)]
    assert "\n" not in str(error.value)


def test_missing_path_and_unknown_format(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file or folder"):
        open_dataset(tmp_path / "nothing")
    with pytest.raises(ConfigError, match=r"unknown data set format 'eurok'; .*'euroc'.*kitti_raw"):
        open_dataset(tmp_path, format="eurok")
    with pytest.raises(DataError, match=r"tracks\.csv|calib\.yaml"):
        open_dataset(tmp_path, format="openvins_sim")


# --- ground truth ---------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [7, 10, 16])
def test_euroc_groundtruth_columns(tmp_path: Path, columns: int) -> None:
    write_groundtruth(tmp_path / "mav0", columns, 5)
    truth = read_groundtruth(tmp_path)
    assert len(truth) == 5
    assert truth.stamps_ns[0] == START_NS
    np.testing.assert_allclose(truth.quaternions, np.tile([0.5, -0.5, 0.5, 0.5], (5, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(truth.quaternions, axis=1), 1.0, atol=1e-15)
    assert (truth.velocities is not None) == (columns >= 10)
    assert (truth.gyro_biases is not None) == (columns == 16)
    if truth.gyro_biases is not None and truth.accel_biases is not None:
        np.testing.assert_allclose(truth.gyro_biases[0], [0.3, 0.4, 0.5])
        np.testing.assert_allclose(truth.accel_biases[0], [0.6, 0.7, 0.8])


def test_odd_number_of_columns(tmp_path: Path) -> None:
    write_groundtruth(tmp_path / "mav0", 9, 5)
    with pytest.raises(DataError, match=r"data\.csv:2: 9 values after the time stamp"):
        read_groundtruth(tmp_path)


def test_tum_groundtruth(tmp_path: Path) -> None:
    file = tmp_path / "truth.tum"
    write_lines(file, ["# t x y z qx qy qz qw", "1403636579.763555584 1 2 3 0 0 0.6 0.8"])
    truth = read_groundtruth(file)
    assert truth.stamps_ns.tolist() == [START_NS]
    assert truth.pose(0).equals(
        gtsam.Pose3(gtsam.Rot3.Quaternion(0.8, 0, 0, 0.6), np.array([1.0, 2, 3])), 1e-12
    )
    edit_line(file, 2, "1403636579.763555584 1 2 3 0 0 0.6 none")
    with pytest.raises(DataError, match=r"truth\.tum:2: 'none' in column 8"):
        read_groundtruth(file)
    edit_line(file, 2, "1403636579.763555584 1 2 3")
    with pytest.raises(DataError, match=r"truth\.tum:2: 4 columns"):
        read_groundtruth(file)


def test_faulty_groundtruth_rows_are_dropped(tmp_path: Path) -> None:
    write_groundtruth(tmp_path / "mav0", 7, 6)
    file = tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    rows = file.read_text().splitlines()
    edit_line(file, 3, rows[2].replace("0.2", "nan"))
    edit_line(file, 4, rows[3].split(",")[0] + ",1,2,3,0,0,0,0")
    edit_line(file, 6, rows[1])
    diagnostics = Diagnostics()
    truth = read_groundtruth(tmp_path, diagnostics)
    assert diagnostics.counts == {"groundtruth_not_finite": 2, "groundtruth_out_of_order": 1}
    assert len(truth) == 3


def test_groundtruth_of_another_frame_is_moved_to_the_imu(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    folder = tmp_path / "mav0" / "state_groundtruth_estimate0"
    before = read_groundtruth(tmp_path)
    (folder / "sensor.yaml").write_text(CAMERA_YAML.format(y=0.3))
    after = read_groundtruth(tmp_path)
    body_T_marker = gtsam.Pose3(
        gtsam.Rot3(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])), np.array([0.1, 0.3, 0])
    )
    for k in range(len(after)):
        assert after.pose(k).compose(body_T_marker).equals(before.pose(k), 1e-9)


def test_no_groundtruth_in_a_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no ground truth here"):
        read_groundtruth(tmp_path)


# --- checks ---------------------------------------------------------------------------------------


def found(path: Path | str, read_images: bool = False) -> dict[str, list[str]]:
    findings = check_sequence(open_dataset(path), read_images)
    texts: dict[str, list[str]] = {"error": [], "warning": [], "info": []}
    for finding in findings:
        texts[finding.severity].append(f"{finding.where}: {finding.what}")
    return texts


def test_a_good_recording_has_no_warnings(tmp_path: Path) -> None:
    write_euroc(tmp_path / "flight", frames=30)
    texts = found(tmp_path / "flight", read_images=True)
    assert texts["error"] == texts["warning"] == []
    assert any("200.0 Hz" in text for text in texts["info"])
    assert any("specific force 9.81" in text for text in texts["info"])
    assert any("covers 100.0 %" in text for text in texts["info"])


def test_images_are_only_read_when_asked(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    next((tmp_path / "mav0" / "cam0" / "data").iterdir()).write_bytes(b"not an image")
    assert not found(tmp_path)["warning"]
    assert "image_unreadable: 1 times" in found(tmp_path, read_images=True)["warning"][0]


def test_wrong_calibration_and_units_are_found(tmp_path: Path) -> None:
    write_euroc(tmp_path, frames=30)
    edit_text(tmp_path / "mav0" / "cam0" / "sensor.yaml", "32.5", "90.0")
    edit_text(tmp_path / "mav0" / "imu0" / "sensor.yaml", "rate_hz: 200", "rate_hz: 100")
    file = tmp_path / "mav0" / "imu0" / "data.csv"
    file.write_text(file.read_text().replace(",9.8", ",0.98"))  # g instead of m/s²
    texts = found(tmp_path)
    assert any("principal point" in text for text in texts["error"])
    assert any("at rest, expected" in text for text in texts["error"])
    assert any("the calibration says 100.0 Hz" in text for text in texts["warning"])


def test_groundtruth_of_another_time_is_found(tmp_path: Path) -> None:
    write_euroc(tmp_path, frames=20)
    write_groundtruth(tmp_path / "mav0", 7, 100)
    assert any("covers 50.0 %" in text for text in found(tmp_path)["warning"])
    write_groundtruth(tmp_path / "mav0", 7, 100, start_ns=5)
    assert any("covers no frame" in text for text in found(tmp_path)["error"])


def test_checking_leaves_the_diagnostics_alone(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    edit_line(tmp_path / "mav0" / "cam0" / "data.csv", 3, None)
    sequence = open_dataset(tmp_path)
    usual = sequence.diagnostics
    assert any("camera_frame_missing" in f.what for f in check_sequence(sequence))
    assert sequence.diagnostics is usual
    assert not usual.counts


def test_demo_passes_its_checks() -> None:
    texts = found("demo")
    assert texts["error"] == texts["warning"] == []


@pytest.mark.data
def test_recordings_pass_their_checks(data_dir: Path) -> None:
    for name in (
        "euroc/MH_01_easy_17s",
        "euroc/V1_01_easy_static_2s",
        "euroc_inertial/V2_02_medium",
    ):
        assert found(data_dir / name)["error"] == []


def test_numbers_of_other_scripts_are_refused(tmp_path: Path) -> None:
    """NumPy looks them up in a table of 256 characters: a crash in one of some runs."""
    path = tmp_path / "flight.csv"
    for wrong in ("\U0010ffff", "1\U0001f6f0", "١٢"):
        path.write_text(f"1,0,0,0,1,0,0,0\n{wrong},0,0,0,1,0,0,0\n", encoding="utf-8")
        with pytest.raises(DataError, match=r"flight\.csv:2: "):
            read_groundtruth(path)
