# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The cameras in Rerun: images, tracks with their age and fate, residuals of the landmarks."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.geometry import NavState
from slam_graph.sensors import CameraFrame, FeatureFrame, FeatureObservations, Rig, RigCamera
from slam_graph.visualization.rerun_palette import (
    GREEN,
    LIGHT_GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    WHITE,
    YELLOW,
    scaled,
)
from slam_graph.visualization.rerun_stream import RerunStream

ImagesMode = Literal["none", "keyframes", "all"]

JPEG_QUALITY = 75
"""Of images."""

MAX_WIDTH = 480
"""Images are shrunk by a whole number to at most so many columns: that is what fits on a screen
beside the rest, and a quarter of the bytes. Pixels of features shrink with them."""

FULL_AGE = 25.0
"""Frames after which the colour of a track is that of an old one."""

RESIDUAL_GAIN = 10.0
"""Residuals are drawn so many times as long as they are."""

_BRIEF_STRIDE = 3
"""Frames from one piece of a tail to the next where it is to be brief, and from one set of features
of a further camera to the next: most of a recording without images would be pixels."""

_UNSEEN_TAIL, _UNSEEN_RESIDUAL = 1.0, 2.0
"""Pieces of tails and residuals shorter than this, in pixels of the shrunken image, are left out
where it is to be brief: the points of their features cover them."""

FATES = ("tracked", "new", "in another camera too", "gate", "RANSAC", "dynamic")
_TRACKED, _NEW, _SHARED, _GATED, _OUTLIER, _DYNAMIC = range(1, len(FATES) + 1)
_FATE_COLOURS = (GREEN, YELLOW, SKY, VERMILLION, ORANGE, PURPLE)


class CameraViews:
    """Logs what the cameras of a rig see.

    Args:
        stream: where it goes.
        rig: the cameras.
        body: entity of the body.
        brief: whether tails are coarse, what is too short to be seen is left out, only the first
            camera has tails and residuals, and the others have features in some of the frames.
    """

    def __init__(self, stream: RerunStream, rig: Rig, body: str, brief: bool = False) -> None:
        self._stream, self._rig, self._body = stream, rig, body
        self._detailed = 1 if brief else len(rig.cameras)
        self._stride, self._brief = _BRIEF_STRIDE if brief else 1, brief
        self._shrink = [-(-mounted.camera.width // MAX_WIDTH) for mounted in rig.cameras]
        self._tails = [_Tails() for _ in rig.cameras]
        self._frames = 0
        self._rejecting: set[int] = set()

    def mount(self, rig: Rig, frustum_m: float = 0.2) -> None:
        """Send what does not change: places and lenses of the cameras, names of the fates."""
        rr, self._rig = self._stream.rr, rig
        for index, mounted in enumerate(rig.cameras):
            pose, camera = mounted.body_T_camera, mounted.camera
            shrink = self._shrink[index]
            placed = rr.Transform3D(translation=pose.translation(), mat3x3=pose.rotation().matrix())
            K = camera.K / shrink
            K[2, 2] = 1.0
            lens = rr.Pinhole(
                image_from_camera=K,
                resolution=(camera.width // shrink, camera.height // shrink),
                image_plane_distance=frustum_m,
                color=LIGHT_GREY,
                line_width=-0.6,
            )
            entity = self._entity(index)
            self._stream.log(entity, placed, static=True)
            self._stream.log(entity, lens, static=True)
            names = [
                rr.AnnotationInfo(id=number, label=name, color=colour)
                for number, (name, colour) in enumerate(
                    zip(FATES, _FATE_COLOURS, strict=True), start=1
                )
            ]
            self._stream.log(entity, rr.AnnotationContext(names), static=True)
            self._style(entity)

    @property
    def first(self) -> tuple[str, int]:
        """Entity of the first camera, and how many of its pixels are one on the screen."""
        return self._entity(0), self._shrink[0]

    def _style(self, entity: str) -> None:
        """Send once how features look, so that a frame has their places only."""
        points, lines = self._stream.rr.Points2D, self._stream.rr.LineStrips2D
        for name, style in {
            "features": points.from_fields(radii=[-2.2], show_labels=False),
            "rejected": points.from_fields(radii=[-2.2], class_ids=[_OUTLIER], show_labels=False),
            "tails": lines.from_fields(radii=[-0.8]),
            "residuals": lines.from_fields(radii=[-1.0], colors=[VERMILLION]),
            "residuals/reprojected": points.from_fields(radii=[-1.0], colors=[WHITE]),
        }.items():
            self._stream.log(f"{entity}/{name}", style, static=True)

    def show_images(self, frame: CameraFrame) -> None:
        """Log the images of a frame."""
        rr = self._stream.rr
        for index, image in enumerate(frame.images[: len(self._rig.cameras)]):
            if image is None:
                continue
            data = _jpeg(image, self._shrink[index])
            picture = rr.EncodedImage(contents=data, media_type="image/jpeg")
            self._stream.log(f"{self._entity(index)}/image", picture)

    def show_tracks(self, features: FeatureFrame, rejected: IntArray, dynamic: IntArray) -> None:
        """Log the features of a frame with their tails, coloured by age and fate.

        Args:
            features: of the frame.
            rejected: ids of those that the gate rejected.
            dynamic: ids of those that move by themselves.
        """
        rr = self._stream.rr
        seen = [camera.ids for camera in features.cameras]
        for index, camera in enumerate(features.cameras):
            shrink, tails = self._shrink[index], self._tails[index]
            tails.advance(camera, shrink)
            others = [ids for other, ids in enumerate(seen) if other != index]
            shared = np.isin(camera.ids, np.concatenate([*others, np.zeros(0, np.int64)]))
            fates = np.full(len(camera), _TRACKED, np.uint16)
            fates[shared] = _SHARED
            fates[tails.ages == 1] = _NEW
            fates[np.isin(camera.ids, dynamic)] = _DYNAMIC
            fates[np.isin(camera.ids, rejected)] = _GATED
            due = self._frames % self._stride == 0
            if index >= self._detailed and not due:
                continue
            entity = self._entity(index)
            places = on_screen(camera.pixels, shrink)
            named = f"{entity}/features"
            self._stream.log_rows(named, rr.Points2D, positions=places, class_ids=fates)
            if due and index < self._detailed:
                pieces, ages = tails.pieces()
                rows = self._visible(pieces, _UNSEEN_TAIL)
                colours = scaled(ages[rows], 0.0, FULL_AGE)
                strips = pieces[rows]
                named = f"{entity}/tails"
                self._stream.log_rows(named, rr.LineStrips2D, strips=strips, colors=colours)
        self._frames += 1
        for index, outliers in enumerate(features.outliers):
            if not len(outliers) and index not in self._rejecting:
                continue  # nothing to show, and nothing to take away
            self._rejecting.add(index)
            if not len(outliers):
                self._rejecting.remove(index)
            places = on_screen(outliers.pixels, self._shrink[index])
            marks = rr.Points2D.from_fields(positions=places)
            self._stream.log(f"{self._entity(index)}/rejected", marks)

    def show_residuals(
        self, features: FeatureFrame, state: NavState, ids: IntArray, points: FloatArray
    ) -> None:
        """Log where landmarks are predicted in the images, and how far from what was seen.

        Args:
            features: of the frame.
            state: at its time.
            ids: (N,) of the landmarks.
            points: (N, 3) in the world, m.
        """
        rr, order = self._stream.rr, np.argsort(ids)
        ids, points = ids[order], points[order]
        for index, (camera, mounted) in enumerate(
            zip(features.cameras[: self._detailed], self._rig.cameras, strict=False)
        ):
            rows = np.flatnonzero(np.isin(camera.ids, ids))
            known = points[np.searchsorted(ids, camera.ids[rows])]
            predicted, in_front = _projected(mounted, state, known)
            seen = camera.pixels[rows][in_front]
            ends = seen + RESIDUAL_GAIN * (predicted - seen)
            shrink = self._shrink[index]
            ways = on_screen(np.stack([seen, ends], axis=1), shrink)
            entity = f"{self._entity(index)}/residuals"
            ways = ways[self._visible(ways, _UNSEEN_RESIDUAL)]
            self._stream.log_rows(entity, rr.LineStrips2D, strips=ways)
            marks = on_screen(predicted, shrink)
            self._stream.log_rows(f"{entity}/reprojected", rr.Points2D, positions=marks)

    def _visible(self, ways: FloatArray, least: float) -> NDArray[np.bool_]:
        """(M,) which of some ways (M, 2, 2) are worth sending."""
        lengths = np.linalg.norm(ways[:, 1] - ways[:, 0], axis=1)
        return np.asarray((lengths >= least) | (not self._brief))

    def _entity(self, index: int) -> str:
        return f"{self._body}/cam{index}"


class _Tails:
    """The features of one camera in the last frames.

    Attributes:
        ages: (N,) for how many frames the features of the last frame are tracked.
    """

    def __init__(self) -> None:
        self._ids, self._pixels = np.zeros(0, np.int64), np.zeros((0, 2))
        self._start_ids, self._starts = self._ids, self._pixels
        self.ages: IntArray = np.zeros(0, np.int64)

    def advance(self, camera: FeatureObservations, shrink: int) -> None:
        """Take the features of the next frame."""
        _, now, before = np.intersect1d(
            camera.ids, self._ids, assume_unique=True, return_indices=True
        )
        ages = np.ones(len(camera), np.int64)
        ages[now] += self.ages[before]
        self._ids, self._pixels, self.ages = camera.ids, on_screen(camera.pixels, shrink), ages

    def pieces(self) -> tuple[FloatArray, FloatArray]:
        """Ways (M, 2, 2) of the features since this was asked for last, and ages (M,)."""
        _, now, before = np.intersect1d(
            self._ids, self._start_ids, assume_unique=True, return_indices=True
        )
        ways = np.stack([self._starts[before], self._pixels[now]], axis=1)
        self._start_ids, self._starts = self._ids, self._pixels
        return ways, self.ages[now].astype(np.float64)


def on_screen(pixels: FloatArray, shrink: int) -> FloatArray:
    """Where pixels (…, 2) are on the shrunken image: Rerun's pixel (0, 0) is from 0 to 1."""
    return np.asarray((pixels + 0.5) / shrink)


def _jpeg(image: NDArray[np.uint8], shrink: int) -> bytes:
    """An image, smaller by a whole number, as JPEG."""
    if shrink > 1:
        size = (image.shape[1] // shrink, image.shape[0] // shrink)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    good, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert good
    return bytes(data.tobytes())


def _projected(
    mounted: RigCamera, state: NavState, points: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Pixels (K, 2) of those points (N, 3) that are in front of a camera, and which these are."""
    camera_T_world = (state.world_T_body * mounted.body_T_camera).inverse()
    local = points @ camera_T_world.rotation().matrix().T + camera_T_world.translation()
    in_front = local[:, 2] > 0.05
    return mounted.camera.project(local[in_front]), in_front
