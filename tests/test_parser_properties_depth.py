# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of depth sensors: their calibration, images of depth, and registration.

As `test_parser_properties`: what is written is read again, and anything is judged.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from damage import MOST_MB, memory_mb
from generated_rigs import cameras, rigs
from hypothesis import given
from hypothesis import strategies as st
from properties import ANYTHING, edited, examples, parsed, poses
from sound import sound_depth, sound_rig

from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, write_kalibr
from slam_graph.datasets.rosbag.messages import PackedImage
from slam_graph.datasets.rosbag.ros_depth import depth_of
from slam_graph.datasets.streams.depth_images import (
    DepthFinish,
    Registration,
    decode_depth,
    nearest_in_time,
)
from slam_graph.datasets.streams.images import Fault
from slam_graph.errors import DataError
from slam_graph.sensors import Camera, DepthSensor, Rig, RigCamera

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]


@st.composite
def sensors(draw: st.DrawFn, of: int = 1, size: tuple[int, int] | None = None) -> DepthSensor:
    """Sensors of one of so many cameras, registered to it or with a lens of their own."""
    least, most = sorted(draw(st.lists(st.floats(0.0, 1e9), min_size=2, max_size=2, unique=True)))
    noise = draw(st.tuples(st.floats(1e-9, 1e9), st.floats(0.0, 1e9)))
    scale = draw(st.floats(1e-9, 1e9))
    sensor = DepthSensor(draw(st.integers(0, of - 1)), scale, least, most, *noise)
    if draw(st.booleans()):
        return sensor
    return replace(sensor, lens=draw(cameras(size)), camera_T_depth=draw(poses()))


# --- calibration ----------------------------------------------------------------------------------


@examples(50)
@given(data=st.data())
def test_calibrations(folder: Path, data: st.DataObject) -> None:
    rig = data.draw(rigs(2))
    sensor = data.draw(sensors(len(rig.cameras)))
    path = folder / "camchain.yaml"
    write_kalibr(replace(rig, depth=sensor), path)
    found = read_kalibr(path).depth
    assert found is not None
    for name in ("camera", "scale", "min_m", "max_m", "noise_constant_m", "noise_square_per_m"):
        assert getattr(found, name) == getattr(sensor, name)
    assert found.lens == sensor.lens
    wanted = sensor.camera_T_depth.matrix()
    np.testing.assert_allclose(found.camera_T_depth.matrix(), wanted, rtol=1e-12, atol=1e-12)


CHAIN = """cam0:
  T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [50.0, 51.0, 32.5, 23.5]
  distortion_model: none
  distortion_coeffs: []
  resolution: [64, 48]
depth0:
  camera: 0
  scale: 5000
  range_m: [0.5, 6]
  noise: [0.002, 0.003]
  T_cam_depth: [[1, 0, 0, 0.02], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [50.0, 51.0, 32.5, 23.5]
  distortion_model: none
  distortion_coeffs: []
  resolution: [64, 48]
"""


@examples(150)
@given(data=st.data())
def test_edited_calibrations(folder: Path, data: st.DataObject) -> None:
    path = folder / "edited.yaml"
    before, mark, sensor = CHAIN.partition("depth0:\n")
    path.write_bytes((before + mark).encode() + data.draw(edited(sensor, " ,:[]")))
    rig = parsed(lambda: read_kalibr(path, needs_imu=False))
    if rig is not None:
        sound_rig(rig)


# --- images ---------------------------------------------------------------------------------------

SIZE = (7, 5)


@examples()
@given(data=st.data(), sensor=sensors())
def test_images_of_16_bits(data: st.DataObject, sensor: DepthSensor) -> None:
    """Depths within the range of the sensor, NaN elsewhere."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    raw = rng.integers(0, 2**16, SIZE[::-1], np.uint16)
    _, packed = cv2.imencode(".png", raw)
    found = decode_depth(packed.tobytes(), "here")
    np.testing.assert_array_equal(found, raw)
    metres = sensor.metres(raw)
    inside = ~np.isnan(metres)
    wanted = raw[inside] / sensor.scale
    np.testing.assert_allclose(metres[inside], wanted, rtol=1e-6)
    assert np.all(
        (metres[inside] >= np.float32(sensor.min_m)) & (metres[inside] <= np.float32(sensor.max_m))
    )


NUMBERS = st.floats(width=32) | st.floats(0.0, 20.0, width=32)


@examples()
@given(data=st.data(), values=st.lists(NUMBERS, min_size=35, max_size=35))
def test_images_of_any_floats(data: st.DataObject, values: list[float]) -> None:
    """Also where the depth is registered to another camera, wherever that is."""
    small = data.draw(cameras(SIZE))
    sensor = data.draw(sensors(size=SIZE))
    raw = np.array(values, np.float32).reshape(SIZE[::-1])
    _, packed = cv2.imencode(".tiff", raw)
    found = decode_depth(packed.tobytes(), "here")
    np.testing.assert_array_equal(found, raw)
    finish = DepthFinish(sensor, small)
    depth = parsed(finish, raw, "here")
    if depth is not None:
        sound_depth(depth, small, sensor.max_m if sensor.lens is None else np.inf)


@examples(100)
@given(content=ANYTHING, data=st.data())
def test_anything_as_depth(content: bytes, data: st.DataObject) -> None:
    """A file, or a message with its header of two numbers."""
    _, packed = cv2.imencode(".png", np.full((2, 3), 700, np.uint16))
    valid = packed.tobytes()
    header = data.draw(st.binary(min_size=12, max_size=12))
    whole = valid[: data.draw(st.integers(0, len(valid)) | st.just(len(valid)))]
    for found in (
        decode_depth(whole + content, "here"),
        depth_of(PackedImage("32FC1; compressedDepth png", header + whole), "here"),
        depth_of(PackedImage("16UC1; compressedDepth", content), "here"),
    ):
        if isinstance(found, Fault):
            assert "\n" not in found.message
        else:
            assert found.ndim == 2
            assert found.dtype in (np.uint16, np.float32)
            depth = DepthSensor().metres(found)
            assert np.isfinite(depth[~np.isnan(depth)]).all()


# --- registration ---------------------------------------------------------------------------------


@examples(40)
@given(data=st.data())
def test_registration_to_itself(data: st.DataObject) -> None:
    """A sensor in the place of the camera, with its lens, gives the depths that it has."""
    values = data.draw(st.tuples(*[st.floats(10.0, 50.0)] * 2, *[st.floats(0.0, 5.0)] * 2))
    camera = Camera(*values, "none", (), *SIZE)
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    depth = rng.uniform(0.5, 20.0, SIZE[::-1]).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = np.nan
    found = Registration(camera, camera, DepthSensor().camera_T_depth).register(depth)
    there = ~np.isnan(depth)
    assert not np.isnan(found[there]).any()
    known = np.sort(depth[there])
    place = np.clip(np.searchsorted(known, found[there] * (1 + 1e-5)) - 1, 0, len(known) - 1)
    np.testing.assert_allclose(found[there], known[place], rtol=1e-5)
    assert np.all(found[there] <= depth[there] * (1 + 1e-5))


def test_a_camera_of_too_many_pixels_is_refused() -> None:
    """Its images may all be damaged, so that nothing else tells."""
    lens = Camera(50.0, 50.0, 32.0, 24.0, "none", (), 64, 48)
    camera = Camera(50.0, 50.0, 32.0, 24.0, "none", (), 65535, 65535)
    sensor = DepthSensor(lens=lens)
    rig = Rig((RigCamera(camera, sensor.camera_T_depth, 0.0, "cam0"),), depth=sensor)
    memory_mb(reset=True)
    before_mb = memory_mb()
    with pytest.raises(DataError, match="65535x65535"):
        DepthFinish.of(rig)(np.full((48, 64), 2000, np.uint16), "here")
    assert memory_mb() < before_mb + MOST_MB


@pytest.mark.parametrize("times", [40.0, 2000.0])
def test_a_focal_length_of_another_kind_of_camera_is_refused(times: float) -> None:
    """Each point would fill as many pixels squared: one small image took a minute."""
    lens = Camera(1.0, 1.0, 3.0, 2.0, "none", (), *SIZE)
    camera = replace(lens, fx=times, fy=times)
    with pytest.raises(DataError, match=f"{times:.0f} times shorter"):
        Registration(lens, camera, DepthSensor().camera_T_depth)


# --- times ----------------------------------------------------------------------------------------

STAMPS = st.lists(
    st.integers(1 - 2**62, 2**62 - 1) | st.integers(0, 10**9), max_size=6, unique=True
)


@examples(100)
@given(frames=STAMPS, depths=STAMPS)
def test_a_depth_image_is_of_one_frame_near_to_it(frames: list[int], depths: list[int]) -> None:
    frames_ns, depths_ns = (np.array(sorted(times), np.int64) for times in (frames, depths))
    found = nearest_in_time(frames_ns, depths_ns)
    used = found[found >= 0]
    assert len(np.unique(used)) == len(used)
    apart = np.abs(depths_ns[used] - frames_ns[found >= 0])
    assert np.all(apart <= 20_000_000)
    for stamp in frames_ns[found < 0].tolist():  # what is near to it is nearer to another frame
        near = [k for k, t in enumerate(depths_ns.tolist()) if abs(t - stamp) <= 20_000_000]
        assert set(near[:1]) <= set(used.tolist()) or len(near) > 1
