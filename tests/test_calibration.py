# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files: EuRoC's, Kalibr's, and what is wrong with them."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
import yaml
from recordings import edit_text, write_euroc, write_openvins
from recordings_loose import CHAIN as LOOSE_CHAIN
from recordings_loose import write_image_folder

from slam_graph.datasets.calibration.calibration_yaml import read_yaml
from slam_graph.datasets.calibration.euroc_calibration import read_euroc_rig
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, write_kalibr
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.formats.track_recorder import TrackRecorder
from slam_graph.errors import DataError
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.rig import ImuNoise, Rig, RigCamera

CHAIN = """cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.5]
  - [0.0, 0.0, 1.0, 0.25]
  - [1.0, 0.0, 0.0, -0.125]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, -0.03, 0.004]
  distortion_model: equidistant
  intrinsics: [380.5, 380.25, 510.0, 514.0]
  resolution: [1024, 1020]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -1.5e-3
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [380.5, 380.25, 510.0, 514.0]
  resolution: [1024, 1020]
"""

IMU = """rostopic: /imu0
update_rate: 200.0
accelerometer_noise_density: 1e-3
accelerometer_random_walk: 2.0e-4
gyroscope_noise_density: 3.0e-4
gyroscope_random_walk: 4.0e-5
"""


@pytest.fixture
def chain(tmp_path: Path) -> Path:
    path = tmp_path / "camchain-imucam.yaml"
    path.write_text(CHAIN)
    return path


def random_rig(rng: np.random.Generator) -> Rig:
    """Cameras, one of each distortion model, at random poses."""

    def mounted(distortion: str, count: int) -> RigCamera:
        fx, fy, cx, cy = rng.uniform(100, 900, 4).tolist()
        coefficients = tuple((rng.uniform(size=count) * 10.0 ** rng.integers(-9, 1)).tolist())
        camera = Camera(fx, fy, cx, cy, distortion, coefficients, 640, 480)  # type: ignore[arg-type]
        pose = gtsam.Pose3.Expmap(rng.normal(size=6))
        return RigCamera(camera, pose, float(rng.normal() * 1e-3), f"camera {distortion}")

    cameras = [mounted("none", 0), mounted("radtan", 4), mounted("equidistant", 4)]
    cameras += [mounted("mei", 5), mounted("double_sphere", 2)]
    return Rig(tuple(cameras), ImuNoise(*rng.uniform(1e-6, 1e-2, 4).tolist(), 123.5))


def same(a: Rig, b: Rig, tolerance: float = 1e-12) -> bool:
    return a.imu == b.imu and all(
        x.camera == y.camera
        and x.time_offset_s == y.time_offset_s
        and x.name == y.name
        and np.allclose(x.body_T_camera.matrix(), y.body_T_camera.matrix(), rtol=0, atol=tolerance)
        for x, y in zip(a.cameras, b.cameras, strict=True)
    )


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    for _ in range(20):
        rig = random_rig(rng)
        write_kalibr(rig, tmp_path / "calibration.yaml")
        assert same(read_kalibr(tmp_path / "calibration.yaml"), rig)
    assert [p.name for p in tmp_path.iterdir()] == ["calibration.yaml"]


def test_what_is_written_is_kalibrs_format(tmp_path: Path) -> None:
    rig = random_rig(np.random.default_rng(8))
    write_kalibr(rig, tmp_path / "calibration.yaml")
    content = yaml.safe_load((tmp_path / "calibration.yaml").read_text())
    assert list(content) == ["cam0", "cam1", "cam2", "cam3", "cam4", "imu0"]
    camera_T_body = np.array(content["cam1"]["T_cam_imu"])
    expected = np.linalg.inv(rig.cameras[1].body_T_camera.matrix())
    np.testing.assert_allclose(camera_T_body, expected, atol=1e-12)
    assert content["cam1"]["distortion_model"] == "radtan"
    assert content["imu0"]["update_rate"] == 123.5


def test_omnidirectional_cameras_of_kalibr(chain: Path) -> None:
    old = """  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, -0.03, 0.004]
  distortion_model: equidistant
  intrinsics: [380.5, 380.25, 510.0, 514.0]
"""
    omni = (
        old.replace("pinhole", "omni").replace("equidistant", "radtan").replace("[380", "[2, 380")
    )
    edit_text(chain, old, omni)
    camera = read_kalibr(chain).cameras[0].camera
    assert (camera.distortion, camera.fx) == ("mei", 380.5)
    assert camera.coefficients == (2.0, -0.01, 0.02, -0.03, 0.004)
    spheres = omni.replace("omni", "ds").replace("[2,", "[-0.2, 0.6,")
    edit_text(chain, omni, spheres)
    with pytest.raises(DataError, match=r"yaml:10: .*'radtan' does not go with .*'ds'"):
        read_kalibr(chain)
    edit_text(chain, "distortion_model: radtan", "distortion_model: none")
    camera = read_kalibr(chain).cameras[0].camera
    assert (camera.distortion, camera.coefficients) == ("double_sphere", (-0.2, 0.6))
    edit_text(chain, "-0.2, 0.6", "-0.2, 1.6")
    with pytest.raises(DataError, match="alpha of camera model 'double_sphere'"):
        read_kalibr(chain)


def test_kalibr_chain(chain: Path) -> None:
    rig = read_kalibr(chain)
    first, second = rig.cameras
    R = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    np.testing.assert_allclose(first.body_T_camera.rotation().matrix(), R.T, atol=1e-15)
    np.testing.assert_allclose(first.body_T_camera.translation(), -R.T @ [0.5, 0.25, -0.125])
    assert (first.time_offset_s, second.time_offset_s) == (-1.5e-3, 0.0)
    assert first.camera.distortion == "equidistant"
    assert second.camera.coefficients == ()
    # the point 0.1 m to the right of the first camera is the centre of the second
    between = first.body_T_camera.between(second.body_T_camera)
    np.testing.assert_allclose(between.translation(), [0.1, 0, 0], atol=1e-15)
    assert rig.imu == ImuNoise()


@pytest.mark.parametrize("first", ["T_cam_imu", "unknown", "nothing"])
def test_a_baseline_is_that_of_its_link_whatever_is_known_of_the_imu(
    chain: Path, first: str
) -> None:
    """Kalibr gives both cameras the pose of the IMU, and the second one its link."""
    content = yaml.safe_load(CHAIN)
    link = np.array(content["cam1"]["T_cn_cnm1"])
    content["cam1"]["T_cam_imu"] = (link @ content["cam0"]["T_cam_imu"]).tolist()
    if first == "unknown":
        content["cam0"]["T_cam_imu"] = "unknown"
    elif first == "nothing":
        del content["cam0"]["T_cam_imu"]
    chain.write_text(yaml.safe_dump(content))
    rig = read_kalibr(chain, needs_imu=first != "nothing")
    left, right = rig.cameras
    between = right.body_T_camera.between(left.body_T_camera)
    np.testing.assert_allclose(between.matrix(), link, atol=1e-12)
    assert left.rotation_known is right.rotation_known is (first != "unknown")
    write_kalibr(rig, chain)
    assert same(read_kalibr(chain), rig)
    del content["cam1"]["T_cn_cnm1"]
    chain.write_text(yaml.safe_dump(content))
    if first != "T_cam_imu":
        with pytest.raises(
            DataError, match=r"yaml:\d+: cam1: missing key 'T_cn_cnm1', .* does not"
        ):
            read_kalibr(chain, needs_imu=first != "nothing")


def test_a_link_is_from_the_camera_before(chain: Path) -> None:
    edit_text(chain, "cam1:", "cam2:")
    with pytest.raises(
        DataError, match=r"yaml:\d+: T_cn_cnm1: is from the camera before.*no camera"
    ):
        read_kalibr(chain)
    content = yaml.safe_load(chain.read_text())
    content["cam2"]["T_cam_imu"] = np.eye(4).tolist()
    chain.write_text(yaml.safe_dump(content))
    assert read_kalibr(chain).cameras[1].body_T_camera.equals(gtsam.Pose3(), 1e-12)


EYE, OFF = np.eye(3).tolist(), [[1.02, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    "line",
    [
        "model: scale-misalignment",
        "time_offset: 0.25",
        "T_i_b: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
        f"accelerometers: {{M: {OFF}}}",
        f"gyroscopes: {{M: {OFF}}}",
        f"gyroscopes: {{M: {EYE}, A: {EYE}}}",
        "gyroscopes: {C_gyro_i: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]}",
    ],
)
def test_an_imu_whose_samples_need_correction_is_refused(
    chain: Path, tmp_path: Path, line: str
) -> None:
    (tmp_path / "imu.yaml").write_text(f"{IMU}{line}\n")
    with pytest.raises(DataError, match=r"imu\.yaml:7: .*not corrected by it") as error:
        read_kalibr(chain)
    assert "\n" not in str(error.value)


def test_an_imu_that_kalibr_takes_as_calibrated_is_read(chain: Path, tmp_path: Path) -> None:
    neutral = f"accelerometers: {{M: {EYE}}}\ngyroscopes: {{M: {EYE}, C_gyro_i: {EYE}}}\n"
    rest = f"model: calibrated\ntime_offset: 0.0\nT_i_b: {np.eye(4).tolist()}\n"
    (tmp_path / "imu.yaml").write_text(IMU + neutral + rest)
    assert read_kalibr(chain).imu == ImuNoise(3e-4, 4e-5, 1e-3, 2e-4, 200.0)


def test_the_noise_of_a_recording_outlives_another_calibration(chain: Path, tmp_path: Path) -> None:
    """The chain knows nothing of the IMU; where the recording does not either, it is said."""
    simulated = open_dataset(write_openvins(tmp_path / "simulated"))
    noise = ImuNoise(1e-2, 1e-3, 0.1, 1e-2, 100.0)
    with TrackRecorder(tmp_path / "tracks", Rig(simulated.rig.cameras, noise)) as recorder:
        for packet in simulated.packets():
            recorder.write(packet.imu, packet.frame)
    for name, expected in (("simulated", simulated.rig.imu), ("tracks", noise)):
        sequence = open_dataset(tmp_path / name, calibration=chain)
        assert sequence.rig.imu == expected
        assert not sequence.diagnostics.counts
    images = write_image_folder(tmp_path / "images")
    (images / "calibration.yaml").write_text(LOOSE_CHAIN.partition("imu0:")[0])
    assert open_dataset(images).diagnostics.counts == {"imu_noise_assumed": 1}
    assert not open_dataset(images, imu=False).diagnostics.counts


def test_imu_noise_of_kalibr(chain: Path, tmp_path: Path) -> None:
    expected = ImuNoise(3e-4, 4e-5, 1e-3, 2e-4, 200.0)
    (tmp_path / "other.yaml").write_text(IMU)
    assert read_kalibr(chain, tmp_path / "other.yaml").imu == expected
    (tmp_path / "imu.yaml").write_text("imu0:\n  " + IMU.replace("\n", "\n  "))
    assert read_kalibr(chain).imu == expected
    (tmp_path / "imu.yaml").unlink()
    fallback = ImuNoise(rate_hz=1.0)
    assert read_kalibr(chain, fallback=fallback).imu == fallback


def test_euroc_rig_with_an_offset_imu(tmp_path: Path) -> None:
    """The body frame is that of the IMU, wherever the platform's frame is."""
    mav0 = write_euroc(tmp_path) / "mav0"
    plain = read_euroc_rig(mav0, ["cam0", "cam1"])
    assert plain.cameras[1].body_T_camera.translation().tolist() == [0.1, 0.1, 0.0]
    assert plain.imu.accel_noise_density == 2e-3
    edit_text(
        mav0 / "imu0" / "sensor.yaml",
        "[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0,",
        "[0.0, -1.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.1,",
    )
    moved = read_euroc_rig(mav0, ["cam0", "cam1"])
    platform_T_imu = gtsam.Pose3(gtsam.Rot3.Rz(np.pi / 2), np.array([0.3, 0.2, 0.1]))
    for a, b in zip(plain.cameras, moved.cameras, strict=True):
        assert platform_T_imu.compose(b.body_T_camera).equals(a.body_T_camera, 1e-12)


@pytest.mark.parametrize(
    ("old", "new", "line", "what"),
    [
        ("distortion_model: equidistant", "distortion_model: fov", 10, "distortion model 'fov'"),
        ("camera_model: pinhole", "camera_model: eucm", 8, "unknown camera model 'eucm'"),
        ("- [0.0, 1.0, 0.0, 0.5]", "- [0.0, 1.1, 0.0, 0.5]", 3, "not a rotation"),
        ("- [0.0, 1.0, 0.0, 0.5]", "- [0.0, -1.0, 0.0, 0.5]", 3, "not a rotation"),
        ("  - [0.0, 1.0, 0.0, 0.5]\n", "", 3, "expected a 4x4 matrix"),
        ("T_cam_imu", "T_imu_cam", 2, "missing key 'T_cam_imu'"),
        ("  intrinsics: [380.5, 380.25, 510.0, 514.0]\n", "", 2, "missing key 'intrinsics'"),
        ("[380.5, 380.25, 510.0, 514.0]", "[380.5, 510.0, 514.0]", 11, "expected 4 numbers, got 3"),
        ("[380.5, 380.25, 510.0, 514.0]", "[-1, 380.25, 510.0, 514.0]", 11, "must be positive"),
        ("[380.5, 380.25, 510.0, 514.0]", "[.nan, 380.25, 510.0, 514.0]", 11, "not a number"),
        ("-0.03, 0.004]", "-0.03]", 9, "expected 4 numbers, got 3"),
        ("[380.5, 380.25, 510.0, 514.0]", "[1e-320, 380.25, 510.0, 514.0]", 11, "no lens has"),
        ("[380.5, 380.25, 510.0, 514.0]", "[380.5, 380.25, -1e308, 514.0]", 11, "no lens has"),
        ("-0.03, 0.004]", "-0.03, 4294967296]", 11, "no lens has"),
        ("0.0, 0.5]", "0.0, 1e200]", 3, "a translation of more than"),
        ("[1024, 1020]", "large", 12, "expected a list"),
        ("[1024, 1020]", "[1024.5, 1020]", 12, "two whole numbers"),
        ("[1024, 1020]", "[0, 1020]", 12, "two whole numbers"),
        ("[1024, 1020]", "[1024, 1e300]", 12, "two whole numbers"),
        ("-1.5e-3", "early", 14, "'early' is not a number"),
        ("cam_overlaps: [1]", "cam_overlaps: [1", 8, "not valid YAML"),
    ],
)
def test_faults_name_file_and_line(chain: Path, old: str, new: str, line: int, what: str) -> None:
    edit_text(chain, old, new)
    with pytest.raises(DataError) as error:
        read_kalibr(chain)
    message = str(error.value)
    assert f"{chain.name}:{line}: " in message
    assert what in message
    assert "\n" not in message


@pytest.mark.parametrize("value", ["0", "-1e-3", "1e200", "1e-200"])
@pytest.mark.parametrize("key", [line.partition(":")[0] for line in IMU.splitlines()[1:]])
def test_noise_and_rate_are_above_zero(chain: Path, tmp_path: Path, key: str, value: str) -> None:
    lines = [f"{key}: {value}" if line.startswith(key) else line for line in IMU.splitlines()]
    (tmp_path / "imu.yaml").write_text("\n".join(lines))
    with pytest.raises(DataError, match=rf"imu\.yaml:\d: {key}: '{value}' is not a usable number"):
        read_kalibr(chain)


def test_the_number_of_a_camera_has_few_digits(chain: Path) -> None:
    chain.write_text(f"? cam{'1' * 5000}\n: {{camera_model: pinhole}}\n")
    with pytest.raises(DataError, match="no camera"):
        read_kalibr(chain)


@pytest.mark.parametrize("content", ["", "- 1\n- 2\n", "text", "key: value\n"])
def test_not_a_calibration(tmp_path: Path, content: str) -> None:
    (tmp_path / "file.yaml").write_text(content)
    with pytest.raises(DataError, match=r"file\.yaml"):
        read_kalibr(tmp_path / "file.yaml")


def test_missing_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.yaml: calibration cannot be read"):
        read_yaml(tmp_path / "none.yaml")
    (tmp_path / "image.yaml").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(DataError, match=r"image\.yaml"):
        read_yaml(tmp_path / "image.yaml")


@pytest.mark.data
def test_real_calibration(data_dir: Path, tmp_path: Path) -> None:
    rig = read_euroc_rig(data_dir / "euroc" / "MH_01_easy_17s" / "mav0", ["cam0", "cam1"])
    baseline = rig.cameras[0].body_T_camera.between(rig.cameras[1].body_T_camera).translation()
    assert abs(np.linalg.norm(baseline) - 0.11) < 1e-3
    write_kalibr(rig, tmp_path / "calibration.yaml")
    assert same(read_kalibr(tmp_path / "calibration.yaml"), rig)


@pytest.mark.parametrize(
    ("line", "rolling"),
    [
        ("rolling_shutter: true", True),
        ("shutter: rolling", True),
        ("shutter_type: Rolling Shutter", True),
        ("line_delay: 3.0e-05", True),
        ("readout_time: 0.016", True),
        ("rolling_shutter: false", False),
        ("shutter: global", False),
        ("line_delay: 0.0", False),
        ("timeshift_cam_imu: 0.0", False),
    ],
)
def test_a_rolling_shutter_is_recognised_and_warned_of(
    tmp_path: Path, line: str, rolling: bool
) -> None:
    path = write_euroc(tmp_path / "flight", cameras=1)
    edit_text(path / "mav0" / "cam0" / "sensor.yaml", "rate_hz: 20", f"rate_hz: 20\n{line}")
    sequence = open_dataset(path)
    assert sequence.rig.cameras[0].rolling_shutter is rolling
    warned = rolling and sequence.rig.cameras[0].readout_s == 0.0
    assert sequence.diagnostics.counts == ({"rolling_shutter": 1} if warned else {})
    write_kalibr(sequence.rig, tmp_path / "chain.yaml")
    again = open_dataset(path, calibration=tmp_path / "chain.yaml")
    assert again.rig.cameras[0].rolling_shutter is rolling
    assert again.rig.cameras[0].readout_s == sequence.rig.cameras[0].readout_s
