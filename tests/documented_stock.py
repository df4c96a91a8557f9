# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Short recordings, maps and graphs under the names that the documents use.

The folder of EuRoC's MH_01 is cut out of the real recording if there is one, else it is simulated.
Each thing is made once, when a page first needs it.
"""

import bz2
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import gtsam
import numpy as np
from documented import blocks
from pose_graphs import laps, with_false_loops
from recordings import write_lines
from recordings_public import as_tum_vi, write_kitti_odometry, write_kitti_raw, write_tum_rgbd
from recordings_ros import bag_writer, write_calibration_of

import slam_graph as sg
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.formats.eqvio import wheel_tracks
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.pose_graph import PoseGraph, optimize_pose_graph
from slam_graph.sensors import Camera, CameraFrame, ImuNoise, Rig, RigCamera

TRACKS_S = 3.0
"""Length of recordings of tracks, and of `demo`: it starts after one second."""

_IMAGES_S = (7.6, 10.8)
"""The part of MH_01 that is used: the rig moves by 0.9 m after its start."""

_EVERY = 2
"""Of MH_01 every second frame is used: 10 in a second."""

_VIDEO = (1920, 1080)
"""Size of the video, that of `phone.yaml`."""

_ALIASES = (
    ("/imu0", "/left/image_raw", "/right/image_raw"),
    (
        "/camera/camera/imu",
        "/camera/camera/infra1/image_rect_raw",
        "/camera/camera/infra2/image_rect_raw",
    ),
    ("/oak/imu/data", "/oak/left/image_raw", "/oak/right/image_raw"),
    (
        "/zed/zed_node/imu/data_raw",
        "/zed/zed_node/left_gray/image_rect_gray",
        "/zed/zed_node/right_gray/image_rect_gray",
    ),
)
"""Topics of IMU and images in `flight/`: one recording under the names of several drivers."""

_RECTIFIED = _ALIASES[1][1:]
"""Rectified topics that are read without a Kalibr file; the ZED is run with that of MH_01."""


class Stock:
    """Makes what pages take for granted.

    Args:
        root: where it is kept.
        data: folder of real recordings, if there is one.
    """

    def __init__(self, root: Path, data: Path | None) -> None:
        self._root, self._data = root, data
        self._makers: dict[str, Callable[[Path], object]] = {
            "demo.csv": self._demo,
            "path/to/MH_01_easy": self._mh01,
            "path/to/MH_02_easy": lambda to: shutil.copytree(self("path/to/MH_01_easy"), to),
            "path/to/V1_01_easy": self._v1_01,
            "path/to/V2_01_easy": self._v2_01,
            "path/to/dataset-room1_512_16": self._tum_vi,
            "path/to/2011_09_26": write_kitti_raw,
            "path/to/dataset": lambda to: write_kitti_odometry(to, number="00"),
            "path/to/rgbd_dataset_freiburg1_xyz": partial(write_tum_rgbd, frames=15),
            "path/to/recordings": self._recordings,
            "monday": self._tracks,
            "tuesday": self._tracks,
            "monday.slam": self._map,
            "tuesday.slam": self._map,
            "flight.bag": lambda to: self._bag(to, "ros1"),
            "flight.mcap": self._mcap,
            "flight/": lambda to: self._bag(to, "sqlite"),
            "calibration_ros2/": lambda to: shutil.copytree(self("flight/"), to),
            "camchain-imucam.yaml": self._chain,
            "chain.yaml": self._phone_chain,
            "walk.mp4": self._video,
            "frames.csv": self._frame_times,
            "walk_timestamps.csv": self._frame_times,
            "imu.csv": self._imu_table,
            "walk.csv": self._frame_times,
            "walk.tum": lambda to: self._walk().groundtruth().save(to),
            "walk_gyro.csv": lambda to: self._of_phone(to, slice(0, 3)),
            "walk_accel.csv": lambda to: self._of_phone(to, slice(3, 6)),
            "images/": self._folder_of_images,
            "sphere2500.g2o": lambda to: _write_graph(to, laps(3, 0.01)[0]),
            "graph.g2o": lambda to: _write_graph(to, laps(3, 0.01)[0]),
            "M3500.g2o": lambda to: _write_graph(to, with_false_loops(laps(2, 0.01)[0], 5)),
            "problem.txt": _bundle,
            "problem-16-22106-pre.txt.bz2": _bundle,
            "kmsckf.yaml": lambda to: _of_page(to, "docs/algorithms.md", 0),
            "my_algorithm.yaml": lambda to: _of_page(to, "docs/algorithms.md", 0),
            "list.yaml": lambda to: _of_page(to, "docs/batch.md", 0),
            "phone.yaml": lambda to: _of_page(to, "docs/own_data.md", -1),
            "hall/MH_01_easy": lambda to: shutil.copytree(self("path/to/MH_01_easy"), to),
        }

    def __call__(self, name: str) -> Path:
        """The path of something, which is made if it is not there yet."""
        path = self._root / name.rstrip("/")
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._makers[name](path)
        return path

    def fill(self, folder: Path, commands: str) -> None:
        """Link to everything that commands name and do not simulate themselves."""
        if _is_named("list.yaml", commands):
            commands += self("list.yaml").read_text(encoding="utf-8")
        for name in self._makers:
            if _is_named(name, commands) and f"simulate {name} " not in commands:
                link = folder / name.rstrip("/")
                link.parent.mkdir(parents=True, exist_ok=True)
                if not link.exists():
                    link.symlink_to(self(name))

    def names(self, page: str) -> dict[str, object]:
        """What the blocks of Python of a page take as defined."""
        return self._arrays() if page == "docs/datasets.md" else {}

    def _arrays(self) -> dict[str, object]:
        """IMU, images and tracks of the camera of the page, which looks ahead."""
        camera = Camera(458.0, 457.0, 367.0, 248.0, "radtan", (-0.28, 0.07, 0.0, 0.0), 752, 480)
        pose = gtsam.Pose3(gtsam.Rot3.Ypr(-np.pi / 2, 0.0, -np.pi / 2), np.zeros(3))
        chain = self._root / "page.yaml"
        write_kalibr(Rig((RigCamera(camera, pose),), ImuNoise(rate_hz=200.0)), chain)
        packets = list(sg.simulate(calibration=chain, duration_s=TRACKS_S).packets())
        frames = [packet.frame for packet in packets]
        seen = [frame.cameras[0] for frame in frames]
        stamps_ns = np.array([frame.stamp_ns for frame in frames])
        return {
            "imu_stamps_ns": np.concatenate([packet.imu.stamps_ns for packet in packets]),
            "gyro": np.concatenate([packet.imu.gyro for packet in packets]),
            "accel": np.concatenate([packet.imu.accel for packet in packets]),
            "image_stamps_ns": stamps_ns[:2],
            "left_images": [np.zeros((480, 752), np.uint8)] * 2,
            "tracks": [(t, s.ids, s.pixels) for t, s in zip(stamps_ns.tolist(), seen, strict=True)],
        }

    def _demo(self, to: Path) -> None:
        """The first seconds of `demo`, under its name in a folder."""
        to.mkdir()
        with wheel_tracks().open() as whole, (to / wheel_tracks().name).open("w") as part:
            part.write(next(whole))
            for row in whole:
                time = row.split(",")[2]
                if not time or float(time) <= TRACKS_S:
                    part.write(row)

    def _mh01(self, to: Path) -> None:
        real = self._data and self._data / "euroc" / "MH_01_easy_17s" / "mav0"
        if real:
            _cut(real, to / "mav0")
        else:
            overrides = ["rate_hz=10", f"duration_s={TRACKS_S}", "kind=images"]
            sg.simulate(trajectory="rooms", overrides=overrides).save(to)

    def _v2_01(self, to: Path) -> None:
        real = self._data and self._data / "euroc_inertial" / "V2_01_easy"
        to.symlink_to(real or self._simulated_images())

    def _v1_01(self, to: Path) -> None:
        """A truth for `demo`; without EuRoC it is what was estimated."""
        real = self._data and self._data / "euroc_inertial" / "V1_01_easy"
        if real:
            to.symlink_to(real)
            return
        truth = to / "mav0" / "state_groundtruth_estimate0" / "data.csv"
        truth.parent.mkdir(parents=True)
        (to / "mav0" / "imu0").mkdir()
        sg.run(self("demo.csv") / wheel_tracks().name).trajectory.save(truth)

    def _simulated_images(self) -> Path:
        path = self._root / "simulated_images"
        if not path.exists():
            overrides = ["rate_hz=10", f"duration_s={TRACKS_S}", "kind=images"]
            sg.simulate(trajectory="rooms", overrides=overrides).save(path)
        return path

    def _tum_vi(self, to: Path) -> None:
        shutil.copytree(self("path/to/MH_01_easy"), to)
        as_tum_vi(to)

    def _recordings(self, to: Path) -> None:
        to.mkdir()
        for name in ("MH_01_easy", "MH_02_easy"):
            self._tracks(to / name, int(name[4]), TRACKS_S / 3)

    def _tracks(self, to: Path, seed: int = 0, duration_s: float = TRACKS_S) -> None:
        overrides = ["tracks.descriptors=true", "world_seed=7", f"seed={seed}"]
        sg.simulate(trajectory="rooms", duration_s=duration_s, overrides=overrides).save(to)

    def _map(self, to: Path) -> None:
        """Of one of two flights through the place of `monday`."""
        seed = 3 if to.stem == "monday" else 4
        flight = to.with_suffix("")
        flight = flight.with_name(f"{flight.name}_mapped")
        self._tracks(flight, seed, 5.0)
        made = sg.run(flight, map={"enabled": True}, final_ba={"enabled": False}).slam_map
        assert made is not None
        sg.save_map(made, to)

    def _bag(self, to: Path, kind: str) -> None:
        """MH_01 as a bag that carries its calibration and its truth."""
        data = sg.open_dataset(self("path/to/MH_01_easy"))
        truth = data.groundtruth()
        aliases = (
            _ALIASES if kind == "sqlite" else (("/imu0", *map("/cam{}/image_raw".format, (0, 1))),)
        )
        with bag_writer(to, kind) as bag:
            for _, *images in aliases:
                write_calibration_of(
                    bag, data.rig, [Path(topic).parent.as_posix() for topic in images]
                )
            for packet in data.packets():
                assert isinstance(packet.frame, CameraFrame)
                imu, now = packet.imu, packet.frame.stamp_ns
                for imu_topic, *topics in aliases:
                    for k, stamp_ns in enumerate(imu.stamps_ns.tolist()):
                        bag.write(imu_topic, bag.imu(stamp_ns, imu.gyro[k], imu.accel[k]), stamp_ns)
                    for c, topic in enumerate(topics):
                        if (image := packet.frame.images[c]) is not None:
                            camera = data.rig.cameras[c].camera
                            taken = _rectified(image, camera) if topic in _RECTIFIED else image
                            message = bag.image(now, taken, "mono8", f"cam{c}")
                            bag.write(topic, message, now)
                if kind == "mcap" and truth.stamps_ns[0] <= now <= truth.stamps_ns[-1]:
                    pose = truth.at(now)
                    q = pose.rotation().toQuaternion().coeffs()
                    moved = bag.transform(now, "world", "imu", pose.translation(), q)
                    bag.write("/vicon/pose", moved, now)

    def _mcap(self, to: Path) -> None:
        folder = to.with_name("mcap_bag")
        self._bag(folder, "mcap")
        to.symlink_to(next(folder.glob("*.mcap")))

    def _chain(self, to: Path) -> None:
        write_kalibr(sg.open_dataset(self("path/to/MH_01_easy")).rig, to)

    def _walk(self) -> RecordedSequence:
        """The left camera of MH_01."""
        return sg.open_dataset(self("path/to/MH_01_easy"), cameras=1)

    def _phone_chain(self, to: Path) -> None:
        """The calibration of `walk.mp4`."""
        rig = self._walk().rig
        (mounted,) = rig.cameras
        c = mounted.camera
        x, y = np.array(_VIDEO) / (c.width, c.height)
        numbers = (c.fx * x, c.fy * y, (c.cx + 0.5) * x - 0.5, (c.cy + 0.5) * y - 0.5)
        camera = Camera(*numbers, c.distortion, c.coefficients, *_VIDEO)
        write_kalibr(replace(rig, cameras=(replace(mounted, camera=camera),)), to)

    def _walk_frames(self) -> Iterator[tuple[int, np.ndarray]]:
        """Stamps and images, in the size of a phone's."""
        for packet in self._walk().packets():
            assert isinstance(packet.frame, CameraFrame)
            (image,) = packet.frame.images
            assert image is not None
            yield packet.frame.stamp_ns, cv2.resize(image, _VIDEO, interpolation=cv2.INTER_CUBIC)

    def _video(self, to: Path) -> None:
        fourcc = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(to), cv2.CAP_FFMPEG, fourcc, 10.0, _VIDEO)
        assert writer.isOpened()
        for _, image in self._walk_frames():
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        writer.release()

    def _folder_of_images(self, to: Path) -> None:
        to.mkdir()
        for k, (_, image) in zip(range(3), self._walk_frames(), strict=False):
            cv2.imwrite(str(to / f"frame{k}.png"), image)

    def _frame_times(self, to: Path) -> None:
        write_lines(to, ["#time", *(str(stamp_ns) for stamp_ns, _ in self._walk_frames())])

    def _imu_rows(self) -> Iterator[tuple[int, list[float]]]:
        for block in self._walk().imu_blocks():
            values = np.hstack([block.gyro, block.accel])
            yield from zip(block.stamps_ns.tolist(), values.tolist(), strict=True)

    def _imu_table(self, to: Path) -> None:
        rows = [f"{stamp_ns},{','.join(map(repr, row))}" for stamp_ns, row in self._imu_rows()]
        write_lines(to, ["#time,wx,wy,wz,ax,ay,az", *rows])

    def _of_phone(self, to: Path, columns: slice) -> None:
        """A file of the app: x, y, z and the stamp."""
        rows = [f"{','.join(map(repr, row[columns]))},{t}" for t, row in self._imu_rows()]
        write_lines(to, rows)


def _cut(real: Path, to: Path) -> None:
    """A part of an EuRoC recording: tables are cut, images are linked."""
    with (real / "cam0" / "data.csv").open() as file:
        start_ns = int(file.read().splitlines()[1].split(",")[0])
    first, last = (start_ns + int(s * 1e9) for s in _IMAGES_S)
    for table in real.glob("*/data.csv"):
        sensor = table.parent
        is_camera = (sensor / "data").is_dir()
        margin = 0 if is_camera else 100_000_000
        header, *rows = table.read_text().splitlines()
        kept = [row for row in rows if first - margin <= int(row.split(",")[0]) <= last + margin]
        (to / sensor.name).mkdir(parents=True)
        write_lines(to / sensor.name / "data.csv", [header, *kept[:: _EVERY if is_camera else 1]])
        if (sensor / "sensor.yaml").exists():
            (to / sensor.name / "sensor.yaml").symlink_to(sensor / "sensor.yaml")
        if is_camera:
            (to / sensor.name / "data").mkdir()
            for name in (row.split(",")[1] for row in kept[::_EVERY]):
                (to / sensor.name / "data" / name).symlink_to(sensor / "data" / name)


def _rectified(image: np.ndarray, camera: Camera) -> np.ndarray:
    """What a driver publishes on a topic of rectified images, with the same focal length."""
    return cv2.undistort(image, camera.K, np.array(camera.coefficients))


def _is_named(name: str, commands: str) -> bool:
    end = "" if name.endswith("/") else r"(?![\w.]*\w)"
    return re.search(rf"(?<![\w/.-]){re.escape(name)}{end}", commands) is not None


def _write_graph(to: Path, graph: PoseGraph) -> None:
    to.write_text("".join(optimize_pose_graph(graph).g2o_lines()))


def _bundle(to: Path) -> None:
    """A problem that comes with GTSAM."""
    text = (wheel_tracks().parent / "dubrovnik-3-7-pre.txt").read_bytes()
    to.write_bytes(bz2.compress(text) if to.suffix == ".bz2" else text)


def _of_page(to: Path, page: str, number: int) -> None:
    """A file that a page shows."""
    to.write_text([content for _, _, content in blocks(page, "yaml")][number], encoding="utf-8")
