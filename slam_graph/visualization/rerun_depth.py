# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Depth images in Rerun: what the depth sensor measured, as points in the world."""

from __future__ import annotations

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.sensors import Camera, CameraFrame, Rig
from slam_graph.visualization.rerun_stream import RerunStream

DEPTH_WIDTH = 160
"""Columns of a depth image at most: 19 200 points are enough to see a room, in 10 kB."""

_FILL = 0.5
"""Size of the points as a part of what would leave no gaps: the map behind them stays visible."""

_UNITS = 1000.0
"""Units to a metre."""


class DepthView:
    """Logs depth images, at the pose of the camera that they are registered to.

    Rerun projects them back with a pinhole camera. So they are sent as such a camera would see
    them, whatever lens the real one has.

    Args:
        stream: where to.
        entity: of the depth image.
        rig: with a depth sensor, or without one: then nothing is logged.

    Attributes:
        far_m: nine tenths of what was logged last are nearer; 0 before.
    """

    def __init__(self, stream: RerunStream, entity: str, rig: Rig) -> None:
        self._stream, self._entity, self._shown = stream, entity, False
        self.far_m = 0.0
        if rig.depth is None:
            self._pixels: NDArray[np.float32] | None = None
            return
        mounted = rig.cameras[rig.depth.camera]
        self._body_T_camera = mounted.body_T_camera
        self._pixels, self._K = pinhole_pixels(mounted.camera)

    def show(self, frame: CameraFrame, parent_T_body: gtsam.Pose3 | None = None) -> None:
        """Log the depth image of a frame; where it has none, that of an earlier one goes.

        Args:
            frame: images.
            parent_T_body: pose of the body in the entity above; None if that is the body.
        """
        if self._pixels is None:
            return
        rr = self._stream.rr
        if frame.depth is None:
            if self._shown:
                self._stream.log(self._entity, rr.Clear(recursive=False))
            self._shown = False
            return
        pose = self._body_T_camera
        if parent_T_body is not None:
            pose = parent_T_body.compose(pose)
        depth = sampled(frame.depth, self._pixels)
        known = depth[np.isfinite(depth)]
        self.far_m = float(np.percentile(known, 90)) if len(known) else self.far_m
        height, width = depth.shape
        lens = rr.Pinhole(
            image_from_camera=self._K,
            resolution=(width, height),
            image_plane_distance=0.0,
        )
        placed = rr.Transform3D(translation=pose.translation(), mat3x3=pose.rotation().matrix())
        picture = rr.EncodedDepthImage(
            blob=_png(depth),
            media_type="image/png",
            meter=_UNITS,
            colormap=rr.components.Colormap.Viridis,
            point_fill_ratio=_FILL,
        )
        self._stream.log(self._entity, placed, lens, picture)
        self._shown = True


def pinhole_pixels(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Where a camera sees what a small pinhole camera at its place sees.

    Args:
        camera: of any model.

    Returns:
        Columns and rows (2, H, W) of the camera's pixels, and the pinhole camera's calibration
        matrix (3, 3), for which the middles of pixels have whole numbers. Where it looks beyond
        what the camera can see, pixels are outside of the image.
    """
    step = -(-camera.width // DEPTH_WIDTH)
    height, width = camera.height // step, camera.width // step
    first = step // 2  # in the middle of what a pixel stands for, where the camera has a pixel
    K = np.array(
        [
            [camera.fx / step, 0.0, (camera.cx - first) / step],
            [0.0, camera.fy / step, (camera.cy - first) / step],
            [0.0, 0.0, 1.0],
        ]
    )
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.column_stack([(u.ravel() - K[0, 2]) / K[0, 0], (v.ravel() - K[1, 2]) / K[1, 1]])
    pixels = camera.pixels(rays)
    # many models project rays that they do not see to somewhere in the image
    pixels[np.linalg.norm(rays, axis=1) >= camera.max_tangent] = -1.0
    return pixels.T.reshape(2, height, width).astype(np.float32), K


def sampled(depth: NDArray[np.float32], pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth (H, W) at pixels (2, H, W) in m; NaN outside. Depths are not mixed across edges."""
    u, v = pixels[0], pixels[1]
    nearest = cv2.remap(
        depth, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")
    )
    return np.asarray(nearest, np.float32)


def _png(depth: NDArray[np.float32]) -> bytes:
    """Depth in m as 16 bits, with 0 where it is not known."""
    units = np.clip(np.nan_to_num(np.rint(depth * _UNITS), nan=0.0), 0, np.iinfo(np.uint16).max)
    good, data = cv2.imencode(".png", units.astype(np.uint16))
    assert good
    return bytes(data.tobytes())
