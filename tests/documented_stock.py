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
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, write_kalibr
from slam_graph.datasets.formats.eqvio import wheel_tracks
from slam_graph.pose_graph import PoseGraph, optimize_pose_graph
from slam_graph.sensors import Camera, CameraFrame, ImuNoise, Rig, RigCamera
from slam_graph.simulation import SimulatedSequence
from slam_graph.simulation.simulator import euroc_rig

TRACKS_S = 3.0
"""Length of recordings of tracks, and of `demo`: it starts after one second."""

_IMAGES_S = (2.5, 5.5)
"""The part of MH_01 that is used: the rig moves enough to start within half a second."""

_EVERY = 2
"""Of MH_01 every second frame is used: 10 in a second."""

_SCALE = 4
"""The video of the phone is rendered this much smaller and enlarged."""

_WALK_S = 4.0

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
            "path/to/rgbd_dataset_freiburg1_xyz": write_tum_rgbd,
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
            "walk_gyro.csv": lambda to: self._of_phone(to, 0),
            "walk_accel.csv": lambda to: self._of_phone(to, 1),
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
            self._tracks(to / name, seed=int(name[4]))

    def _tracks(self, to: Path, seed: int = 0) -> None:
        overrides = ["tracks.descriptors=true", "world_seed=7", f"seed={seed}"]
        sg.simulate(trajectory="rooms", duration_s=TRACKS_S, overrides=overrides).save(to)

    def _map(self, to: Path) -> None:
        made = sg.run(self(to.stem), sg.load_config(None, ["map.enabled=true"])).slam_map
        assert made is not None
        sg.save_map(made, to)

    def _bag(self, to: Path, kind: str) -> None:
        """MH_01 as a bag that carries its calibration and its truth."""
        data = sg.open_dataset(self("path/to/MH_01_easy"))
        truth = data.groundtruth()
        aliases = _ALIASES if kind == "sqlite" else (("/imu0", *map("/cam{}/image_raw".format, (0, 1))),)
        with bag_writer(to, kind) as bag:
            for _, *images in aliases:
                write_calibration_of(bag, data.rig, [Path(topic).parent.as_posix() for topic in images])
            for packet in data.packets():
                assert isinstance(packet.frame, CameraFrame)
                imu, now = packet.imu, packet.frame.stamp_ns
                for imu_topic, *topics in aliases:
                    for k, stamp_ns in enumerate(imu.stamps_ns.tolist()):
                        bag.write(imu_topic, bag.imu(stamp_ns, imu.gyro[k], imu.accel[k]), stamp_ns)
                    for c, topic in enumerate(topics):
                        if (image := packet.frame.images[c]) is not None:
                            message = bag.image(now, image, "mono8", f"cam{c}")
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

    def _phone_chain(self, to: Path, scale: int = _SCALE) -> None:
        """The camera of `phone.yaml` with a known mounting, or the same with smaller images."""
        phone = read_kalibr(self("phone.yaml"))
        (mounted,) = phone.cameras
        c = mounted.camera
        part = scale / _SCALE
        numbers = (c.fx * part, c.fy * part, (c.cx + 0.5) * part - 0.5, (c.cy + 0.5) * part - 0.5)
        size = (int(c.width * part), int(c.height * part))
        camera = Camera(*numbers, c.distortion, c.coefficients, *size)
        pose = euroc_rig().cameras[0].body_T_camera
        known = replace(mounted, camera=camera, body_T_camera=pose, rotation_known=True)
        write_kalibr(replace(phone, cameras=(known,)), to)

    def _walk(self) -> SimulatedSequence:
        """A flight with the camera of a phone; its images are small, so that it is cheap."""
        small = self._root / "small.yaml"
        self._phone_chain(small, scale=1)
        return sg.simulate(
            trajectory="random", kind="images", calibration=small, rate_hz=15, duration_s=_WALK_S
        )

    def _walk_images(self) -> Iterator[np.ndarray]:
        """The images in the size of the phone's."""
        for packet in self._walk().packets():
            assert isinstance(packet.frame, CameraFrame)
            (image,) = packet.frame.images
            assert image is not None
            yield cv2.resize(image, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_CUBIC)

    def _video(self, to: Path) -> None:
        writer: cv2.VideoWriter | None = None
        for image in self._walk_images():
            if writer is None:
                fourcc = cv2.VideoWriter.fourcc(*"mp4v")
                size = (image.shape[1], image.shape[0])
                writer = cv2.VideoWriter(str(to), cv2.CAP_FFMPEG, fourcc, 15.0, size)
                assert writer.isOpened()
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        assert writer is not None
        writer.release()

    def _folder_of_images(self, to: Path) -> None:
        to.mkdir()
        for k, image in zip(range(3), self._walk_images(), strict=False):
            cv2.imwrite(str(to / f"frame{k}.png"), image)

    def _frame_times(self, to: Path) -> None:
        write_lines(to, ["#time", *(str(p.frame.stamp_ns) for p in self._walk_tracks().packets())])

    def _walk_tracks(self) -> SimulatedSequence:
        """The same flight without images."""
        small = self._root / "small.yaml"
        self._phone_chain(small, scale=1)
        return sg.simulate(
            trajectory="random", calibration=small, rate_hz=15, duration_s=_WALK_S
        )

    def _imu_table(self, to: Path) -> None:
        lines = ["#time,wx,wy,wz,ax,ay,az"]
        for block in self._walk_tracks().imu_blocks():
            for stamp_ns, row in zip(
                block.stamps_ns.tolist(), np.hstack([block.gyro, block.accel]), strict=True
            ):
                lines.append(f"{stamp_ns},{','.join(map(repr, row.tolist()))}")
        write_lines(to, lines)

    def _of_phone(self, to: Path, which: int) -> None:
        """A file of the app: x, y, z and the stamp."""
        lines = []
        for block in self._walk_tracks().imu_blocks():
            values = (block.gyro, block.accel)[which]
            for stamp_ns, row in zip(block.stamps_ns.tolist(), values, strict=True):
                lines.append(f"{','.join(map(repr, row.tolist()))},{stamp_ns}")
        write_lines(to, lines)


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
        for name in ("data", "sensor.yaml"):
            if (sensor / name).exists():
                (to / sensor.name / name).symlink_to(sensor / name)


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
