# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of the readers of calibrations, EuRoC folders and settings.

As `test_parser_properties`: what is written is read again, and anything is judged.
"""

import json
import shutil
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from generated_rigs import (
    frame_stamps,
    rigs,
    same_rig,
    same_samples,
    samples,
)
from hypothesis import given
from hypothesis import strategies as st
from properties import (
    NAMES,
    dressed,
    examples,
    parsed,
    trajectories,
)

from slam_graph.config import RunConfig, load_config
from slam_graph.datasets import open_dataset
from slam_graph.datasets.calibration.calibration_yaml import MAX_OFFSET_S
from slam_graph.datasets.calibration.euroc_calibration import read_euroc_rig
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, write_kalibr
from slam_graph.datasets.formats.euroc_writer import EurocWriter
from slam_graph.sensors import (
    CameraFrame,
    Rig,
)

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]


# --- calibrations ---------------------------------------------------------------------------------


@examples(50)
@given(st.data())
def test_kalibr(folder: Path, data: st.DataObject) -> None:
    rig, path = data.draw(rigs()), folder / "camchain.yaml"
    write_kalibr(rig, path)
    path.write_bytes(data.draw(dressed(path.read_text(encoding="utf-8"), blanks=" ")))
    same_rig(read_kalibr(path), rig, of_kalibr=True)


@examples(30)
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


@examples()
@given(st.text(max_size=30), st.text(max_size=30))
def test_overrides(key: str, value: str) -> None:
    parsed(load_config, None, [f"{key}={value}"])
    parsed(load_config, None, [f"backend.noise.pixel_sigma={value}"])
