# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Small valid files, damaged in many ways: each gives one line of ours, or is read."""

import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path
from textwrap import indent

import cv2
import numpy as np
import pytest
from damage import tried
from groups import slow
from map_flights import World
from pose_graphs import laps
from recordings import (
    CAMERA_YAML,
    FRAME_PERIOD_NS,
    IMU_YAML,
    SIZE,
    START_NS,
    write_euroc,
    write_groundtruth,
    write_openvins,
)
from recordings_loose import CHAIN, write_flight_video, write_image_folder, write_video
from recordings_public import as_tum_vi, write_kitti_odometry, write_kitti_raw, write_tum_rgbd
from recordings_ros import BagWriter, write_bag
from sound import (
    sound_aiding,
    sound_dataset,
    sound_graph,
    sound_map,
    sound_problem,
    sound_rig,
    sound_table,
    sound_trajectory,
)

from slam_graph.bundle_adjustment.bal_file import read_bal
from slam_graph.config import load_config
from slam_graph.datasets import TrackRecorder
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, write_kalibr
from slam_graph.datasets.formats.eqvio import wheel_tracks
from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.datasets.streams.aiding_files import read_aiding
from slam_graph.datasets.streams.mask_images import LARGEST_LABEL, MaskFolder
from slam_graph.datasets.streams.object_truth import read_object_truth
from slam_graph.diagnostics import Diagnostics
from slam_graph.frontend.extraction import camera_mask
from slam_graph.pose_graph.graph_files import g2o_lines, read_pose_graph
from slam_graph.results.map_output import load_map, save_map
from slam_graph.sensors import FeatureFrame
from slam_graph.simulation.simulator import simulate

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet", "half"),
]


def shorten(path: Path, lines: int) -> None:
    """Keep the first lines of a file."""
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:lines]))


TRUTH = "state_groundtruth_estimate0"


@pytest.mark.parametrize(
    "name",
    [
        *(
            f"{folder}/{file}"
            for folder in ("cam0", "imu0")
            for file in ("data.csv", "sensor.yaml")
        ),
        *(slow("depth0/data.csv"), "depth0/sensor.yaml", f"{TRUTH}/data.csv"),
        slow(f"{TRUTH}/sensor.yaml"),
    ],
)
def test_euroc(tmp_path: Path, name: str) -> None:
    root = write_euroc(tmp_path / "flight", frames=3, cameras=1, imu_lead=4)
    if name.startswith("depth0"):
        with_depth(root / "mav0")
    if name.startswith(TRUTH):
        write_groundtruth(root / "mav0", 16, 8)
        tracked = CAMERA_YAML.format(y=0.1) if name.endswith("yaml") else IMU_YAML
        (root / "mav0" / TRUTH / "sensor.yaml").write_text(tracked)
    tried(root / "mav0" / name, lambda: sound_dataset(root))


def with_depth(mav0: Path) -> None:
    """Depth images, registered by the reader."""
    (mav0 / "depth0" / "data").mkdir(parents=True)
    lens = CAMERA_YAML.format(y=0.1).partition("resolution")
    keys = "camera: 0\nscale: 1000\nrange_m: [0.3, 8]\nnoise: [0.002, 0.003]\n"
    mounting = "T_cam_depth: [[1, 0, 0, 0.02], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    (mav0 / "depth0" / "sensor.yaml").write_text(keys + mounting + "".join(lens[1:]))
    shutil.copy(mav0 / "cam0" / "data.csv", mav0 / "depth0" / "data.csv")
    for image in (mav0 / "cam0" / "data").iterdir():
        raw = np.full(SIZE[::-1], 2000, np.uint16)
        assert cv2.imwrite(str(mav0 / "depth0" / "data" / image.name), raw)


@pytest.mark.parametrize("name", ["camchain.yaml", "imu_config.yaml"])
def test_tum_vi(tmp_path: Path, name: str) -> None:
    root = as_tum_vi(write_euroc(tmp_path / "flight", frames=2, cameras=1, imu_lead=4))
    tried(root / "dso" / name, lambda: sound_dataset(root))


def test_kalibr(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    write_kalibr(simulate(duration_s=1.0).rig, path)
    tried(path, lambda: sound_rig(read_kalibr(path)))


CAMCHAIN = """cam0:
  T_cam_imu: unknown
  cam_overlaps: [1]
  camera_model: omni
  intrinsics: [1.2, 400, 401, 320, 240]
  distortion_coeffs: [-0.1, 0.02, 1e-4, 2e-4]
  distortion_model: radtan
  resolution: [640, 480]
  rostopic: /cam0/image_raw
  line_delay: 2.1e-5
  stamped_row: middle
cam1:
  T_cn_cnm1: [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: ds
  intrinsics: [-0.2, 0.55, 300, 301, 320, 240]
  distortion_coeffs: []
  distortion_model: none
  resolution: [640, 480]
  timeshift_cam_imu: 0.01
cam2:
  T_cn_cnm1: [[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [300, 301, 320, 240]
  distortion_coeffs: [-0.01, 0.02, -0.003, 0.001]
  distortion_model: equidistant
  resolution: [640, 480]
  shutter: rolling
depth0:
  {camera: 2, scale: 5000, range_m: [0.5, 6], noise: [0.002, 0.003]}
"""


@pytest.mark.parametrize("name", ["camchain.yaml", "imu.yaml"])
def test_kalibr_with_lenses_of_all_kinds(tmp_path: Path, name: str) -> None:
    (tmp_path / "camchain.yaml").write_text(CAMCHAIN)
    (tmp_path / "imu.yaml").write_text("imu0:\n" + indent(IMU_YAML, "  "))
    tried(tmp_path / name, lambda: sound_rig(read_kalibr(tmp_path / "camchain.yaml")))


@pytest.mark.parametrize("dimension", [2, 3])
def test_g2o(tmp_path: Path, dimension: int) -> None:
    path = tmp_path / "graph.g2o"
    graph, truth = laps(dimension, 0.01, poses=12, lap=5)
    path.write_text("".join(g2o_lines(graph, truth)))
    tried(path, lambda: sound_graph(read_pose_graph(path)))


TORO = (
    "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0.1\nVERTEX2 2 2 0 0.2\n"
    "EDGE2 0 1 1 0 0.1 100 0 100 400 0 0\nEDGE2 1 2 1 0 0.1 100 0 100 400 0 0\n"
    "EDGE2 0 2 2 0 0.2 100 0 100 400 0 0\n"
)
TORO_3D = (
    "VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 1 0 0.1 0 0.1 0.2\nVERTEX3 2 2 0 0.2 0 0 0.3\n"
    "EDGE3 0 1 1 0 0.1 0 0.1 0.2 9 0 0 0 0 0 9 0 0 0 0 9 0 0 0 9 0 0 9 0 9\n"
    "EDGE3 1 2 1 0 0.1 0 -0.1 0.1 9 0 0 0 0 0 9 0 0 0 0 9 0 0 0 9 0 0 9 0 9\n"
    "EDGE3 0 2 2 0 0.2 0 0 0.3 9 0 0 0 0 0 9 0 0 0 0 9 0 0 0 9 0 0 9 0 9\n"
)


@pytest.mark.parametrize("text", [TORO, TORO_3D], ids=["2D", "3D"])
def test_toro(tmp_path: Path, text: str) -> None:
    path = tmp_path / "graph.graph"
    path.write_text(text)
    tried(path, lambda: sound_graph(read_pose_graph(path)))


def test_bal(tmp_path: Path) -> None:
    path = tmp_path / "problem.txt"
    path.write_text(
        "2 2 4\n0 0 10 20\n0 1 -10 20\n1 0 12 20\n1 1 -12 20\n"
        "0 0 0 0 0 0 500 0 0\n0 0 0 1 0 0 500 0 0\n0 0 -10\n1 1 -10\n"
    )
    tried(path, lambda: sound_problem(read_bal(path)))


@pytest.mark.parametrize("separator", [" ", ","])
def test_trajectories(tmp_path: Path, separator: str) -> None:
    path = tmp_path / "truth.txt"
    unit = "" if separator == " " else "000000000"
    rows = ([f"{1403636580 + k}{unit}", k, 0.5, -1e-3, 0, 0, 0, 1] for k in range(8))
    path.write_text("".join(separator.join(map(str, row)) + "\n" for row in rows))
    tried(path, lambda: sound_trajectory(read_groundtruth(path)))


@pytest.fixture(scope="module")
def tracks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tracks") / "flight"
    simulate(duration_s=0.6, rate_hz=5.0, cameras=1).save(path)
    return path


@pytest.mark.parametrize(
    "name",
    ["meta.yaml", "frames.bin", "features.bin", "imu.bin", "groundtruth.npz", "initial_state.npz"],
)
def test_recordings(tracks: Path, tmp_path: Path, name: str) -> None:
    folder = shutil.copytree(tracks, tmp_path / "flight")
    tried(folder / name, lambda: sound_dataset(folder))


@pytest.mark.parametrize("name", ["labels.bin", "moving.bin", "moving_frames.bin"])
def test_recordings_of_objects(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "flight"
    flight = simulate(duration_s=0.6, rate_hz=5.0, cameras=1, objects={"count": 1, "masks": True})
    with TrackRecorder(folder, flight.rig) as recorder:
        for packet in flight.packets():
            assert isinstance(packet.frame, FeatureFrame)
            recorder.write(packet.imu, replace(packet.frame, moving=packet.frame.cameras))
    tried(folder / name, lambda: sound_dataset(folder))


@pytest.mark.parametrize(
    "name", ["calib.yaml", "tracks.csv", "imu.csv", "groundtruth.csv", "init_state.csv"]
)
def test_openvins(tmp_path: Path, name: str) -> None:
    folder = write_openvins(tmp_path / "flight", frames=3, features=4, cameras=1)
    shorten(folder / "imu.csv", 70)
    tried(folder / name, lambda: sound_dataset(folder))


def test_eqvio(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    with wheel_tracks().open(encoding="utf-8") as whole:
        path.write_text("".join(islice(whole, 120)), encoding="utf-8")
    tried(path, lambda: sound_dataset(path))


@pytest.mark.parametrize("name", [slow("rgb.txt"), "depth.txt"])
def test_tum_rgbd(tmp_path: Path, name: str) -> None:
    folder = write_tum_rgbd(tmp_path / "flight_freiburg1", frames=3, size=SIZE)
    chain = tmp_path / "chain.yaml"
    chain.write_text(CHAIN)
    tried(folder / name, lambda: sound_dataset(folder, calibration=chain))


@pytest.mark.parametrize(
    "name",
    [
        *("calib_cam_to_cam.txt", slow("calib_imu_to_velo.txt"), slow("calib_velo_to_cam.txt")),
        *("timestamps.txt", "0000000001.txt"),
    ],
)
def test_kitti(tmp_path: Path, name: str) -> None:
    folder = write_kitti_raw(tmp_path / "2011_09_26", frames=2)
    file = next(iter(sorted((tmp_path / "2011_09_26").rglob(name))))
    tried(file, lambda: sound_dataset(folder))


@pytest.mark.parametrize("name", ["calib.txt", "times.txt", "03.txt"])
def test_kitti_odometry(tmp_path: Path, name: str) -> None:
    folder = write_kitti_odometry(tmp_path, frames=3)
    tried(next(tmp_path.rglob(name)), lambda: sound_dataset(folder))


@pytest.mark.parametrize("name", ["timestamps.csv", "imu.csv", "calibration.yaml"])
def test_image_folder(tmp_path: Path, name: str) -> None:
    folder = write_image_folder(tmp_path / "flight", count=3)
    shorten(folder / "imu.csv", 50)
    tried(folder / name, lambda: sound_dataset(folder))


def test_masks(tmp_path: Path) -> None:
    path = tmp_path / "mask.png"
    camera = simulate(duration_s=1.0).rig.cameras[0].camera
    drawn = np.zeros((camera.height, camera.width), np.uint8)
    drawn[10:400, 30:500] = 255
    assert cv2.imwrite(str(path), drawn)
    tried(path, lambda: camera_mask(camera, path, 21))


@pytest.mark.parametrize("name", ["boxes.csv", "classes.csv", "100.png"])
def test_masks_of_objects(tmp_path: Path, name: str) -> None:
    drawn = np.zeros((40, 60), np.uint16)
    drawn[10:30, 20:40] = 7
    assert cv2.imwrite(str(tmp_path / "100.png"), drawn)
    boxes = "#stamp,label,l,t,r,b\n20000000,3,20,10,39,29\n30000000,300,1.5,-10,3,9\n"
    (tmp_path / "boxes.csv").write_text(boxes)
    (tmp_path / "classes.csv").write_text("7,car\n3,person on a bike\n")

    def read() -> None:
        masks = MaskFolder(tmp_path)
        assert len(masks) > 0
        assert set(masks.classes) <= set(range(LARGEST_LABEL + 1))
        for stamp_ns in (100, 20_000_000, 30_000_000):
            drawn = masks.image(stamp_ns, (60, 40))
            assert drawn is None or (drawn.shape, drawn.dtype) == ((40, 60), np.uint16)

    tried(tmp_path / name, read)


def test_true_poses_of_objects(tmp_path: Path) -> None:
    path = tmp_path / "objects_truth.csv"
    rows = (f"{k},{1 + k % 2},{k},0.5,-1e-3,0,0,0.6,0.8\n" for k in range(1, 8))
    path.write_text("#timestamp_ns,object,x_m,y_m,z_m,qx,qy,qz,qw\n" + "".join(rows))

    def read() -> None:
        for pose in read_object_truth(path).values():
            sound_trajectory(pose)

    tried(path, read)


@pytest.fixture(scope="module")
def aiding(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with position fixes, known poses and odometry."""
    root = tmp_path_factory.mktemp("aiding") / "flight"
    with_aiding = {
        "gnss": {"sigma_m": 1.0, "rate_hz": 5.0},
        "known_poses": {"rotation_sigma_rad": 0.1},
        "odometry": {"enabled": True},
    }
    simulate(kind="images", duration_s=0.5, rate_hz=4.0, cameras=1, **with_aiding).save(root)
    return root


def read_all_aiding(folder: Path) -> None:
    """Position fixes, known poses and odometry in the files of a folder."""
    sound_aiding(read_aiding([folder], {}, Diagnostics()))


GEODETIC = (
    "#timestamp [ns],latitude [deg],longitude [deg],altitude [m],sigma_east [m],sigma_north [m],"
    "sigma_up [m]\n# datum: 48.1, 11.5, 500\n"
    + "".join(f"{START_NS + k * 10**7},48.10{k},11.50{k},52{k}.5,1,1.5,2\n" for k in range(4))
)
NMEA = "".join(
    f"{START_NS + k * 10**7},$GPGGA,12351{k},4807.03{k},N,01131.000,E,4,08,0.9,545.4,M,46.9,M,,\n"
    for k in range(4)
)


@pytest.mark.parametrize("text", [GEODETIC, NMEA], ids=["geodetic", "nmea"])
def test_position_fixes(tmp_path: Path, text: str) -> None:
    (tmp_path / "gnss.csv").write_text(text)
    diagnostics = Diagnostics()
    assert len(read_aiding([tmp_path], {}, diagnostics).fix_stamps_ns) == 4
    assert not diagnostics.counts
    tried(tmp_path / "gnss.csv", lambda: read_all_aiding(tmp_path))


@pytest.mark.parametrize("name", ["gnss.csv", "odometry.csv", "poses.csv"])
def test_aiding(aiding: Path, tmp_path: Path, name: str) -> None:
    file = shutil.copy(next(aiding.rglob(name)), tmp_path / name)
    assert len(read_aiding([tmp_path], {}, Diagnostics()))
    tried(file, lambda: read_all_aiding(tmp_path))


def test_maps(tmp_path: Path) -> None:
    path = tmp_path / "a.slam"
    save_map(World().map(), path)
    tried(path, lambda: sound_map(load_map(path)))


def test_configurations(tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    path.write_text(
        "algorithm: msckf\nseed: 1\nstart_s: 0.5\nduration_s: null\ncameras: stereo\n"
        "backend:\n  noise: {pixel_sigma: 1.5, gravity: 9.81}\nfrontend:\n  max_features: 100\n"
    )
    tried(path, lambda: sound_table(load_config(path).model_dump(mode="json")))


def everything(bag: BagWriter) -> None:
    """Depth, position fixes, known poses and odometry, besides what a bag has anyway."""
    for stamp_ns in (START_NS, START_NS + FRAME_PERIOD_NS):
        metres = np.full((12, 16), 1500, np.uint16)
        place, turn = [0.1, 0.2, 0.3], [0.0, 0.0, 0.6, 0.8]
        messages = {
            "/depth": bag.image(stamp_ns, metres, "16UC1"),
            "/fix": bag.fix(stamp_ns, [48.1, 11.5, 520.0]),
            "/pose": bag.known_pose(stamp_ns, place, turn, 0.01 * np.eye(6)),
            "/odometry": bag.odometry(stamp_ns, place, turn),
        }
        for topic, message in messages.items():
            bag.write(topic, message, stamp_ns)


SMALL = {"frames": 2, "size": (16, 12), "imu_lead": 3}
"""Bags of 10 to 20 kB, of which the pixels are a small part."""

NAMED = {"groundtruth": "/truth", "poses": "/pose", "odometry": "/odometry"}


@pytest.mark.parametrize(
    ("kind", "packed"),
    [
        *(("ros1", packed) for packed in ("", "bz2", "lz4")),
        *(("mcap_file", packed) for packed in ("", "storage")),
        ("sqlite", ""),
    ],
)
def test_bags(tmp_path: Path, kind: str, packed: str) -> None:
    path = write_bag(tmp_path, kind, extra=everything, packed=packed, **SMALL)
    file = path if path.is_file() else next(path.glob("*.db3"))
    tried(file, lambda: sound_dataset(file, sources=NAMED))


@pytest.mark.parametrize("packed", ["file", "message"])
def test_bags_packed_by_zstd(tmp_path: Path, packed: str) -> None:
    path = write_bag(tmp_path, "sqlite", cameras=1, packed=packed, **SMALL)
    tried(next(path.glob("*.db3*")), lambda: sound_dataset(path))


def test_metadata_of_bags(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", cameras=1, **SMALL)
    tried(path / "metadata.yaml", lambda: sound_dataset(path))


SHADES = [np.full((48, 64), shade, np.uint8) for shade in (40, 90, 160)]
"""Pictures that take few bytes in a video."""


@pytest.mark.parametrize(
    ("name", "codec"),
    [("flight.mkv", "FFV1"), ("flight.avi", "MJPG"), slow("flight.mp4", "mp4v")],
)
def test_videos(tmp_path: Path, name: str, codec: str) -> None:
    path = write_video(tmp_path, name, codec, SHADES)
    tried(path, lambda: sound_dataset(path))


@pytest.mark.parametrize("name", ["flight.csv", slow("flight.imu.csv"), "flight.yaml"])
def test_what_lies_beside_a_video(tmp_path: Path, name: str) -> None:
    path = write_flight_video(tmp_path, SHADES)
    shorten(path.with_suffix(".imu.csv"), 50)
    tried(tmp_path / name, lambda: sound_dataset(path))
