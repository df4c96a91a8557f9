# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of the readers of recordings of tracks, maps and bags.

As `test_parser_properties`: what is written is read again, and anything is judged.
"""

import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from generated_rigs import (
    frame_stamps,
    rigs,
    same_rig,
    same_samples,
    samples,
)
from hypothesis import given
from hypothesis import strategies as st
from map_flights import World
from properties import (
    ANYTHING,
    NAMES,
    examples,
    parsed,
    poses,
    stamps,
    trajectories,
    vectors,
)
from recordings import SIZE
from recordings_ros import bag_writer, write_calibration
from sound import sound_dataset, sound_map

from slam_graph.config import load_config
from slam_graph.datasets import TrackRecorder, open_dataset
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr
from slam_graph.geometry import NavState
from slam_graph.maps import map_file
from slam_graph.maps.map_file import arrays_of, read_map, write_map
from slam_graph.maps.map_model import PoseSource, SlamMap
from slam_graph.sensors import (
    CameraFrame,
    FeatureFrame,
    FeatureObservations,
    ImuData,
)
from slam_graph.simulation.simulator import simulate

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]


# --- recordings of tracks -------------------------------------------------------------------------


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
        parsed(sound_dataset, flight)
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
        stamps_ns=draw(stamps(count, count)),
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


@examples()
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
        sound_map(found)


# --- bags -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite"])
@examples(16)
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
@examples()
@given(content=ANYTHING, begins=st.booleans(), ends=st.booleans())
def test_anything(folder: Path, name: str, content: bytes, begins: bool, ends: bool) -> None:
    """Also after the bytes that files of the kind begin with, and before those at the end."""
    path = folder / name
    start = STARTS[name]
    path.write_bytes(start * begins + content + start * ends)
    parsed(READERS[name], path)
