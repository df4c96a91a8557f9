# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run in Rerun: poses, map, images with features, and series, over the time of the recording."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.geometry import NavState, Similarity, Trajectory, interpolate
from slam_graph.sensors import CameraFrame, FeatureFrame, Rig

ViewerMode = Literal["save", "spawn", "connect"]

_TIMELINE = "time"
_STRIP_LENGTH = 50
"""Poses in one strip of the path; finished strips are not sent again."""

_JPEG_QUALITY = 75
_FRUSTUM_M = 0.2
ESTIMATE_COLOR, TRUTH_COLOR = (0, 122, 255), (150, 150, 150)
FEATURE_COLOR, MAP_COLOR = (0, 220, 0), (255, 160, 0)


class RerunViewer:
    """Sends a run to a Rerun file or window, in a recording stream of its own.

    Args:
        mode: `save` to a file, `spawn` a window, or `connect` to one that is open.
        path: of the file to save; it appears when the viewer is closed.
        name: of the recording.
    """

    def __init__(self, mode: ViewerMode, path: Path | None = None, name: str = "run") -> None:
        import rerun

        self._rr: Any = rerun
        self._stream: Any = rerun.RecordingStream("slam_graph")
        self._stream.send_recording_name(name)
        self._path = path
        if mode == "save":
            if path is None:
                raise ValueError("a recording to save needs a path")
            self._partial = path.with_name(f".{path.name}.partial")
            self._stream.save(self._partial)
        elif mode == "spawn":
            self._start_window()
        else:
            self._stream.connect_grpc()
        self._strip: list[FloatArray] = []
        self._strips = 0
        self._truth: Trajectory | None = None

    def open(self, rig: Rig, truth: Trajectory | None) -> None:
        """Send what does not change: the axes and the cameras."""
        rr = self._rr
        self._truth = truth
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for index, mounted in enumerate(rig.cameras):
            pose, camera = mounted.body_T_camera, mounted.camera
            entity = f"world/body/cam{index}"
            placed = rr.Transform3D(translation=pose.translation(), mat3x3=pose.rotation().matrix())
            lens = rr.Pinhole(
                image_from_camera=camera.K,
                resolution=(camera.width, camera.height),
                image_plane_distance=_FRUSTUM_M,
            )
            self._log(entity, placed, static=True)
            self._log(entity, lens, static=True)

    def show(
        self,
        frame: CameraFrame | FeatureFrame,
        features: FeatureFrame,
        state: NavState | None,
        points: FloatArray,
    ) -> None:
        """Send one frame."""
        self._stream.set_time(_TIMELINE, timestamp=np.datetime64(features.stamp_ns, "ns"))
        self._show_cameras(frame, features)
        if state is None:
            return
        self._show_state(state)
        self._log("world/features", self._rr.Points3D(points, colors=MAP_COLOR, radii=0.02))
        if self._truth is not None:
            self._show_truth(state)

    def close(self) -> None:
        """Send what is left; a saved file appears under its name."""
        self._stream.flush()
        self._stream.disconnect()
        if self._path is not None:
            os.replace(self._partial, self._path)

    def _log(self, entity: str, *what: Any, static: bool = False) -> None:
        self._stream.log(entity, *what, static=static)

    def _start_window(self) -> None:
        """Open a window."""
        try:
            self._stream.spawn()
        except (RuntimeError, OSError) as error:
            first = str(error).splitlines()[0]
            raise DataError(f"cannot open a Rerun window ({first}); use --rerun save") from error

    def _show_cameras(self, frame: CameraFrame | FeatureFrame, features: FeatureFrame) -> None:
        """The images, with their features."""
        rr = self._rr
        images = frame.images if isinstance(frame, CameraFrame) else ()
        for index, image in enumerate(images):
            if image is not None:
                picture = rr.Image(image, color_model="L").compress(jpeg_quality=_JPEG_QUALITY)
                self._log(f"world/body/cam{index}/image", picture)
        for index, seen in enumerate(features.cameras):
            marks = rr.Points2D(seen.pixels, colors=FEATURE_COLOR, radii=2.0)
            self._log(f"world/body/cam{index}/image/features", marks)

    def _show_state(self, state: NavState) -> None:
        """The pose, the path so far, and the time series."""
        rr = self._rr
        pose = state.world_T_body
        position = pose.translation()
        placed = rr.Transform3D(translation=position, mat3x3=pose.rotation().matrix())
        self._log("world/body", placed)
        self._strip.append(np.array(position))
        path = rr.LineStrips3D([self._strip], colors=ESTIMATE_COLOR)
        self._log(f"world/path/{self._strips:05d}", path)
        if len(self._strip) >= _STRIP_LENGTH:
            self._strip, self._strips = self._strip[-1:], self._strips + 1
        series = {
            "velocity": state.velocity,
            "gyro_bias": state.gyro_bias,
            "accel_bias": state.accel_bias,
        }
        if state.covariance is not None:
            sigmas = np.sqrt(np.maximum(np.diag(state.covariance), 0.0))
            series |= {"sigma/rotation": sigmas[:3], "sigma/position": sigmas[3:6]}
        for name, values in series.items():
            self._log(f"series/{name}", rr.Scalars(values))

    def _show_truth(self, state: NavState) -> None:
        """The true path, sent once, aligned with the estimate at the first pose."""
        assert self._truth is not None
        start, _ = interpolate(self._truth, np.array([state.stamp_ns]))
        if len(start) == 0:
            return
        quaternion: Any = state.world_T_body.rotation().toQuaternion()
        own = Trajectory(
            start.stamps_ns,
            np.array([state.world_T_body.translation()]),
            np.array([quaternion.coeffs()]),
        )
        path = Similarity.of_first_pose(own, start).apply(self._truth).positions
        line = self._rr.LineStrips3D([path], colors=TRUTH_COLOR)
        self._log("world/groundtruth", line, static=True)
        self._truth = None
