# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of frames: lost, blank, blurred, frozen, of another place, or in files of another kind."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from slam_graph.datasets.faults.clock_faults import restamped
from slam_graph.datasets.faults.fault import FAULTS, Fault, Surroundings
from slam_graph.datasets.faults.imu_faults import WHOLE_S
from slam_graph.datasets.streams.image_sequence import check_size
from slam_graph.datasets.streams.images import Fault as FileFault
from slam_graph.datasets.streams.images import Image, decode_grey
from slam_graph.errors import DataError
from slam_graph.sensors import CameraFrame, FeatureFrame, FeatureObservations, RigCamera

if TYPE_CHECKING:
    from slam_graph.arrays import FloatArray
    from slam_graph.datasets.sequence import FrameStream

Frame = CameraFrame | FeatureFrame


class FrameFault(Fault):
    """A fault that changes the frames that it covers, one after the other."""

    def frames(self, frames: FrameStream, around: Surroundings) -> FrameStream:
        """The frames, those that it covers changed or left out."""
        rng = self.rng()
        begin, end = self.begin_ns(around), self.end_ns(around)
        for frame in frames:
            if not begin <= frame.stamp_ns < end:
                yield frame
                continue
            changed = self.changed(frame, around, rng)
            if changed is not None:
                yield changed

    def changed(self, frame: Frame, around: Surroundings, rng: np.random.Generator) -> Frame | None:
        """A frame with the fault; None if it is lost."""
        raise NotImplementedError


@FAULTS.register("frames_dropped")
class FramesDropped(FrameFault):
    """Frames are lost: all, or a share of them, one by one or in bursts."""

    share: float = Field(1.0, gt=0.0, le=1.0)
    """Share of the frames that are lost."""

    burst: int = Field(1, ge=1)
    """How many are lost in a row."""

    def frames(self, frames: FrameStream, around: Surroundings) -> FrameStream:
        """The frames that are left."""
        rng, left = self.rng(), 0
        begin, end = self.begin_ns(around), self.end_ns(around)
        for frame in frames:
            if not begin <= frame.stamp_ns < end:
                yield frame
                continue
            if left == 0 and (self.share == 1.0 or rng.random() < self.share / self.burst):
                left = self.burst
            if left:
                left -= 1
                continue
            yield frame


class CameraFault(FrameFault):
    """A fault of the images of one camera, or of all."""

    duration_s: float = Field(2.0, gt=0.0)
    """How long it lasts."""

    camera: int | None = Field(None, ge=0)
    """Which camera; all if it is not said."""

    def require(self, around: Surroundings) -> None:
        """Refuse a recording without the camera.

        Raises:
            DataError: if it has fewer.
        """
        count = len(around.rig.cameras)
        if self.camera is not None and self.camera >= count:
            raise DataError(
                f"a fault of camera {self.camera}, counted from 0, and the recording has {count}; "
                "choose another one by camera=0, or all by camera=null"
            )

    def changed(self, frame: Frame, around: Surroundings, rng: np.random.Generator) -> Frame:
        """The frame with other images or features."""
        cameras = around.rig.cameras
        struck = [self.camera in (None, k) for k in range(len(cameras))]
        if isinstance(frame, CameraFrame):
            images = [
                self.image(image, camera, around, rng) if hit and image is not None else image
                for image, camera, hit in zip(frame.images, cameras, struck, strict=True)
            ]
            return replace(frame, images=tuple(images))
        features = [
            self.features(seen, camera, rng) if hit else seen
            for seen, camera, hit in zip(frame.cameras, cameras, struck, strict=True)
        ]
        return FeatureFrame(frame.stamp_ns, tuple(features))

    def image(
        self, image: Image, camera: RigCamera, around: Surroundings, rng: np.random.Generator
    ) -> Image | None:
        """The image with the fault; None if there is none."""
        raise NotImplementedError

    def features(
        self, seen: FeatureObservations, camera: RigCamera, rng: np.random.Generator
    ) -> FeatureObservations:
        """What a front end would see in it."""
        return FeatureObservations.empty()


@FAULTS.register("camera_lost")
class CameraLost(CameraFault):
    """A camera gives no images."""

    duration_s: float = Field(3.0, gt=0.0)
    """How long it lasts."""

    camera: int | None = Field(1, ge=0)
    """Which camera; all if it is null."""

    def changed(self, frame: Frame, around: Surroundings, rng: np.random.Generator) -> Frame:
        """The frame without images of the camera, which are counted as a reader does."""
        left = super().changed(frame, around, rng)
        if isinstance(frame, CameraFrame) and isinstance(left, CameraFrame):
            for camera, was, now in zip(around.rig.cameras, frame.images, left.images, strict=True):
                if was is not None and now is None:
                    what = f"{camera.name} has no image at {frame.stamp_ns}"
                    around.diagnostics.warn("camera_frame_missing", what)
        return left

    def image(
        self, image: Image, camera: RigCamera, around: Surroundings, rng: np.random.Generator
    ) -> Image | None:
        """No image."""
        return None


@FAULTS.register("image_blank")
class ImageBlank(CameraFault):
    """Images have one grey value: the lens is covered."""

    value: int = Field(0, ge=0, le=255)
    """The grey value."""

    def image(
        self, image: Image, camera: RigCamera, around: Surroundings, rng: np.random.Generator
    ) -> Image:
        """An image of one value."""
        return np.full_like(image, self.value)


@FAULTS.register("image_overexposed")
class ImageOverexposed(CameraFault):
    """Most of the image is white."""

    gain: float = Field(8.0, gt=1.0)
    """By how much it is too bright."""

    def image(
        self, image: Image, camera: RigCamera, around: Surroundings, rng: np.random.Generator
    ) -> Image:
        """The image as it is clipped."""
        return cv2.convertScaleAbs(image, alpha=self.gain).astype(np.uint8, copy=False)


@FAULTS.register("image_blurred")
class ImageBlurred(CameraFault):
    """Images are blurred along their rows, as by motion."""

    length_px: int = Field(25, ge=2)
    """Length of the blur."""

    def image(
        self, image: Image, camera: RigCamera, around: Surroundings, rng: np.random.Generator
    ) -> Image:
        """The blurred image."""
        return cv2.blur(image, (self.length_px, 1)).astype(np.uint8, copy=False)

    def features(
        self, seen: FeatureObservations, camera: RigCamera, rng: np.random.Generator
    ) -> FeatureObservations:
        """Features along the row by up to half the blur off."""
        off = rng.uniform(-0.5, 0.5, size=len(seen)) * self.length_px
        return _moved(seen, seen.pixels + np.column_stack([off, np.zeros_like(off)]), camera)


@FAULTS.register("image_noise")
class ImageNoise(CameraFault):
    """Images are noise."""

    def image(
        self, image: Image, camera: RigCamera, around: Surroundings, rng: np.random.Generator
    ) -> Image:
        """Noise of the size of the image."""
        return rng.integers(0, 256, image.shape, np.uint8)

    def features(
        self, seen: FeatureObservations, camera: RigCamera, rng: np.random.Generator
    ) -> FeatureObservations:
        """Features anywhere in the image."""
        size = (camera.camera.width - 1, camera.camera.height - 1)
        return _moved(seen, rng.uniform(size=(len(seen), 2)) * size, camera)


@FAULTS.register("image_other_place")
class ImageOtherPlace(CameraFault):
    """Images show another place: the same ones upside down."""

    fits_masks: ClassVar[bool] = False

    def image(
        self, image: Image, camera: RigCamera, around: Surroundings, rng: np.random.Generator
    ) -> Image:
        """The image turned by 180°."""
        return np.ascontiguousarray(image[::-1, ::-1])

    def features(
        self, seen: FeatureObservations, camera: RigCamera, rng: np.random.Generator
    ) -> FeatureObservations:
        """The features where they are in that image."""
        size = np.array([camera.camera.width - 1, camera.camera.height - 1])
        return _moved(seen, size - seen.pixels, camera)


@FAULTS.register("image_frozen")
class ImageFrozen(FrameFault):
    """The first image comes again and again."""

    fits_masks: ClassVar[bool] = False

    duration_s: float = Field(2.0, gt=0.0)
    """How long it lasts."""

    def frames(self, frames: FrameStream, around: Surroundings) -> FrameStream:
        """The frames, with repeated images."""
        held: Frame | None = None
        begin, end = self.begin_ns(around), self.end_ns(around)
        for frame in frames:
            if not begin <= frame.stamp_ns < end:
                yield frame
                continue
            held = held or frame
            yield restamped(held, frame.stamp_ns)


class _OtherFile(CameraFault):
    """Images as a file of another kind would hold them; they are read as readers do."""

    def stored(self, image: Image) -> NDArray[Any]:
        """The image in the file."""
        raise NotImplementedError

    def image(
        self, image: Image, camera: RigCamera, around: Surroundings, rng: np.random.Generator
    ) -> Image | None:
        """What a reader makes of the file."""
        _, data = cv2.imencode(".png", self.stored(image))
        where = f"injected image of {camera.name}"
        found = check_size(decode_grey(data.tobytes(), where), camera.camera, lambda: where)
        if isinstance(found, FileFault):
            around.diagnostics.warn(found.kind, found.message)
            return None
        return found

    def features(
        self, seen: FeatureObservations, camera: RigCamera, rng: np.random.Generator
    ) -> FeatureObservations:
        """Tracks come from no files of images.

        Raises:
            DataError: always.
        """
        raise DataError("this fault is one of image files, and the recording holds tracks")


@FAULTS.register("image_size")
class ImageSize(_OtherFile):
    """Images have another size."""

    scale: float = Field(0.5, gt=0.0)
    """Their size over that of the calibration."""

    def stored(self, image: Image) -> NDArray[Any]:
        """The scaled image."""
        return cv2.resize(image, None, fx=self.scale, fy=self.scale)


@FAULTS.register("image_16_bit")
class Image16Bit(_OtherFile):
    """Images have 16 bits."""

    duration_s: float = Field(WHOLE_S, gt=0.0)
    """How long it lasts: to the end."""

    def stored(self, image: Image) -> NDArray[Any]:
        """The image with its values in the upper bits."""
        return image.astype(np.uint16) * 257


@FAULTS.register("image_colour")
class ImageColour(_OtherFile):
    """Images have three channels."""

    duration_s: float = Field(WHOLE_S, gt=0.0)
    """How long it lasts: to the end."""

    def stored(self, image: Image) -> NDArray[Any]:
        """The image in colour."""
        return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)


def _moved(seen: FeatureObservations, pixels: FloatArray, camera: RigCamera) -> FeatureObservations:
    """The same features at other pixels (N, 2)."""
    return replace(seen, pixels=pixels, normalized=camera.camera.undistort(pixels))
