# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes with their images, and points: what programs for dense reconstruction start from.

Keyframes are chosen by motion. Where the run saved a map, its keyframes are among them, the points
are those of the map, moved to fit their observations (`scene_points.py`), and the first camera's
observations in its keyframes are known. In the other images, those of further cameras among them,
the points of the last keyframe are found again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.datasets import Sequence
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry import Trajectory
from slam_graph.results.scene_points import refined_points
from slam_graph.sensors import CameraFrame, Rig, RigCamera

if TYPE_CHECKING:
    from slam_graph.maps import SlamMap

_TURN_RAD = 0.1
"""A frame is also a keyframe when the body has turned so far since the last."""

_SAME_FRAME_NS = 5_000_000
"""A keyframe of the map is the frame nearest in time, at most so far away."""

_FOUND_PX = 2.0
"""A point that is found again counts as observed if it is so near to where it projects to."""
_SEARCH_PX = 21
"""Side of the window by which it is recognised."""

_GREY = 128

COLMAP_OFFSET_PX = 0.5
"""In COLMAP and nerfstudio the centre of the top left pixel is (0.5, 0.5), here (0, 0)."""


@dataclass(frozen=True, eq=False)
class SceneParts:
    """What is needed of a run.

    Attributes:
        rig: calibration at the end of the run.
        trajectory: poses of the body, in the world of the map if there is one.
        points: (P, 3) features in the world, m.
        known: the map of the run, if there is one; it takes the place of rig and points.
        spacing_m: a frame is a keyframe when the body has moved so far since the last.
    """

    rig: Rig
    trajectory: Trajectory
    points: FloatArray
    known: SlamMap | None
    spacing_m: float


@dataclass(frozen=True, eq=False)
class SceneImage:
    """An image of a scene.

    Attributes:
        name: of its file, below the folder of images.
        camera: which of the rig.
        world_T_camera: its pose.
        pixels: (N, 2) observations; (0, 0) is the centre of the top left pixel.
        points: (N,) which point of the scene each observation is of.
    """

    name: str
    camera: int
    world_T_camera: gtsam.Pose3
    pixels: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    points: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True, eq=False)
class Scene:
    """Images with poses, and points.

    Attributes:
        cameras: of the rig.
        images: in the order of time.
        points: (P, 3) in the world, m.
        grey: (P,) brightness of the points, 0 to 255.
    """

    cameras: tuple[RigCamera, ...]
    images: list[SceneImage]
    points: FloatArray
    grey: IntArray

    @property
    def known(self) -> BoolArray:
        """(P,) whether the place of each point is known; a file holds no others."""
        return np.asarray(np.isfinite(self.points).all(axis=1))


def export_scene(parts: SceneParts, recording: Sequence, folder: Path) -> Scene:
    """Write the images of all keyframes as PNG files, and collect their poses and the points.

    Args:
        parts: of a run on the recording.
        recording: that has the images.
        folder: of the images; made if it is missing.

    Raises:
        DataError: if the recording has no images, none of them has a pose, or a file cannot be
            written.
    """
    info = recording.info()
    if info.content != "images":
        raise DataError(
            f"{info.name}: has feature tracks and no images; there is nothing to export"
        )
    chosen = _Keyframes(parts)
    shades = np.zeros((len(chosen.points), 2))
    images: list[SceneImage] = []
    last: _Observed | None = None  # by the first camera in the last keyframe of the map
    for frame in _frames(recording):
        keyframe = chosen.take(frame.stamp_ns + round(chosen.rig.pose_offset_s * 1e9))
        if keyframe is None:
            continue
        world_T_body, pixels, points = keyframe
        for camera, (mounted, image) in enumerate(
            zip(chosen.rig.cameras, frame.images, strict=False)
        ):
            if image is None:
                continue
            name = f"cam{camera}/{frame.stamp_ns}.png"
            _write(folder / name, image)
            pose = world_T_body.compose(mounted.body_T_camera)
            if camera == 0 and len(points):
                last = image, pixels, points
                np.add.at(
                    shades, points, np.stack([_shades(image, pixels), np.ones(len(points))], 1)
                )
                images.append(SceneImage(name, camera, pose, pixels, points))
            else:
                found = _found_again(last, image, mounted, pose, chosen.points)
                images.append(SceneImage(name, camera, pose, *found))
    if not images:
        raise DataError(f"{info.name}: none of its images has a pose in the result")
    grey = np.where(shades[:, 1] > 0, shades[:, 0] / np.maximum(shades[:, 1], 1.0), _GREY)
    return Scene(chosen.rig.cameras, images, chosen.points, np.rint(grey).astype(np.int64))


_Keyframe = tuple[gtsam.Pose3, FloatArray, IntArray]
_Observed = tuple[np.ndarray, FloatArray, IntArray]
"""An image, the pixels (N, 2) of points in it, and which points (N,) these are."""


class _Keyframes:
    """Chooses frames, those of the map and those between which the body has moved enough."""

    def __init__(self, parts: SceneParts) -> None:
        self.rig, self.points, self._map = parts.rig, parts.points, parts.known
        if self._map is not None:
            if len(self._map.recordings) != 1:
                raise DataError("the map is of several recordings; export the run of one of them")
            self.rig, self.points = self._map.recordings[0].rig, refined_points(self._map)
        self._parts = parts
        self._last: gtsam.Pose3 | None = None

    def take(self, stamp_ns: int) -> _Keyframe | None:
        """Pose and observations at a time; None if this is no keyframe."""
        found = self._of_map(stamp_ns) or self._by_motion(stamp_ns)
        if found is not None:
            self._last = found[0]
        return found

    def _of_map(self, stamp_ns: int) -> _Keyframe | None:
        known = self._map
        if known is None or not len(known):
            return None
        row = int(np.argmin(np.abs(known.stamps_ns - stamp_ns)))
        if abs(known.stamps_ns[row] - stamp_ns) > _SAME_FRAME_NS:
            return None
        observed = slice(known.offsets[row], known.offsets[row + 1])
        features = known.features[observed]
        seen = features >= 0
        pixels = self.rig.cameras[0].camera.distort(known.normalized[observed][seen])[0]
        return known.pose(row), pixels, features[seen]

    def _by_motion(self, stamp_ns: int) -> _Keyframe | None:
        try:
            pose = self._parts.trajectory.at(stamp_ns)
        except DataError:  # before the estimate starts, or after its end
            return None
        if self._last is not None:
            step = self._last.between(pose)
            angle = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
            if np.linalg.norm(step.translation()) < self._parts.spacing_m and angle < _TURN_RAD:
                return None
        return pose, np.zeros((0, 2)), np.zeros(0, np.int64)


def _found_again(
    last: _Observed | None,
    image: np.ndarray,
    mounted: RigCamera,
    world_T_camera: gtsam.Pose3,
    points: FloatArray,
) -> tuple[FloatArray, IntArray]:
    """Observations in an image of the points of another, by optical flow from where they project.

    Args:
        last: the other image; None if there is none yet.
        image: in which they are searched.
        mounted: its camera.
        world_T_camera: its pose.
        points: (P, 3) of the scene, m.

    Returns:
        Pixels (N, 2), and which points (N,) they are of.
    """
    if last is None:
        return np.zeros((0, 2)), np.zeros(0, np.int64)
    other, pixels, numbers = last
    seen = (points[numbers] - world_T_camera.translation()) @ world_T_camera.rotation().matrix()
    ahead = np.isfinite(seen).all(axis=1) & (seen[:, 2] > 0.0)
    seen, pixels, numbers = seen[ahead], pixels[ahead], numbers[ahead]
    expected = mounted.camera.distort(seen[:, :2] / seen[:, 2:])[0]
    height, width = image.shape[:2]
    inside = ((expected >= 0.0) & (expected < (width, height))).all(axis=1)
    expected, pixels, numbers = expected[inside], pixels[inside], numbers[inside]
    if not len(numbers):
        return expected, numbers
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        other,
        image,
        pixels.astype(np.float32),
        expected.astype(np.float32),
        winSize=(_SEARCH_PX, _SEARCH_PX),
        maxLevel=1,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    near = np.linalg.norm(found - expected, axis=1) < _FOUND_PX
    good = near & (status[:, 0] == 1)
    return np.asarray(found[good], np.float64), numbers[good]


def _frames(recording: Sequence) -> Iterator[CameraFrame]:
    """The frames of images."""
    for packet in recording.packets():
        if isinstance(packet.frame, CameraFrame):
            yield packet.frame


def _write(path: Path, image: np.ndarray) -> None:
    Files.make_folder(path.parent)
    good, data = cv2.imencode(path.suffix, image)
    if not good:
        raise DataError(f"{path}: the image cannot be encoded")
    with Files.writing(path):  # `imwrite` does not say if the disk is full
        path.write_bytes(data.tobytes())


def _shades(image: np.ndarray, pixels: FloatArray) -> FloatArray:
    """Brightness (N,) of the pixels nearest to some points."""
    columns, rows = np.rint(pixels).astype(np.int64).T if len(pixels) else np.zeros((2, 0), int)
    height, width = image.shape[:2]
    shades = image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    return np.asarray(shades, np.float64)
