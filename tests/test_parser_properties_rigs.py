# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of the readers of calibrations, settings, recordings, maps and bags.

As `test_parser_properties`: what is written is read again, and anything is judged.
"""

import json
import logging
import shutil
import struct
from collections.abc import Callable
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from map_flights import World
from properties import (
    ANYTHING,
    NAMES,
    dressed,
    examples,
    finite,
    parsed,
    poses,
    stamps,
    trajectories,
    vectors,
)
from recordings import SIZE
from recordings_ros import bag_writer, write_calibration

from slam_graph.config import RunConfig, load_config
from slam_graph.datasets import TrackRecorder, open_dataset
from slam_graph.datasets.calibration.calibration_yaml import MAX_OFFSET_S
from slam_graph.datasets.calibration.euroc_calibration import MAX_READOUT_S, read_euroc_rig
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, write_kalibr
from slam_graph.datasets.formats.euroc_writer import EurocWriter
from slam_graph.geometry import NavState
from slam_graph.maps import map_file
from slam_graph.maps.map_file import arrays_of, read_map, write_map
from slam_graph.maps.map_model import PoseSource, SlamMap
from slam_graph.sensors import (
    CAMERA_MODELS,
    Camera,
    CameraFrame,
    FeatureFrame,
    FeatureObservations,
    ImuData,
    ImuNoise,
    Rig,
    RigCamera,
)
from slam_graph.simulation.simulator import simulate

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """What is dropped and counted is not written down for each of the many files."""
    caplog.set_level(logging.CRITICAL, logger="slam_graph")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all examples are written, one over the other."""
    return tmp_path_factory.mktemp("properties")


# --- calibrations ---------------------------------------------------------------------------------


@st.composite
def cameras(draw: st.DrawFn, size: tuple[int, int] | None = None) -> Camera:
    """Cameras of all models, with images of any size or of a given one."""
    model = CAMERA_MODELS[
        draw(st.sampled_from(["none", "radtan", "equidistant", "mei", "double_sphere"]))
    ]()
    ranges = [model.ranges.get(name, (-1e6, 1e6)) for name in model.coefficient_names]
    bounds = [(max(low, -1e6), min(high, 1e6)) for low, high in ranges]
    coefficients = tuple(draw(st.floats(*pair)) for pair in bounds)
    focal, centre = st.floats(1e-3, 1e6), finite(1e6)
    width, height = size or (draw(st.integers(1, 20000)), draw(st.integers(1, 20000)))
    values = (draw(focal), draw(focal), draw(centre), draw(centre))
    return Camera(*values, model.name, coefficients, width, height)


@st.composite
def rigs(draw: st.DrawFn, most: int = 3, size: tuple[int, int] | None = None) -> Rig:
    """Rigs of one to a few cameras, some with a rolling shutter."""
    mounted = []
    for k in range(draw(st.integers(1, most))):
        one = RigCamera(
            draw(cameras(size)),
            draw(poses()),
            draw(finite(MAX_OFFSET_S)),
            draw(NAMES),
            rotation_known=k > 0 or draw(st.booleans()),
        )
        if draw(st.booleans()):
            readout, row = (
                draw(finite(MAX_READOUT_S)),
                draw(st.sampled_from(["first", "middle", "last"])),
            )
            one = replace(
                one,
                rolling_shutter=True,
                readout_s=readout,
                stamped_row=row if readout else "first",
            )
        mounted.append(one)
    density = st.floats(1e-12, 1e6)
    noise = ImuNoise(*(draw(density) for _ in range(5)))
    return Rig(tuple(mounted), noise)


def same_rig(found: Rig, written: Rig, of_kalibr: bool) -> None:
    """The numbers to the bit, mountings to the rounding of their inverses."""
    assert len(found.cameras) == len(written.cameras)
    assert found.imu == written.imu
    for k, (mine, its) in enumerate(zip(found.cameras, written.cameras, strict=True)):
        assert mine.camera == its.camera
        assert mine.time_offset_s == its.time_offset_s
        for name in ("rolling_shutter", "readout_s", "stamped_row"):
            assert getattr(mine, name) == getattr(its, name)
        assert mine.name == (its.name if of_kalibr else f"cam{k}")
        if of_kalibr:
            assert mine.rotation_known == its.rotation_known
        if its.rotation_known or not of_kalibr:
            wanted, size = (
                its.body_T_camera.matrix(),
                1.0 + np.abs(its.body_T_camera.matrix()).max(),
            )
            np.testing.assert_allclose(mine.body_T_camera.matrix(), wanted, atol=1e-12 * size)


@examples(50)
@given(st.data())
def test_kalibr(folder: Path, data: st.DataObject) -> None:
    rig, path = data.draw(rigs()), folder / "camchain.yaml"
    write_kalibr(rig, path)
    path.write_bytes(data.draw(dressed(path.read_text(encoding="utf-8"), blanks=" ")))
    same_rig(read_kalibr(path), rig, of_kalibr=True)


@examples(15)
@given(data=st.data())
def test_euroc_folders(folder: Path, data: st.DataObject) -> None:
    """Calibration, samples, true trajectory and images are those that were written."""
    rig, truth = data.draw(rigs(2, (4, 3))), data.draw(trajectories())
    times = data.draw(frame_stamps())
    imu = data.draw(samples(times))
    shape = (len(times), len(rig.cameras), 3, 4)
    values = np.random.default_rng(data.draw(st.integers(0, 2**32))).integers(
        0, 256, shape, np.uint8
    )
    root = folder / "flight"
    shutil.rmtree(root, ignore_errors=True)
    with EurocWriter(root, rig, truth, data.draw(NAMES), 20.0) as writer:
        writer.write_imu(imu)
        for stamp_ns, images in zip(times.tolist(), values, strict=True):
            writer.write_frame(CameraFrame(stamp_ns, tuple(images)))
    for file in root.rglob("*.csv"):
        file.write_bytes(data.draw(dressed(file.read_text())))
    sequence = open_dataset(root, imu=True)
    same_rig(sequence.rig, rig, of_kalibr=False)
    same_rig(read_kalibr(root / "calibration.yaml"), rig, of_kalibr=True)
    same_samples(sequence.imu(), imu)
    found = sequence.groundtruth()
    assert found is not None
    np.testing.assert_array_equal(found.stamps_ns, truth.stamps_ns)
    np.testing.assert_array_equal(found.positions, truth.positions)
    np.testing.assert_allclose(found.quaternions, truth.quaternions, rtol=1e-14, atol=1e-15)
    frames = list(sequence.frames())
    assert [frame.stamp_ns for frame in frames] == times.tolist()
    for frame, images in zip(frames, values, strict=True):
        assert isinstance(frame, CameraFrame)
        for mine, its in zip(frame.images, images, strict=True):
            np.testing.assert_array_equal(mine, its)


def check_rig(rig: Rig) -> None:
    """Values that a run can take: finite, with images of some size."""
    for mounted in rig.cameras:
        camera = mounted.camera
        assert np.isfinite([*camera.intrinsics, *camera.coefficients]).all()
        assert 0 < camera.width < 2**16
        assert 0 < camera.height < 2**16
        assert np.isfinite(mounted.body_T_camera.matrix()).all()
        assert abs(mounted.time_offset_s) <= MAX_OFFSET_S
    *densities, rate_hz = astuple(rig.imu)
    assert all(0.0 < value**2 < np.inf for value in (rate_hz, *densities))


YAML_VALUES = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(2**70), 2**70),
        st.floats(),
        st.dates(),
        st.text(max_size=8),
        st.sampled_from(["pinhole", "radtan", "unknown", "none", "omni", "1e-3", "nan", "~"]),
    ),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=6,
)
"""What a key of a YAML file may be given."""


NUMBERS = st.one_of(
    st.floats(),
    st.integers(-(2**70), 2**70),
    st.integers(-1, 1),
    st.sampled_from([1e9, 0.5, 1e-300]),
)


@st.composite
def altered(draw: st.DrawFn, table: dict[str, Any]) -> str:
    """YAML with one to three of its values, at any depth, replaced by others, or removed."""
    table = json.loads(json.dumps(table))
    for _ in range(draw(st.integers(1, 3))):
        inside: Any = table
        while True:
            keys = list(inside) if isinstance(inside, dict) else list(range(len(inside)))
            if not keys:
                break
            key = draw(st.sampled_from(keys))
            deeper = isinstance(inside[key], dict | list)
            if deeper and draw(st.integers(0, 4)):
                inside = inside[key]
                continue
            if draw(st.integers(0, 5)) == 0:
                del inside[key]
            elif isinstance(inside[key], float | int):
                inside[key] = draw(NUMBERS | YAML_VALUES)
            else:
                inside[key] = draw(YAML_VALUES)
            break
    return yaml.safe_dump(table, allow_unicode=draw(st.booleans()))


CAMERA_TABLE = {
    "T_cam_imu": np.eye(4).tolist(),
    "camera_model": "pinhole",
    "intrinsics": [50.0, 51.0, 32.5, 23.5],
    "distortion_model": "radtan",
    "distortion_coeffs": [-0.28, 0.07, 2e-4, 1.7e-05],
    "resolution": [64, 48],
    "timeshift_cam_imu": 0.01,
    "line_delay": 1e-5,
}
IMU_TABLE = {
    "gyroscope_noise_density": 1e-4,
    "gyroscope_random_walk": 1e-5,
    "accelerometer_noise_density": 1e-3,
    "accelerometer_random_walk": 1e-4,
    "update_rate": 200.0,
}


@examples(150)
@given(altered({"cam0": CAMERA_TABLE, "imu0": IMU_TABLE}))
def test_chains_with_other_values(folder: Path, text: str) -> None:
    path = folder / "altered.yaml"
    path.write_text(text, encoding="utf-8")
    rig = parsed(read_kalibr, path)
    if rig is not None:
        check_rig(rig)


@examples(150)
@given(altered({"T_BS": np.eye(4).ravel().tolist(), **CAMERA_TABLE, "rate_hz": 20}))
def test_sensors_with_other_values(folder: Path, text: str) -> None:
    sensor = folder / "mav0" / "cam0" / "sensor.yaml"
    sensor.parent.mkdir(parents=True, exist_ok=True)
    sensor.write_text(text, encoding="utf-8")
    rig = parsed(read_euroc_rig, folder / "mav0", ["cam0"])
    if rig is not None:
        check_rig(rig)


# --- settings -------------------------------------------------------------------------------------


def leaves(table: dict[str, Any], above: str = "") -> dict[str, Any]:
    """The values of settings by their dotted keys."""
    found: dict[str, Any] = {}
    for key, value in table.items():
        found |= (
            leaves(value, f"{above}{key}.") if isinstance(value, dict) else {above + key: value}
        )
    return found


DEFAULTS = leaves(RunConfig().model_dump(mode="json"))


@st.composite
def settings_like(draw: st.DrawFn) -> dict[str, Any]:
    """One to three settings with values near their defaults, or with any."""
    found = {}
    for key in draw(
        st.lists(st.sampled_from(sorted(DEFAULTS)), min_size=1, max_size=3, unique=True)
    ):
        default = DEFAULTS[key]
        near: st.SearchStrategy[Any] = YAML_VALUES
        if isinstance(default, bool):
            near = st.booleans()
        elif isinstance(default, int):
            near = st.integers(0, 2 * default + 2)
        elif isinstance(default, float):
            near = st.floats(0.0, 2.0 * abs(default) + 1.0)
        found[key] = draw(near | near | YAML_VALUES)
    return found


@examples(100)
@given(st.data())
def test_settings(folder: Path, data: st.DataObject) -> None:
    """What is accepted is written so that it is read again; the rest is refused in one line."""
    config = parsed(load_config, None, data.draw(settings_like()))
    if config is None:
        return
    path = folder / "config.yaml"
    path.write_bytes(data.draw(dressed(config.as_yaml(), blanks=" ")))
    assert load_config(path) == config
    for value in leaves(config.model_dump(mode="json")).values():
        assert not isinstance(value, float) or np.isfinite(value)


@examples(60)
@given(st.text(max_size=30), st.text(max_size=30))
def test_overrides(key: str, value: str) -> None:
    parsed(load_config, None, [f"{key}={value}"])
    parsed(load_config, None, [f"backend.noise.pixel_sigma={value}"])


# --- recordings of tracks -------------------------------------------------------------------------


def frame_stamps(least: int = 10**9, end: int = 2**62 - 10**9) -> st.SearchStrategy[np.ndarray]:
    """Times of one to four frames, 50 ms to some seconds apart."""

    def spread(first: int, steps: list[int]) -> np.ndarray:
        return first + np.cumsum([0, *steps])

    steps = st.lists(st.integers(50 * 10**6, 10**9), max_size=3)
    return st.builds(spread, st.integers(least, end - 5 * 10**9), steps)


@st.composite
def samples(draw: st.DrawFn, frames: np.ndarray) -> ImuData:
    """Some samples from before the first frame to after the last, none of which looks wrong."""
    inside = st.integers(int(frames[0]) - 10**8, int(frames[-1]) + 10**8)
    times = np.array(sorted(draw(st.lists(inside, min_size=2, max_size=6, unique=True))), np.int64)
    gyro = np.array([draw(vectors(3, 1.0)) for _ in times])
    accel = np.array([draw(vectors(3, 10.0)) for _ in times])
    return ImuData(times, gyro, accel)


def same_samples(found: ImuData, written: ImuData) -> None:
    np.testing.assert_array_equal(found.stamps_ns, written.stamps_ns)
    np.testing.assert_array_equal(found.gyro, written.gyro)
    np.testing.assert_array_equal(found.accel, written.accel)


@st.composite
def observations(draw: st.DrawFn, width: int) -> FeatureObservations:
    """None to four features, with descriptors of so many bytes."""
    ids = draw(st.lists(st.integers(-(2**63), 2**63 - 1), max_size=4, unique=True))
    pixels = np.array([draw(vectors(2)) for _ in ids]).reshape(-1, 2)
    normalized = np.array([draw(vectors(2)) for _ in ids]).reshape(-1, 2)
    rows = [list(draw(st.binary(min_size=width, max_size=width))) for _ in ids]
    descriptors = np.array(rows, np.uint8).reshape(len(ids), width) if width else None
    return FeatureObservations(np.array(ids, np.int64), pixels, normalized, descriptors=descriptors)


@examples(25)
@given(data=st.data(), name=NAMES, width=st.sampled_from([0, 1, 32]))
def test_recordings(folder: Path, data: st.DataObject, name: str, width: int) -> None:
    rig, truth = data.draw(rigs(2)), data.draw(trajectories())
    times = data.draw(st.one_of(stamps(1, 4), frame_stamps()))
    packets = [
        FeatureFrame(
            int(stamp_ns),
            tuple(data.draw(observations(0 if k else width)) for k in range(len(rig.cameras))),
        )
        for stamp_ns in times
    ]
    imu = data.draw(samples(data.draw(frame_stamps())))
    start = NavState(
        data.draw(st.integers(0, 2**62 - 1)),
        data.draw(poses()),
        np.array(data.draw(vectors(3))),
        accel_bias=np.array(data.draw(vectors(3))),
        gyro_bias=np.array(data.draw(vectors(3))),
    )
    root = folder / "tracks"
    shutil.rmtree(root, ignore_errors=True)
    with TrackRecorder(root, rig, name, truth, start) as recorder:
        for k, frame in enumerate(packets):
            recorder.write(ImuData.empty() if k else imu, frame)
    sequence = open_dataset(root)
    same_rig(sequence.rig, rig, of_kalibr=True)
    same_samples(sequence.imu(), imu)
    found = sequence.groundtruth()
    assert found is not None
    for field in ("stamps_ns", "positions", "quaternions"):
        np.testing.assert_array_equal(getattr(found, field), getattr(truth, field))
    state = sequence.initial_state()
    assert state is not None
    assert state.stamp_ns == start.stamp_ns
    np.testing.assert_array_equal(state.world_T_body.matrix(), start.world_T_body.matrix())
    for mine, its in zip(sequence.frames(), packets, strict=True):
        assert isinstance(mine, FeatureFrame)
        assert mine.stamp_ns == its.stamp_ns
        for one, other in zip(mine.cameras, its.cameras, strict=True):
            for field in ("ids", "pixels", "normalized"):
                np.testing.assert_array_equal(getattr(one, field), getattr(other, field))
            if other.descriptors is not None and len(other):
                np.testing.assert_array_equal(one.descriptors, other.descriptors)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of three frames, ten features and five samples."""
    root = tmp_path_factory.mktemp("tracks") / "flight"
    simulate(duration_s=0.6, rate_hz=5.0, cameras=1, tracks={"features": 5}).save(root)
    return root


def check_recording(path: Path) -> None:
    sequence = open_dataset(path)
    last_ns = None
    for packet in sequence.packets():
        frame, times = packet.frame, packet.imu.stamps_ns
        assert isinstance(frame, FeatureFrame)
        assert last_ns is None or frame.stamp_ns > last_ns
        last_ns = frame.stamp_ns
        assert (times[1:] > times[:-1]).all()
        assert np.isfinite([packet.imu.gyro, packet.imu.accel]).all()
        for seen in frame.cameras:
            assert np.isfinite([seen.pixels, seen.normalized]).all()


@pytest.mark.parametrize("name", ["frames.bin", "features.bin", "imu.bin"])
@examples(25)
@given(data=st.data())
def test_recordings_of_other_numbers(flight: Path, name: str, data: st.DataObject) -> None:
    """Files of the right length, with some rows or all of any eight bytes."""
    file = flight / name
    whole = file.read_bytes()
    words = [whole[k : k + 8] for k in range(0, len(whole), 8)]
    number = st.one_of(
        st.floats().map(lambda value: struct.pack("<d", value)),
        st.integers(-(2**63), 2**63 - 1).map(lambda value: struct.pack("<q", value)),
        st.integers(-3, 20).map(lambda value: struct.pack("<q", value)),
    )
    places = st.integers(0, len(words) - 1)
    for place in data.draw(st.lists(places, min_size=1, max_size=8)):
        words[place] = data.draw(number)
    try:
        file.write_bytes(b"".join(words))
        parsed(check_recording, flight)
    finally:
        file.write_bytes(whole)


# --- maps -----------------------------------------------------------------------------------------

WALL = World().map(range(3))


@st.composite
def maps(draw: st.DrawFn) -> SlamMap:
    """A map with other names, times, poses, points and observations."""
    count, rng = len(WALL), np.random.default_rng(draw(st.integers(0, 2**32)))
    recording = replace(
        WALL.recordings[0],
        name=draw(NAMES),
        poses=draw(st.sampled_from(get_args(PoseSource))),
        rig=draw(rigs(2)),
    )
    scale = draw(st.floats(1e-12, 1e8))
    return replace(
        WALL,
        recordings=(recording,),
        created=draw(NAMES),
        version=draw(NAMES),
        gravity_aligned=draw(st.booleans()),
        stamps_ns=draw(stamps(count, count, -(2**63), 2**63)),
        points=scale * rng.uniform(-1.0, 1.0, WALL.points.shape),
        descriptors=rng.integers(0, 256, WALL.descriptors.shape, np.uint8),
        normalized=rng.uniform(-1e4, 1e4, WALL.normalized.shape),
    )


@examples(25)
@given(content=maps())
def test_maps(folder: Path, content: SlamMap) -> None:
    path = folder / "a.slam"
    write_map(path, content)
    found = read_map(path)
    for name in ("created", "version", "gravity_aligned"):
        assert getattr(found, name) == getattr(content, name)
    mine, its = found.recordings[0], content.recordings[0]
    assert (mine.name, mine.poses) == (its.name, its.poses)
    same_rig(mine.rig, its.rig, of_kalibr=True)
    wanted = arrays_of(content)
    for name, array in arrays_of(found).items():
        rounded = "quaternions" in name
        np.testing.assert_allclose(array, wanted[name], rtol=0.0, atol=1e-14 if rounded else 0.0)


@examples(60)
@given(data=st.data(), name=st.sampled_from(sorted(arrays_of(WALL))))
def test_maps_of_other_numbers(folder: Path, data: st.DataObject, name: str) -> None:
    """Some values of an array are any of its type."""
    array = np.array(arrays_of(WALL)[name])
    kinds = {"f": st.floats(), "i": st.integers(-(2**63), 2**63 - 1) | st.integers(-2, 9)}
    values = kinds.get(array.dtype.kind, st.integers(0, 255))
    for _ in range(data.draw(st.integers(1, 4)) if array.size else 0):
        array.ravel()[data.draw(st.integers(0, array.size - 1))] = data.draw(values)
    path = folder / "other.slam"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(map_file, "arrays_of", lambda content: arrays_of(content) | {name: array})
        write_map(path, WALL)
    found = parsed(read_map, path)
    if found is not None:
        for values_of_one in arrays_of(found).values():
            assert np.isfinite(values_of_one).all()


# --- bags -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite"])
@examples(8)
@given(data=st.data())
def test_bags(folder: Path, kind: str, data: st.DataObject) -> None:
    """Samples and images of any time that ROS can write: seconds of 31 bits, or of 32."""
    end = (2**32 if kind == "ros1" else 2**31) * 10**9
    times = data.draw(frame_stamps(2 * 10**9, end))
    imu = data.draw(samples(times))
    values = np.random.default_rng(data.draw(st.integers(0, 2**32))).integers(
        0, 256, (len(times), SIZE[1], SIZE[0]), np.uint8
    )
    path = folder / ("flight.bag" if kind == "ros1" else f"flight_{kind}")
    for left in (path, *path.glob("*")):
        if left.is_file():
            left.unlink()
    if path.is_dir():
        path.rmdir()
    with bag_writer(path, kind) as bag:
        write_calibration(bag, 1)
        for stamp_ns, gyro, accel in zip(imu.stamps_ns.tolist(), imu.gyro, imu.accel, strict=True):
            bag.write("/imu0", bag.imu(stamp_ns, gyro, accel), stamp_ns)
        for stamp_ns, image in zip(times.tolist(), values, strict=True):
            bag.write("/cam0/image_raw", bag.image(stamp_ns, image, "mono8"), stamp_ns)
    sequence = open_dataset(path)
    same_samples(sequence.imu(), imu)
    frames = list(sequence.frames())
    assert [frame.stamp_ns for frame in frames] == times.tolist()
    for frame, image in zip(frames, values, strict=True):
        assert isinstance(frame, CameraFrame)
        np.testing.assert_array_equal(frame.images[0], image)


# --- anything -------------------------------------------------------------------------------------


def ros1_record(header: bytes, data: bytes) -> bytes:
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


STARTS = {
    "calibration.yaml": b"cam0: ",
    "config.yaml": b"backend: ",
    "map.slam": b"PK\x03\x04",
    "flight.bag": b"#ROSBAG V2.0\n",
    "flight.mcap": b"\x89MCAP0\r\n",
    "flight.db3": b"SQLite format 3\x00",
}

READERS: dict[str, Callable[[Path], Any]] = {
    "calibration.yaml": read_kalibr,
    "config.yaml": load_config,
    "map.slam": read_map,
    "flight.bag": open_dataset,
    "flight.mcap": open_dataset,
    "flight.db3": open_dataset,
}


@pytest.mark.parametrize("name", READERS)
@examples(60)
@given(content=ANYTHING, begins=st.booleans(), ends=st.booleans())
def test_anything(folder: Path, name: str, content: bytes, begins: bool, ends: bool) -> None:
    """Also after the bytes that files of the kind begin with, and before those at the end."""
    path = folder / name
    start = STARTS[name]
    path.write_bytes(start * begins + content + start * ends)
    parsed(READERS[name], path)
