# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of the readers of tracks that other programs wrote: OpenVINS, EqVIO.

As `test_parser_properties`: what is written is read again, and anything is judged.
"""

import json
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from generated_rigs import frame_stamps, rigs, same_samples, samples
from hypothesis import given
from hypothesis import strategies as st
from properties import (
    ANYTHING,
    dressed,
    edited,
    examples,
    in_seconds,
    instead,
    parsed,
    poses,
    rows_as_bytes,
    rows_of,
    trajectories,
)
from recordings import write_openvins
from sound import sound_dataset, sound_recording

from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.calibration.euroc_calibration import camera_entry
from slam_graph.datasets.formats.eqvio import wheel_tracks
from slam_graph.geometry import Trajectory
from slam_graph.sensors import FeatureFrame, FeatureObservations, ImuData, Rig

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]

TIMES = {"least": 0, "end": 4 * 10**18}


@st.composite
def frames(
    draw: st.DrawFn, times: np.ndarray, cameras: int, width: float, height: float
) -> list[FeatureFrame]:
    """Frames whose cameras see one to four features each, at pixels of an image of some size."""
    number = st.integers(-(2**63), 2**63 - 1)
    pixel = st.tuples(st.floats(0.0, width), st.floats(0.0, height))

    def seen() -> FeatureObservations:
        ids = draw(st.lists(number, min_size=1, max_size=4, unique=True))
        pixels = np.array([draw(pixel) for _ in ids])
        return FeatureObservations(np.array(ids, np.int64), pixels, pixels)

    return [FeatureFrame(stamp, tuple(seen() for _ in range(cameras))) for stamp in times.tolist()]


def same_tracks(found: RecordedSequence, written: list[FeatureFrame], field: str) -> None:
    """The same ids, and coordinates to the bit."""
    read = list(found.frames())
    assert [frame.stamp_ns for frame in read] == [frame.stamp_ns for frame in written]
    for mine, its in zip(read, written, strict=True):
        assert isinstance(mine, FeatureFrame)
        for one, other in zip(mine.cameras, its.cameras, strict=True):
            np.testing.assert_array_equal(one.ids, other.ids)
            np.testing.assert_array_equal(getattr(one, field), getattr(other, field))


def inertial_rows(imu: ImuData) -> list[list[Any]]:
    """A row of time, rates and specific forces for each sample."""
    rows = zip(imu.stamps_ns.tolist(), imu.gyro.tolist(), imu.accel.tolist(), strict=True)
    return [[in_seconds(stamp_ns), *map(repr, [*gyro, *accel])] for stamp_ns, gyro, accel in rows]


def text_of(title: str, rows: list[list[Any]]) -> str:
    return "\n".join([title, *(",".join(map(str, row)) for row in rows)])


# --- OpenVINS -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def openvins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulation of three frames, with short files."""
    folder = write_openvins(
        tmp_path_factory.mktemp("openvins") / "flight", frames=3, features=3, cameras=2
    )
    lines = (folder / "imu.csv").read_text().splitlines(keepends=True)
    (folder / "imu.csv").write_text("".join([*lines[:2], *lines[21:24], *lines[60:70]]))
    return folder


def state_rows(path: Trajectory) -> list[list[Any]]:
    """A row of time, position, quaternion, velocity and biases for each state."""
    assert path.velocities is not None
    assert path.gyro_biases is not None
    assert path.accel_biases is not None
    parts = (path.positions, path.quaternions, path.velocities, path.gyro_biases, path.accel_biases)
    values = np.hstack(parts).tolist()
    return [
        [in_seconds(stamp_ns), *map(repr, row)]
        for stamp_ns, row in zip(path.stamps_ns.tolist(), values, strict=True)
    ]


SIGMAS = ("q", "p", "v", "ba", "bg")
"""Standard deviations of a start, in the order of the covariance."""


@examples(25)
@given(data=st.data())
def test_openvins(openvins: Path, data: st.DataObject) -> None:
    """Tracks, samples, true states, and the start with its standard deviations."""
    times = data.draw(frame_stamps(10**9, 4 * 10**18))
    written, imu = data.draw(frames(times, 2, 751.0, 479.0)), data.draw(samples(times))
    truth = data.draw(trajectories(columns=(16,), **TIMES))
    start = data.draw(trajectories(columns=(16,), **TIMES))
    sigmas = data.draw(st.lists(st.floats(1e-9, 1e9), min_size=5, max_size=5))
    named = [f"{name} {sigma!r}" for name, sigma in zip(SIGMAS, sigmas, strict=True)]
    tracks = [
        [in_seconds(frame.stamp_ns), camera, number, *map(repr, pixel)]
        for frame in written
        for camera, seen in enumerate(frame.cameras)
        for number, pixel in zip(seen.ids.tolist(), seen.pixels.tolist(), strict=True)
    ]
    texts = {
        "tracks.csv": text_of("#t[s],camera,feature,u,v", tracks),
        "imu.csv": text_of("#t[s],w,a", inertial_rows(imu)),
        "groundtruth.csv": text_of("#t", state_rows(truth)),
    }
    for name, text in texts.items():
        (openvins / name).write_bytes(data.draw(dressed(text)))
    title = f"# (prior sigma: {', '.join(named)})"
    (openvins / "init_state.csv").write_text(text_of(title, state_rows(start)))
    sequence = open_dataset(openvins)
    assert isinstance(sequence, RecordedSequence)
    same_tracks(sequence, written, "pixels")
    same_samples(sequence.imu(), imu)
    found, state = sequence.groundtruth(), sequence.initial_state()
    assert found is not None
    assert state is not None
    np.testing.assert_array_equal(found.stamps_ns, truth.stamps_ns)
    for field in ("positions", "velocities", "gyro_biases", "accel_biases"):
        np.testing.assert_array_equal(getattr(found, field), getattr(truth, field))
    assert state.stamp_ns == start.stamps_ns[0]
    assert state.covariance is not None
    np.testing.assert_allclose(np.diag(state.covariance), np.repeat(sigmas, 3) ** 2, rtol=1e-14)
    sound_recording(sequence)


def calibration_of(rig: Rig) -> str:
    """The calibration of OpenVINS' simulation for a rig."""
    noise = {name: value for name, value in vars(rig.imu).items() if name != "has_imu"}
    cameras = []
    for k, mounted in enumerate(rig.cameras):
        camera, entry = mounted.camera, camera_entry(mounted.camera)
        cameras.append(
            {
                "id": k,
                "model": entry.camera_model,
                "intrinsics": entry.intrinsics,
                "distortion": entry.kalibr_distortion,
                "distortion_coeffs": entry.coefficients,
                "resolution": [camera.width, camera.height],
                "T_imu_cam": mounted.body_T_camera.matrix().tolist(),
            }
        )
    offset_s = rig.cameras[0].time_offset_s
    return json.dumps({"imu": noise, "cam_imu_time_offset_s": offset_s, "cameras": cameras})


@examples(40)
@given(data=st.data())
def test_calibrations_of_openvins(openvins: Path, data: st.DataObject) -> None:
    """Each camera, its place and clock, and the noise of the IMU."""
    rig = data.draw(rigs(2))
    while len(rig.cameras) < 2:  # there are tracks of two
        rig = Rig((*rig.cameras, rig.cameras[0]), rig.imu)
    with instead(openvins / "calib.yaml", calibration_of(rig).encode()):
        found = open_dataset(openvins).rig
    assert found.imu == rig.imu
    for mine, its in zip(found.cameras, rig.cameras, strict=True):
        assert mine.camera == its.camera
        assert mine.time_offset_s == rig.cameras[0].time_offset_s
        wanted = its.body_T_camera.matrix()
        np.testing.assert_allclose(mine.body_T_camera.matrix(), wanted, rtol=1e-12, atol=1e-12)


OPENVINS = ("calib.yaml", "tracks.csv", "imu.csv", "groundtruth.csv", "init_state.csv")


@pytest.mark.parametrize("name", OPENVINS)
@examples()
@given(data=st.data())
def test_edited_files_of_openvins(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject
) -> None:
    folder = tmp_path_factory.getbasetemp() / f"openvins_{Path(name).stem}"
    if not folder.exists():
        write_openvins(folder, frames=2, features=2)
        lines = (folder / "imu.csv").read_text().splitlines(keepends=True)
        (folder / "imu.csv").write_text("".join(lines[:40]))
    with instead(folder / name, data.draw(edited((folder / name).read_text(), " ,:[]"))):
        parsed(sound_dataset, folder)


COLUMNS = {"tracks.csv": 5, "imu.csv": 7, "groundtruth.csv": 17, "init_state.csv": 17}


@pytest.mark.parametrize("name", COLUMNS)
@examples(30)
@given(data=st.data())
def test_any_rows_of_openvins(openvins: Path, name: str, data: st.DataObject) -> None:
    rows = rows_as_bytes(",", COLUMNS[name])
    with instead(openvins / name, data.draw(rows | ANYTHING)):
        parsed(sound_dataset, openvins)


# --- EqVIO ----------------------------------------------------------------------------------------

HEADER = (
    "row_type,t_abs,t_rel,seq,frame_idx,landmark_id,gx,gy,gz,ax,ay,az,bgx,bgy,bgz,bax,bay,baz,"
    "u_norm,v_norm,key,value"
)
META = {"format_version": "1", "measurement_space": "normalized"}
PLACE = ("fx", "fy", "cx", "cy"), ("qw", "qx", "qy", "qz", "tx", "ty", "tz")


def eqvio_text(
    written: list[FeatureFrame], imu: ImuData, intrinsics: list[float], place: list[float]
) -> str:
    """A file of EqVIO's tracks: all meta rows, then features, then samples."""
    meta = META | {f"camera_{k}": repr(v) for k, v in zip(PLACE[0], intrinsics, strict=True)}
    meta |= {f"T_ci_{k}": repr(v) for k, v in zip(PLACE[1], place, strict=True)}
    lines = [HEADER, *(f"meta{',' * 20}{key},{value}" for key, value in meta.items())]
    for k, frame in enumerate(written):
        seen = frame.cameras[0]
        for number, (u, v) in zip(seen.ids.tolist(), seen.normalized.tolist(), strict=True):
            stamp = in_seconds(frame.stamp_ns)
            lines.append(f"vision_feature,{stamp},0,0,{k},{number}{',' * 13}{u!r},{v!r},,")
    for stamp, *values in inertial_rows(imu):
        lines.append(f"imu,{stamp},0,1,,,{','.join(values)},0,0,0,0,0,0,,,,")
    return "\n".join(lines)


@examples(40)
@given(data=st.data())
def test_eqvio(folder: Path, data: st.DataObject) -> None:
    """Times are whole microseconds."""
    times = data.draw(frame_stamps(10**9, 4 * 10**18)) // 1000 * 1000
    written, imu = data.draw(frames(times, 1, 2.0, 2.0)), data.draw(samples(times))
    stamps_ns = np.unique(imu.stamps_ns // 1000) * 1000
    imu = ImuData(stamps_ns, imu.gyro[: len(stamps_ns)], imu.accel[: len(stamps_ns)])
    intrinsics = data.draw(st.lists(st.floats(1e-3, 1e6), min_size=4, max_size=4))
    pose = data.draw(poses())
    turn = pose.rotation().toQuaternion()
    place = [turn.w(), turn.x(), turn.y(), turn.z(), *pose.translation().tolist()]
    path = folder / "tracks.csv"
    path.write_text(eqvio_text(written, imu, intrinsics, place))
    sequence = open_dataset(path)
    assert isinstance(sequence, RecordedSequence)
    same_tracks(sequence, written, "normalized")
    same_samples(sequence.imu(), imu)
    (mounted,) = sequence.rig.cameras
    assert mounted.camera.intrinsics.tolist() == intrinsics
    np.testing.assert_allclose(mounted.body_T_camera.matrix(), pose.matrix(), rtol=0, atol=1e-12)
    sound_recording(sequence)


@pytest.fixture(scope="module")
def eqvio() -> str:
    """The first rows of the file in GTSAM's wheel: meta, some features, some samples."""
    with wheel_tracks().open(encoding="utf-8") as file:
        lines = list(islice(file, 72))
    lengths = [line for line in lines if "dataset_path" not in line]
    return "".join(lengths)


@examples(100)
@given(data=st.data())
def test_edited_rows_of_eqvio(folder: Path, eqvio: str, data: st.DataObject) -> None:
    path = folder / "edited.csv"
    lines = eqvio.splitlines(keepends=True)
    known = sum(line.startswith(("row_type", "meta")) for line in lines)
    needed = [line for line in lines[:known] if "eqf." not in line]
    path.write_bytes(data.draw(edited("".join([*needed, *lines[known:]]))))
    parsed(sound_dataset, path)


TAGS = ("vision_feature,", "imu,", "meta,")


@examples()
@given(content=rows_of(",", 19, TAGS))
def test_any_rows_of_eqvio(folder: Path, eqvio: str, content: str) -> None:
    path = folder / "rows.csv"
    path.write_bytes((eqvio + content).encode("utf-8", "surrogatepass"))
    parsed(sound_dataset, path)
