# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Map files: what is saved is loaded, whatever happens meanwhile, and what is broken is refused."""

import json
import os
import resource
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from map_flights import World

from slam_graph.errors import DataError
from slam_graph.maps.map_file import ARRAYS, arrays_of, read_map
from slam_graph.maps.map_model import SlamMap
from slam_graph.results.map_output import export_map, load_map, save_map
from slam_graph.results.result_files import MAP_NAME


@pytest.fixture(scope="module")
def small() -> SlamMap:
    return World().map()


@pytest.fixture
def file(small: SlamMap, tmp_path: Path) -> Path:
    save_map(small, tmp_path / "a.slam")
    return tmp_path / "a.slam"


def test_what_is_saved_is_loaded(small: SlamMap, file: Path) -> None:
    loaded = load_map(file)
    before, after = arrays_of(small), arrays_of(loaded)
    for name, (dtype, _) in ARRAYS.items():
        assert after[name].dtype.str == dtype
        np.testing.assert_allclose(after[name], before[name], atol=1e-12, err_msg=name)
    np.testing.assert_array_equal(loaded.poses.translations, small.poses.translations)
    (own,), (read,) = small.recordings, loaded.recordings
    assert (read.name, read.poses) == (own.name, own.poses)
    assert read.rig.imu == own.rig.imu
    for mine, theirs in zip(own.rig.cameras, read.rig.cameras, strict=True):
        assert mine.body_T_camera.equals(theirs.body_T_camera, 1e-9)
        assert mine.camera.fx == theirs.camera.fx
    assert loaded.summary() == small.summary()


def test_folders_of_runs_are_maps_too(small: SlamMap, tmp_path: Path) -> None:
    run = tmp_path / "flight" / "latest"
    run.mkdir(parents=True)
    with pytest.raises(DataError, match="--save-map"):
        load_map(run)
    save_map(small, run / MAP_NAME)
    assert len(load_map(run)) == len(load_map(run.parent)) == len(small)
    with pytest.raises(DataError, match="no such file"):
        load_map(tmp_path / "nothing")


def test_nothing_is_replaced_unless_it_is_said(small: SlamMap, file: Path) -> None:
    before = file.read_bytes()
    with pytest.raises(DataError, match="--force"):
        save_map(World(1).map(), file)
    assert file.read_bytes() == before
    save_map(World(1).map(), file, force=True)
    assert file.read_bytes() != before
    with pytest.raises(DataError, match="folder"):
        save_map(small, file.parent, force=True)
    new = file.with_name("new")
    for ply, tum in ((file, None), (None, file), (new, file)):
        with pytest.raises(DataError, match="--force"):
            export_map(small, ply, tum)
    assert not new.exists()


def test_a_crash_while_saving_leaves_the_old_map(file: Path) -> None:
    """The process is killed (SIGKILL) when half of the arrays are written."""
    before = file.read_bytes()
    code = f"""
import os, signal
import numpy as np
from slam_graph.results.map_output import load_map, save_map
content, left = load_map({str(file)!r}), [8]
write = np.lib.format.write_array
def write_some(*arguments, **options):
    left[0] -= 1
    if left[0] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    write(*arguments, **options)
np.lib.format.write_array = write_some
save_map(content, {str(file)!r}, force=True)
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, check=False)
    assert done.returncode == -9
    assert file.read_bytes() == before
    assert len(load_map(file)) == 5
    assert len(list(file.parent.iterdir())) == 2  # what was half written has another name
    save_map(World(1).map(), file, force=True)
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_a_full_disk_is_one_line_and_leaves_the_old_map(small: SlamMap, file: Path) -> None:
    before, limits = file.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(DataError, match="cannot be written") as caught:
            save_map(small, file, force=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert file.read_bytes() == before
    assert len(list(file.parent.iterdir())) == 1


def rewritten(file: Path, change: Callable[[dict[str, bytes]], object], **options: int) -> Path:
    """The file with other members, whose checksums are right."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(file, "w", **options) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file


def header(**changes: object) -> Callable[[dict[str, bytes]], object]:
    def change(members: dict[str, bytes]) -> None:
        table = {**json.loads(members["map.json"]), **changes}
        members["map.json"] = json.dumps(table).encode()

    return change


def array(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[..., object]:
    def changed(members: dict[str, bytes]) -> None:
        values = np.load(BytesIO(members[f"{name}.npy"]), allow_pickle=False)
        members[f"{name}.npy"] = npy(change(values))

    return changed


def npy(values: np.ndarray) -> bytes:
    buffer = BytesIO()
    np.lib.format.write_array(buffer, values, (1, 0))
    return buffer.getvalue()


def put(value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values.reshape(-1)[7] = value
        return values

    return change


def longer(name: str) -> Callable[[dict[str, bytes]], object]:
    """An array whose header promises a billion rows."""

    def change(members: dict[str, bytes]) -> None:
        text = members[f"{name}.npy"]
        start = text.index(b"'shape': (") + len(b"'shape': (")
        end = text.index(b",", start)
        grown = text[:start] + b"1000000000" + text[end:]
        shift = len(grown) - len(text)
        newline = grown.index(b"\n")
        members[f"{name}.npy"] = grown[: newline - shift] + grown[newline:]

    return change


def without(name: str) -> Callable[[dict[str, bytes]], object]:
    return lambda members: members.pop(name)


def emptied(members: dict[str, bytes]) -> None:
    for name, (dtype, shape) in ARRAYS.items():
        sizes = [n if isinstance(n, int) else {"B": 32, "K+1": 1}.get(n, 0) for n in shape]
        members[f"{name}.npy"] = npy(np.zeros(sizes, dtype))


def undescribed(members: dict[str, bytes]) -> None:
    for name in ("descriptors", "feature_descriptors", "words"):
        rows = len(members[f"{name}.npy"][128:]) // 32
        members[f"{name}.npy"] = npy(np.zeros((rows, 0), np.uint8))


BROKEN = {
    "newer version": (header(version=2), "version 2.*update slam_graph"),
    "other format": (header(format="shopping list"), "not a slam_graph map"),
    "unknown key": (header(surprise=1), "surprise"),
    "no recordings": (header(recordings=[]), "recordings"),
    "no calibration": (
        header(recordings=[{"name": "a", "poses": "causal", "calibration": {}}]),
        "cam0|camera",
    ),
    "deep header": (lambda m: m.update({"map.json": b"[" * 200_000}), "map.json"),
    "no header": (without("map.json"), "no map.json"),
    "huge header": (lambda m: m.update({"map.json": b" " * 2_000_000}), "map.json"),
    "array missing": (without("points.npy"), "points.npy is missing"),
    "more rows than bytes": (longer("points"), "points.npy.*shape"),
    "pickle": (
        lambda m: m.update({"points.npy": npy(np.zeros((3, 3))).replace(b"'<f8'", b"'|O' ", 1)}),
        "points.npy",
    ),
    "header that is no Python": (
        lambda m: m.update(
            {"points.npy": npy(np.zeros((3, 3))).replace(b"'shape'", b"'shape(", 1)}
        ),
        "points.npy: damaged",
    ),
    "header of no use": (
        lambda m: m.update({"points.npy": b"\x93NUMPY\x01\x00\x07\x00{[]: 1}"}),
        "points.npy: damaged",
    ),
    "other type": (lambda m: m.update({"points.npy": npy(np.zeros((3, 3), "f4"))}), "type"),
    "other shape": (lambda m: m.update({"positions.npy": npy(np.zeros((5, 4)))}), "shape"),
    "keyframes of other number": (
        lambda m: m.update({"positions.npy": npy(np.zeros((6, 3)))}),
        "positions.npy.*shape",
    ),
    "NaN in a position": (array("positions", put(np.nan)), r"positions.npy: row 2 is not finite"),
    "NaN in an orientation": (array("quaternions", put(np.nan)), "quaternions.npy: row 1"),
    "not a rotation": (array("quaternions", put(3.0)), "unit quaternion"),
    "far away": (array("points", put(1e300)), "points.npy: row 2"),
    "feature out of range": (array("features", put(10**9)), "features.npy: row 7"),
    "time goes back": (array("stamps_ns", lambda v: v[::-1]), "stamps_ns.npy: row 1"),
    "offsets": (array("offsets", lambda v: v[::-1]), "offsets.npy"),
    "recording out of range": (array("recording_of", lambda v: v + 5), "recording_of.npy"),
    "no descriptors": (undescribed, "no descriptors"),
    "empty": (emptied, "the map is empty"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_maps_are_refused_in_one_line(file: Path, case: str) -> None:
    change, message = BROKEN[case]
    rewritten(file, change)
    with pytest.raises(DataError, match=message) as caught:
        read_map(file)
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)


def test_compressed_members_are_refused(file: Path) -> None:
    """A kilobyte of them can be a terabyte."""
    rewritten(file, lambda members: None, compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(DataError, match="compressed"):
        read_map(file)


def test_files_that_are_no_maps(tmp_path: Path) -> None:
    for content in (b"", b"PK", b"hello", os.urandom(5000), b"PK\x05\x06" + bytes(18)):
        (tmp_path / "x").write_bytes(content)
        with pytest.raises(DataError, match="not a slam_graph map"):
            read_map(tmp_path / "x")


def test_a_damaged_member_is_found_by_its_checksum(small: SlamMap, file: Path) -> None:
    content = bytearray(file.read_bytes())
    at = bytes(content).index(small.points.tobytes()[:64])
    content[at + 3] ^= 1
    file.write_bytes(content)
    with pytest.raises(DataError, match=r"CRC.*points\.npy.*another copy"):
        read_map(file)


def test_no_damage_does_more_than_raise(file: Path) -> None:
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    refused = 0
    for trial in range(300):
        content = bytearray(whole)
        if trial % 3 == 0:
            content = content[: int(rng.integers(len(whole)))]
        else:
            # the last part is the archive's table of contents, which is worth more than its size
            low = 0 if trial % 3 == 1 else len(whole) - 2000
            for at in rng.integers(low, len(whole), 3).tolist():
                content[at] = int(rng.integers(256))
        file.write_bytes(content)
        try:
            read_map(file)
        except DataError as error:
            refused += "\n" not in str(error)
    assert refused > 250


def test_exports_hold_points_and_poses(small: SlamMap, tmp_path: Path) -> None:
    export_map(small, ply=tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    header, _, body = content.partition(b"end_header\n")
    count = len(small.points) + len(small)
    assert f"element vertex {count}".encode() in header
    vertices = np.frombuffer(body, [("place", "<f8", 3), ("colour", "u1", 3)])
    np.testing.assert_array_equal(vertices["place"][: len(small.points)], small.points)
    assert export_map(small, tum=tmp_path / "a.tum") == [tmp_path / "a.tum"]
    rows = np.loadtxt(tmp_path / "a.tum")
    np.testing.assert_allclose(rows[:, 1:4], small.poses.translations, atol=1e-9)
    two = replace(
        small,
        recordings=small.recordings * 2,
        recording_of=np.array([0, 0, 0, 1, 1]),
    )
    files = export_map(two, tum=tmp_path / "b.tum")
    assert [path.name for path in files] == ["b_0.tum", "b_1.tum"]
