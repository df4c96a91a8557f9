# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a program that runs another system needs: an EuRoC clip, and clocks around its frames.

Such programs run in environments of their own, which hold NumPy, OpenCV and the other system, but
not this package; so nothing of it is imported here.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.clocks import Image, Watch, hold_to_one_core, time_flow

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

CAUSAL_FILE, FINAL_FILE, COSTS_FILE = "causal.tum", "final.tum", "costs.json"


@dataclass(frozen=True)
class PinholeCamera:
    """A camera of the clip, as its file has it.

    Attributes:
        intrinsics: (4,) fu, fv, cu, cv in pixels.
        distortion: (4,) k1, k2, p1, p2.
        size: width and height in pixels.
        body_T_camera: (4, 4).
    """

    intrinsics: Array
    distortion: Array
    size: tuple[int, int]
    body_T_camera: Array


@dataclass(frozen=True)
class Clip:
    """An EuRoC folder.

    Attributes:
        folder: ``mav0``.
        cameras: both cameras.
        stamps_ns: (N,) of the frames.
        imu: (M, 7) time in s, angular rate in rad/s, specific force in m/s².
        imu_stamps_ns: (M,).
        imu_noise: densities and random walks by the names of the file, in SI units.
    """

    folder: Path
    cameras: tuple[PinholeCamera, PinholeCamera]
    stamps_ns: Stamps
    imu: Array
    imu_stamps_ns: Stamps
    imu_noise: dict[str, float]

    @staticmethod
    def read(path: Path) -> Clip:
        """Read all but the images."""
        folder = path / "mav0"
        rows = _rows(folder / "imu0")
        stamps = np.array([int(row[0]) for row in rows])
        imu = np.array([[int(row[0]) * 1e-9, *map(float, row[1:7])] for row in rows])
        text = (folder / "imu0" / "sensor.yaml").read_text(encoding="utf-8")
        noise = re.findall(r"^(\w+_(?:density|walk)): *(\S+)", text, re.M)
        return Clip(
            folder,
            (_camera(folder / "cam0"), _camera(folder / "cam1")),
            np.array([int(row[0]) for row in _rows(folder / "cam0")]),
            imu,
            stamps,
            {name: float(value) for name, value in noise},
        )

    def images(self, stamp_ns: int) -> tuple[Image, Image] | None:
        """The images of a frame, left and right; None if one of them cannot be decoded."""
        left, right = (
            cv2.imread(str(self.folder / name / "data" / f"{stamp_ns}.png"), cv2.IMREAD_GRAYSCALE)
            for name in ("cam0", "cam1")
        )
        if left is None or right is None:
            return None
        return left.astype(np.uint8, copy=False), right.astype(np.uint8, copy=False)

    def imu_between(self, after_ns: int, until_ns: int) -> Array:
        """(m, 7) samples after one time and not after the other."""
        inside = (self.imu_stamps_ns > after_ns) & (self.imu_stamps_ns <= until_ns)
        return self.imu[inside]


@dataclass
class Frame:
    """A frame that waits for its estimate.

    Attributes:
        stamp_ns: of both images.
        left: image.
        right: image.
        imu: (m, 7) samples since the frame before.
        world_T_body: (4, 4), to be filled in; None if there is none.
    """

    stamp_ns: int
    left: Image
    right: Image
    imu: Array
    world_T_body: Array | None = None


class Costs:
    """CPU time of frames, and between them of the reference.

    Attributes:
        frames: of the thread that hands frames in.
        flows: of the reference.
    """

    def __init__(self) -> None:
        self.frames = Watch()
        self.flows = Watch()
        self._others_s = 0.0
        self._began_s = 0.0
        self._poses: list[tuple[int, Array]] = []

    def play(self, clip: Clip, paced: bool = False) -> Iterator[Frame]:
        """Hand out all frames.

        What is done with a frame is timed until the next one is asked for. A frame of which an
        image cannot be decoded is left out; its IMU samples go with the next one.

        Args:
            clip: the recording.
            paced: no frame comes before its time, as a system needs whose threads work between
                frames.
        """
        last_ns, last_left = 0, None
        began_s, self._began_s = time.monotonic(), time.process_time()
        for stamp_ns in map(int, clip.stamps_ns):
            since_s = time.thread_time()
            images = clip.images(stamp_ns)
            if images is not None and last_left is not None:
                time_flow(last_left, images[0], self.flows)
            self._others_s += time.thread_time() - since_s
            if images is None:
                continue
            frame = Frame(stamp_ns, *images, clip.imu_between(last_ns, stamp_ns))
            last_ns, last_left = stamp_ns, frame.left
            if paced:
                due_s = began_s + (stamp_ns - int(clip.stamps_ns[0])) * 1e-9
                time.sleep(max(due_s - time.monotonic(), 0.0))
            self.frames.start()
            yield frame
            self.frames.stop()
            if frame.world_T_body is not None:
                self._poses.append((stamp_ns, frame.world_T_body))

    def write(self, folder: Path) -> None:
        """Write costs and causal poses; to be called when all threads have come to their end."""
        total_s = time.process_time() - self._began_s - self._others_s
        table = {
            "reference": self.flows.cpu.tolist(),
            "frame": self.frames.cpu.tolist(),
            "all_threads_ms": 1e3 * total_s,
        }
        (folder / COSTS_FILE).write_text(json.dumps(table), encoding="utf-8")
        write_tum(folder / CAUSAL_FILE, self._poses)


def write_tum(file: Path, poses: list[tuple[int, Array]]) -> None:
    """Write poses (4, 4) with their stamps in ns as lines of t x y z qx qy qz qw."""
    lines = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} "
        + " ".join(f"{value:.9f}" for value in (*pose[:3, 3], *quaternion(pose[:3, :3])))
        for stamp, pose in poses
    ]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def quaternion(R: Array) -> Array:
    """(4,) x, y, z, w of a rotation matrix: the eigenvector of the largest eigenvalue of a form.

    Bar-Itzhack 2000, which does not divide by what may be small.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    K = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    return np.asarray(np.linalg.eigh(K)[1][:, -1])


def rotation(q: Array) -> Array:
    """(3, 3) of a unit quaternion x, y, z, w."""
    v, w = q[:3], q[3]
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross)


def prepare() -> None:
    """Keep this process on one core, as those of the other benchmarks are."""
    hold_to_one_core()


def _rows(folder: Path) -> list[list[str]]:
    lines = (folder / "data.csv").read_text(encoding="utf-8").splitlines()
    return [line.split(",") for line in lines if line and not line.startswith("#")]


def _camera(folder: Path) -> PinholeCamera:
    text = (folder / "sensor.yaml").read_text(encoding="utf-8")

    def numbers(name: str) -> Array:
        found = re.search(rf"^ *{name}: *\[([^\]]*)\]", text, re.M)
        assert found is not None, f"{folder}: no {name}"
        return np.array([float(value) for value in found[1].split(",")])

    width, height = numbers("resolution").astype(int)
    return PinholeCamera(
        numbers("intrinsics"),
        numbers("distortion_coefficients"),
        (int(width), int(height)),
        numbers("data").reshape(4, 4),
    )
