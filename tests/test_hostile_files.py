# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Untrusted files: names in them are never paths, and what is wrong is one line of ours."""

import bz2
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hostile import ALIASES, read_all
from recordings import edit_text, write_euroc, write_openvins
from recordings_loose import write_times, write_video
from recordings_public import write_kitti_odometry, write_tum_rgbd
from typer.testing import CliRunner

from slam_graph.bundle_adjustment.bal_file import read_bal
from slam_graph.cli.main import app
from slam_graph.config import load_config
from slam_graph.datasets import open_dataset
from slam_graph.datasets.calibration.calibration_yaml import read_yaml
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, write_kalibr
from slam_graph.datasets.formats import track_recording as layout
from slam_graph.datasets.formats import video
from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.datasets.streams.aiding_files import read_fixes
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError, SlamGraphError
from slam_graph.pose_graph.graph import InformationRepair
from slam_graph.pose_graph.graph_files import read_pose_graph
from slam_graph.results.result_files import ResultFolder, folder_name
from slam_graph.settings.bounded_yaml import YamlTextError, parse_value
from slam_graph.simulation.simulator import simulate

BAD_YAML = {
    "date": ("a: 1\nseed: 2001-13-41\n", ":2: .*'2001-13-41' is not of type timestamp"),
    "integer": ("seed: !!int abc\n", ":1: .*'abc' is not of type int"),
    "bool": ("seed: !!bool maybe\n", ":1: .*'maybe' is not of type bool"),
    "digits": (f"seed: {'7' * 5000}\n", ":1: .*is not of type int"),
    "hex": (f"seed: 0x{'f' * 9000}\n", ":1: .*is not of type int"),
    "deep": ("a: " + "[" * 3000 + "]" * 3000, ":1: .*nested deeper than 64 levels"),
    "recursive": ("a: &x [1, *x]\n", ":1: .*'x' contains itself"),
    "bomb": (ALIASES, ":4: .*aliases repeat more than 10000 values"),
    "merge bomb": ("a: &a {x: 1}\n" + "b: {<<: [" + "*a," * 11000 + "]}", ":2: .*aliases repeat"),
    "unknown alias": ("a: *b\n", ":1: .*undefined alias"),
    "tag": ("a: !!python/object/apply:os.system [ls]\n", ":1: .*could not determine"),
    "escape": ('seed: "\\UFFFFFFFF"\n', ": .*"),
    "key": ("? [1, 2]\n: 3\n", ":1: .*unhashable key"),
}


@pytest.mark.parametrize("name", BAD_YAML)
def test_a_configuration_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    text, expected = BAD_YAML[name]
    path = tmp_path / "my.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=rf"my\.yaml{expected}") as caught:
        load_config(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("name", ["deep", "recursive", "bomb"])
def test_a_calibration_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    text, expected = BAD_YAML[name]
    path = tmp_path / "my.yaml"
    path.write_text(text)
    with pytest.raises(DataError, match=rf"my\.yaml{expected.split(' ')[0]}"):
        read_yaml(path)


def test_what_a_file_says_is_quoted_in_part(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    write_kalibr(simulate(duration_s=1.0).rig, path)
    whole = path.read_text()
    path.write_text(whole.replace("pinhole", "1" * 5000, 1))
    with pytest.raises(DataError, match="unknown camera model '1111") as caught:
        read_kalibr(path)
    assert len(str(caught.value)) < 2000
    row = next(
        line for line in whole.splitlines() if line.lstrip().startswith("- [") and "," in line
    )
    first = row.split("[")[1].split(",")[0]
    for value in ("1e200", "-1e308"):
        path.write_text(whole.replace(row, row.replace(first, value, 1), 1))
        with pytest.raises(DataError, match="is not a rotation"):
            read_kalibr(path)


def test_an_override_is_bounded_like_a_file() -> None:
    for text in ("seed=2001-13-41", "seed=" + "[" * 500, ".".join("a" * 3000) + "=1"):
        with pytest.raises(ConfigError):
            load_config(overrides=[text])


@pytest.mark.parametrize("value", [".inf", ".nan", "1e400"])
def test_settings_are_finite(value: str) -> None:
    for key in ("duration_s", "start_s", "backend.noise.pixel_sigma", "seed"):
        with pytest.raises(ConfigError, match=key):
            load_config(overrides=[f"{key}={value}"])


def test_aliases_are_read_within_the_bounds() -> None:
    value, _ = parse_value("a: &x {p: [1, 2]}\nb: *x\nc: {<<: *x, q: 3}\nd: &y 5\ne: *y\n")
    both = {"p": [1, 2]}
    assert value == {"a": both, "b": both, "c": both | {"q": 3}, "d": 5, "e": 5}
    with pytest.raises(YamlTextError, match="duplicate anchor 'x'"):
        parse_value("a: &x 5\nb: &x [*x]\n")


def test_the_name_of_an_algorithm_is_the_name_of_a_file(tmp_path: Path) -> None:
    for name in ("../../x", "/etc/x", "a/b", "", "..", "a" * 200):
        with pytest.raises(ConfigError, match="name"):
            load_config(overrides={"algorithm.name": name})


@pytest.mark.parametrize(
    "name", ["../../x", "/x/y", "..", ".", "", "a\0b", "a\nb", "é" * 400, "\ud800", "..\\x"]
)
def test_results_stay_in_their_folder(tmp_path: Path, name: str) -> None:
    root = tmp_path / "results"
    with ResultFolder.of_run(root, name) as made:
        made.text("a.txt", ["a\n"])
    assert made.folder.resolve().parent.parent == root.resolve()
    assert [path.name for path in tmp_path.iterdir()] == ["results"]


def test_names_of_folders_differ_where_names_do() -> None:
    assert folder_name("MH_01_easy + é") == "MH_01_easy + é"
    assert folder_name("x" * 300 + "1") != folder_name("x" * 300 + "2")


@pytest.mark.parametrize("name", ["../../imu0/data.csv", "/dev/zero", "a\0.png", "x" * 300])
def test_images_outside_of_a_recording_are_refused(tmp_path: Path, name: str) -> None:
    mav0 = write_euroc(tmp_path / "flight", frames=3) / "mav0"
    index = mav0 / "cam0" / "data.csv"
    lines = index.read_text().splitlines()
    lines[2] = f"{lines[2].split(',')[0]},{name}"
    index.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match=r"data\.csv:3: .* is not a file in"):
        open_dataset(mav0.parent)


@pytest.mark.parametrize("stamp", ["1e30", "1e9999999", "-1e400", "nan", "inf"])
def test_stamps_that_are_no_times_are_refused(tmp_path: Path, stamp: str) -> None:
    path = tmp_path / "truth.txt"
    path.write_text(f"1.5 0 0 0 0 0 0 1\n{stamp} 0 0 0 0 0 0 1\n")
    with pytest.raises(DataError, match=r"truth\.txt:2: .* is not a time in seconds"):
        read_groundtruth(path)


# --- recordings of tracks -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tracks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tracks") / "flight"
    simulate(duration_s=1.0, rate_hz=4.0).save(path)
    return path


def edit_counts(folder: Path, change: Callable[[np.ndarray], None]) -> None:
    rows = np.fromfile(folder / layout.FRAMES, layout.frame_record(2))
    change(rows)
    rows.tofile(folder / layout.FRAMES)


def set_meta(folder: Path, key: str, value: str) -> None:
    file = folder / layout.META
    lines = [line for line in file.read_text().splitlines() if not line.startswith(f"{key}:")]
    file.write_text("\n".join([*lines, f"{key}: {value}"]) + "\n")


def set_array(folder: Path, file: str, name: str, value: object) -> None:
    with np.load(folder / file) as content:
        arrays = dict(content)
    np.savez(folder / file, **arrays | {name: np.asarray(value)})


FAULTS: dict[str, Callable[[Path], None]] = {
    "more features": lambda f: edit_counts(f, lambda rows: rows["counts"].__iadd__(1)),
    "10^12 features": lambda f: edit_counts(f, lambda rows: rows["counts"].fill(10**12)),
    "largest counts": lambda f: edit_counts(f, lambda rows: rows["counts"].fill(2**63 - 1)),
    "negative counts": lambda f: edit_counts(f, lambda rows: rows["counts"].fill(-5)),
    "times": lambda f: edit_counts(f, lambda rows: rows["stamp"].fill(7)),
    "10^12 cameras": lambda f: set_meta(f, "cameras", "1000000000000"),
    "no cameras": lambda f: set_meta(f, "cameras", "0"),
    "10^300 frames": lambda f: set_meta(f, "frames", "1e300"),
    "half a frame": lambda f: set_meta(f, "frames", "0.5"),
    "deep": lambda f: set_meta(f, "name", "[" * 3000),
    "positions": lambda f: set_array(f, layout.GROUNDTRUTH, "positions", np.zeros((2, 2))),
    "text": lambda f: set_array(f, layout.GROUNDTRUTH, "stamps_ns", ["a", "b"]),
    "no rotation": lambda f: set_array(f, layout.INITIAL_STATE, "world_T_body", np.ones((4, 4))),
    "velocity": lambda f: set_array(f, layout.INITIAL_STATE, "velocity", [np.nan, 0.0, 0.0]),
    "covariance": lambda f: set_array(f, layout.INITIAL_STATE, "covariance", -np.eye(15)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_recording_that_does_not_add_up_is_refused(
    tracks: Path, tmp_path: Path, fault: str
) -> None:
    folder = shutil.copytree(tracks, tmp_path / "flight")
    FAULTS[fault](folder)
    with pytest.raises(DataError, match="flight"):
        read_all(folder)


def test_arrays_that_unpack_to_more_than_their_file_are_refused(
    tracks: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(tracks, tmp_path / "flight")
    np.savez_compressed(folder / layout.GROUNDTRUTH, stamps_ns=np.zeros(10**6, np.int64))
    with pytest.raises(DataError, match="larger than the file"):
        read_all(folder)


def test_a_name_in_a_recording_names_nothing(tracks: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(tracks, tmp_path / "flight")
    for name in ("../../x", "/x", '"a\\0b"'):
        set_meta(folder, "name", name)
        assert open_dataset(folder).info().name == "flight"


# --- pose graphs ----------------------------------------------------------------------------------

INDEFINITE = "10 0 0 0 20 0 10 0 0 0 0 10 0 0 0 5 0 0 5 0 5"
"""Upper triangle of an information of x, y, z and angles; x and the angle of y belong together."""


def write_indefinite(path: Path) -> Path:
    pose = "0.1 0 0 0 0 0 1"
    edges = "".join(f"EDGE_SE3:QUAT {k} {k + 1} {pose} {INDEFINITE}\n" for k in range(3))
    path.write_text(f"{edges}EDGE_SE3:QUAT 0 3 {pose} 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n")
    return path


def test_indefinite_information_is_refused_with_a_count(tmp_path: Path) -> None:
    path = write_indefinite(tmp_path / "graph.g2o")
    with pytest.raises(DataError, match=r"graph\.g2o:\d: .*nor are those of 2 other edges"):
        read_pose_graph(path)


def test_indefinite_information_is_repaired_and_counted(tmp_path: Path) -> None:
    path = write_indefinite(tmp_path / "graph.g2o")
    made = {}
    for repair in get_args(InformationRepair):
        diagnostics = Diagnostics()
        graph = read_pose_graph(path, diagnostics, repair=repair)
        assert diagnostics.counts["pose_graph_information_repaired"] == 3
        assert np.linalg.eigvalsh(graph.information)[:, 0].min() > 0
        np.testing.assert_array_equal(graph.information[3], np.eye(6))
        made[repair] = graph.information[0]
    np.testing.assert_allclose(made["isotropic"], np.diag([10.0] * 3 + [5.0] * 3))
    values = np.linalg.eigvalsh(made["nearest"])
    np.testing.assert_allclose(values[0], 1e-6 * values[-1], rtol=1e-6)
    both = ["--information", "quaternion", "--information", "nearest", "--output", str(tmp_path)]
    assert CliRunner().invoke(app, ["optimize", str(path), *both]).exit_code == 0
    clash = CliRunner().invoke(app, ["optimize", str(path), *both, "--information", "isotropic"])
    assert isinstance(clash.exception, ConfigError)
    with pytest.raises(ConfigError, match="unknown repair"):
        read_pose_graph(path, repair="any")  # type: ignore[arg-type]


def test_poses_that_are_none_are_dropped(tmp_path: Path) -> None:
    """Ground truth with quaternions of no length, or of 1e200, and without rotations."""
    folder = write_openvins(tmp_path / "flight")
    edit_text(folder / "groundtruth.csv", "0,0,0.6,0.8", "0,0,0,1e200")
    truth = open_dataset(folder).groundtruth()
    assert truth is not None
    assert len(truth) == 1
    edit_text(folder / "init_state.csv", "0,0,0.6,0.8", "0,0,0,0")
    with pytest.raises(DataError, match="no usable state"):
        open_dataset(folder).initial_state()
    drive = write_kitti_odometry(tmp_path / "kitti", frames=4)
    poses = tmp_path / "kitti" / "poses" / "03.txt"
    rows = poses.read_text().splitlines()
    rows[1] = "1e200 " + rows[1].partition(" ")[2]
    rows[2] = rows[2].replace(rows[2].split()[3], "nan")
    poses.write_text("\n".join(rows))
    sequence = open_dataset(drive)
    truth = sequence.groundtruth()
    assert truth is not None
    assert len(truth) == 2
    assert sequence.diagnostics.counts["groundtruth_not_finite"] == 2


@pytest.mark.parametrize("datum", ["48, 11, -inf", "91, 11, 500", "nan, 11, 500", "48, 11"])
def test_a_datum_that_is_not_on_the_earth_is_refused(tmp_path: Path, datum: str) -> None:
    row = "1403636579763555584,48.1,11.5,520,1,1,2"
    (tmp_path / "gnss.csv").write_text(f"#timestamp,latitude,longitude\n# datum: {datum}\n{row}\n")
    with pytest.raises(DataError, match=r"gnss\.csv:2: expected '# datum:"):
        read_fixes(tmp_path / "gnss.csv", Diagnostics())


def test_a_compressed_problem_unpacks_within_a_bound(tmp_path: Path) -> None:
    path = tmp_path / "problem.txt.bz2"
    path.write_bytes(bz2.compress(b"1 1 1\n" + b" " * 10**7))
    with pytest.raises(DataError, match="unpacks to more than 50 times"):
        read_bal(path)


@pytest.mark.parametrize(("claimed", "most"), [(900_000_000, None), (1000, 100)])
def test_a_video_that_claims_too_many_frames_is_counted(
    claimed: int, most: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than it has bytes, or more than any video has."""
    path = write_video(tmp_path, "flight.avi", "MJPG")
    if most is not None:
        assert path.stat().st_size > claimed
        monkeypatch.setattr(video, "_MOST_FRAMES", most)
    write_times(path.with_suffix(".csv"))
    content = bytearray(path.read_bytes())
    for header, field in ((b"avih", 16), (b"strh", 32)):
        at = content.find(header) + 8 + field
        content[at : at + 4] = claimed.to_bytes(4, "little")
    path.write_bytes(content)
    assert open_dataset(path).info().frames == 8


def test_a_sigma_that_is_no_number_is_refused(tmp_path: Path) -> None:
    folder = write_openvins(tmp_path / "flight", frames=4, features=5)
    start = folder / "init_state.csv"
    text = start.read_text()
    assert "bg 0.03," in text
    for written in (".03", "3e-2", "+0.03", "0.03."):
        start.write_text(text.replace("bg 0.03,", f"bg {written},"))
        state = open_dataset(folder).initial_state()
        assert state is not None
        assert state.covariance is not None
        np.testing.assert_allclose(np.diag(state.covariance)[12:], 0.03**2)
    for damaged in ("1.2.3", "0.03.e2", "0.0x3", "-0.03", "0", "1e200", "1e-200"):
        start.write_text(text.replace("bg 0.03,", f"bg {damaged},"))
        with pytest.raises(
            DataError, match=r"init_state\.csv: prior sigma of bg: .* is no positive"
        ):
            open_dataset(folder).initial_state()


# --- names of other files -------------------------------------------------------------------------


def test_no_image_of_another_folder_is_read(tmp_path: Path) -> None:
    """TUM's lists and KITTI's folders too: a link or a name that leads out is not followed."""
    folder = write_tum_rgbd(tmp_path / "rgbd_freiburg1")
    index = folder / "rgb.txt"
    lines = index.read_text().splitlines()
    for name in ("../secret.png", "/etc/hostname", "rgb/../../secret.png", "a" * 300):
        changed = [*lines[:-1], f"{lines[-1].split()[0]} {name}"]
        index.write_text("\n".join(changed) + "\n")
        with pytest.raises(DataError, match=r"rgb\.txt:\d+: .* is not a file in"):
            read_all(folder)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    for name in ("my.yaml", "truth.txt", "graph.g2o", "problem.txt"):
        path = tmp_path / name
        path.write_bytes(b"\xff\xfe\x00\xc3\x28\n" * 3)
        for read in (load_config, read_groundtruth, read_pose_graph, read_bal, open_dataset):
            with pytest.raises(SlamGraphError) as caught:
                read(path)
            assert "\n" not in str(caught.value)


def test_what_files_say_does_not_steer_a_terminal() -> None:
    """An error is one line of printable characters, whatever name or value it quotes."""
    said = str(DataError("topic '/a\0\x1b[2Jb' of \udc80\nanother line, in µm"))
    assert said == r"topic '/a\x00\x1b[2Jb' of \udc80 another line, in µm"


@pytest.mark.parametrize(
    ("header", "local"),
    [
        ("#timestamp [ns],latitude [deg],longitude [deg],altitude [m],e,n,u", False),
        ("timestamp,latitude,longitude,altitude,sigma_east,sigma_north,sigma_up", False),
        ("#timestamp [ns], east [m], north [m], up [m], e, n, u", True),
        ("#timestamp,lat,lon,alt,sx,sy,sz", None),
        ("# my receiver", None),
        ("#timestamp [ns],latitude [rad],longitude [rad],altitude [m],e,n,u", None),
        ("#timestamp [ns],north [m],east [m],up [m],e,n,u", None),
        ("", None),
    ],
)
def test_fixes_say_whether_they_are_degrees_or_metres(
    tmp_path: Path, header: str, local: bool | None
) -> None:
    path = tmp_path / "gnss.csv"
    path.write_text(f"{header}\n1000,48.1,11.5,520,1,1,2\n")
    if local is None:
        with pytest.raises(DataError, match=r"gnss\.csv: nothing says .* begin it with"):
            read_fixes(path, Diagnostics())
        return
    found = read_fixes(path, Diagnostics()).fix_positions[0]
    np.testing.assert_allclose(found, [48.1, 11.5, 520.0] if local else np.zeros(3), atol=1e-9)
