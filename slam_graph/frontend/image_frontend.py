# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The front end for images: features tracked in time and matched between the cameras."""

from __future__ import annotations

import cv2
import gtsam
import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError
from slam_graph.frontend.association import Associator
from slam_graph.frontend.camera_tracker import CameraTracker
from slam_graph.frontend.depth_sampling import DepthSampler
from slam_graph.frontend.extraction import FeatureExtractor, camera_mask
from slam_graph.frontend.frontend_config import DESCRIPTORS, FRONTENDS, FrontendConfig
from slam_graph.frontend.frontend_protocol import STANDARD_GRAVITY, Feedback, FrameStats
from slam_graph.frontend.image_rotation import ImageRotation
from slam_graph.frontend.keypoints import NO_TRACKS, Image, Tracks
from slam_graph.frontend.lost_features import LostFeatures
from slam_graph.frontend.lucas_kanade import BLUR_PER_PX, CornerTracking, LucasKanade
from slam_graph.frontend.matching import DescriptorMatching
from slam_graph.frontend.moving_tracks import MovingTracks
from slam_graph.frontend.prediction import ImuMotion, PointPredictor
from slam_graph.frontend.stereo import StereoMatcher, reference_cameras
from slam_graph.sensors import CameraFrame, FeatureFrame, FeatureObservations, ImuData, Rig

_FEW_FEATURES = 15
"""A warning is given when fewer features than this are left of a frame that had more."""

_GREY = np.dtype(np.uint8)

CLAHE_CLIP_LIMIT, CLAHE_TILES = 3.0, (8, 8)
"""Contrast limit, and columns and rows of tiles, of CLAHE."""


@FRONTENDS.register("klt")
class ImageFrontend:
    """Tracks features of the first camera and finds them in the cameras that see the same.

    A camera that sees little of what an earlier one sees has features of its own. They are matched
    if `method` names a descriptor, and tracked otherwise.

    Args:
        rig: calibrated cameras.
        config: settings.
        seed: decides the random samples of RANSAC.
        diagnostics: where faults are counted.

    Raises:
        ConfigError: if a mask cannot be read or does not fit its camera, or a method needs a
            library that is not installed.

    Attributes:
        frame_stats: of the last frame: counts of features (`tracked`, `new`, `recovered`, `stereo`,
            and those lost, by cause: `lost_klt`, `lost_fb`, `lost_match`, `lost_mask`,
            `lost_merged`, `lost_suddenly`, `rejected_ransac`, `rejected_map`, `rejected_gate`,
            `rejected_new`, `rejected_stereo`), and milliseconds per stage (`prepare_ms`,
            `temporal_ms`, `ransac_ms`, `detect_ms`, `stereo_ms`). With depth also `with_depth` and
            `depth_ms`.
    """

    def __init__(
        self,
        rig: Rig,
        config: FrontendConfig,
        seed: int,
        diagnostics: Diagnostics,
        gravity: float = STANDARD_GRAVITY,
    ) -> None:
        """Prepare for the first frame.

        Args:
            rig: calibrated cameras.
            config: options.
            seed: decides the random samples of RANSAC.
            diagnostics: where faults are counted.
            gravity: magnitude in m/s², for predictions from the back end's state.

        Raises:
            ConfigError: if a mask cannot be read or does not fit its camera, or a method needs a
                library that is not installed.
        """
        self._rig = rig
        self._config = config
        self._diagnostics = diagnostics
        self._stats = FrameStats()
        self._motion = ImuMotion(rig.imu, gravity)
        self._feedback = Feedback()
        self._gated = 0
        self._references = reference_cameras(rig)
        masks = _masks(rig, config)
        rng = np.random.default_rng(seed)
        lucas_kanade = LucasKanade(config, images=2 * len(rig.cameras) + (not rig.has_imu))
        self._moving = MovingTracks(config.keep_moving)
        self._trackers: list[CameraTracker] = []
        self._matchers: dict[int, StereoMatcher] = {}
        for i, (mounted, mask) in enumerate(zip(rig.cameras, masks, strict=True)):
            camera, reference = mounted.camera, self._references[i]
            extractor = FeatureExtractor(config, camera.width, camera.height, mask)
            turns = not rig.has_imu and config.prediction in ("gyroscope", "state")
            seeks = turns and rig.sees_depth
            blur = BLUR_PER_PX if seeks else 0.0
            associator: Associator = CornerTracking(extractor, lucas_kanade, config, blur)
            if reference == i:
                if config.method in DESCRIPTORS:
                    associator = DescriptorMatching(camera, extractor, config, mask)
            else:
                # it has features of its own only while the reference camera has no image
                self._matchers[i] = StereoMatcher(
                    camera,
                    rig.cameras[reference].camera,
                    self._other_T_reference(i, rig),
                    lucas_kanade,
                    extractor,
                    config,
                )
            predictor = PointPredictor(mounted, self._motion, config)
            rotation = ImageRotation(camera) if turns else None
            lost = None
            if seeks and rotation is not None and config.method == "klt" and reference == i:
                lost = LostFeatures(
                    camera,
                    rotation,
                    lucas_kanade,
                    config.pyramid_levels,
                    config.forward_backward_px,
                )
            self._trackers.append(
                CameraTracker(
                    mounted,
                    extractor,
                    associator,
                    predictor,
                    config,
                    self._stats,
                    rng,
                    rotation,
                    self._moving if i == 0 else None,
                    lost,
                    keeps_few=not rig.has_imu or config.method != "klt",
                )
            )
        self._clahe = cv2.createCLAHE(CLAHE_CLIP_LIMIT, CLAHE_TILES)
        self._tracks = [Tracks.empty() for _ in rig.cameras]
        self._alone = {i for i, reference in enumerate(self._references) if reference == i}
        """Cameras that find features of their own: references, and others whose last image came
        without one of theirs."""
        self._next_id = 0
        self._depth = None if rig.depth is None else DepthSampler(rig.depth)
        self.frame_stats: dict[str, float] = {}

    def track(self, frame: CameraFrame | FeatureFrame, imu: ImuData | None = None) -> FeatureFrame:
        """The features of the next frame; those of the frame before keep their ids.

        A camera without an image keeps its features for the next one. While a reference camera has
        none, the cameras matched to it track their features by themselves. From their second such
        image on they find new ones, which end when the reference has images again.

        Raises:
            DataError: if the frame does not have one image per camera of the calibrated size, or
                its depth image is of another size.
        """
        self._stats.clear()
        self._stats.add("rejected_gate", self._gated)
        self._gated = 0
        if imu is not None:
            seen_ns = [tracks.stamp_ns for tracks in self._tracks if len(tracks)]
            self._motion.add(imu, min(seen_ns, default=None))
        with self._stats.timed("prepare_ms"):
            images = [self._equalize(image) for image in self._checked(frame)]
        first_new_id = self._next_id
        for tracker in self._trackers:
            tracker.outliers = NO_TRACKS
        for i, image in enumerate(images):
            if image is not None and (
                self._references[i] == i or images[self._references[i]] is None
            ):
                self._follow(i, image, frame.stamp_ns)
        for i, image in enumerate(images):
            reference = self._references[i]
            if image is not None and reference != i and images[reference] is not None:
                self._tracks[i] = self._match(i, image, frame.stamp_ns, first_new_id)
                self._alone.discard(i)
        found = [
            FeatureObservations.empty() if image is None else tracks.observations()
            for image, tracks in zip(images, self._tracks, strict=True)
        ]
        if self._depth is not None and isinstance(frame, CameraFrame):
            with self._stats.timed("depth_ms"):
                camera = self._depth.camera
                found[camera] = self._depth.measure(found[camera], frame, self._stats)
        self.frame_stats = dict(self._stats)
        outliers = tuple(tracker.outliers.observations() for tracker in self._trackers)
        return FeatureFrame(frame.stamp_ns, *self._apart(found, outliers))

    def _apart(
        self, found: list[FeatureObservations], outliers: tuple[FeatureObservations, ...]
    ) -> tuple[tuple[FeatureObservations, ...], ...]:
        """Static features, outliers, and features that move, of each camera."""
        static, moving = self._moving.apart(found)
        if self._moving.wanted:
            late = self._moving.surplus(self._tracks[0].ids)
            if len(late):
                self.drop(late)
        return static, outliers, moving

    def drop(self, ids: IntArray) -> None:
        """Forget features in all cameras, e.g. those that the back end rejected."""
        self._tracks = [tracks.select(~np.isin(tracks.ids, ids)) for tracks in self._tracks]
        for tracker in self._trackers:
            tracker.forget(ids)

    def receive_feedback(self, feedback: Feedback) -> None:
        """Keep state and map of the back end, and drop what it rejected if so configured."""
        self._feedback = feedback
        self._motion.state = feedback.state or self._motion.state
        if feedback.rig is not None:
            for tracker, mounted in zip(self._trackers, feedback.rig.cameras, strict=True):
                tracker.mount(mounted)
            for index, matcher in self._matchers.items():
                matcher.mount(self._other_T_reference(index, feedback.rig))
        self._moving.keeps = self._moving.wanted and feedback.state is not None
        self._moving.add(feedback.moving)
        self._moving.remove(feedback.static)
        self._moving.hulls = list(feedback.hulls) if self._moving.wanted else []
        if len(feedback.wrong):
            self.drop(feedback.wrong)
        if self._config.drop_rejected and len(feedback.rejected):
            followed = np.unique(np.concatenate([tracks.ids for tracks in self._tracks]))
            self._gated += int(np.count_nonzero(np.isin(followed, feedback.rejected)))
            self.drop(feedback.rejected)

    def _other_T_reference(self, index: int, rig: Rig) -> gtsam.Pose3:
        """Pose of the camera that another one is matched to, in the frame of that one."""
        reference = rig.cameras[self._references[index]]
        return rig.cameras[index].body_T_camera.between(reference.body_T_camera)

    def _checked(self, frame: CameraFrame | FeatureFrame) -> tuple[Image | None, ...]:
        """The images of a frame, once their number and sizes are checked."""
        if isinstance(frame, FeatureFrame):
            raise DataError(
                f"frame {frame.stamp_ns} holds features, not images: there is nothing to track; "
                "replay them"
            )
        cameras = self._rig.cameras
        if len(frame.images) != len(cameras):
            raise DataError(
                f"frame {frame.stamp_ns} has {len(frame.images)} images, the rig has "
                f"{len(cameras)} cameras"
            )
        for rig_camera, image in zip(cameras, frame.images, strict=True):
            size = (rig_camera.camera.height, rig_camera.camera.width)
            if image is not None and image.dtype != _GREY:
                raise DataError(
                    f"frame {frame.stamp_ns}: the image of camera '{rig_camera.name}' has values "
                    f"of type {image.dtype}; convert it to 8 bits (uint8)"
                )
            if image is not None and image.shape != size:
                raise DataError(
                    f"frame {frame.stamp_ns}: the image of camera '{rig_camera.name}' has shape "
                    f"{image.shape}, its calibration says {size} (height, width)"
                )
        if frame.depth is not None and self._depth is not None:
            lens = cameras[self._depth.camera].camera
            if frame.depth.shape != (lens.height, lens.width):
                raise DataError(
                    f"frame {frame.stamp_ns}: the depth image has shape {frame.depth.shape}, its "
                    f"camera {(lens.height, lens.width)} (height, width); register it"
                )
        return frame.images

    def _equalize(self, image: Image | None) -> Image | None:
        """An image with its contrast equalised, as configured."""
        if image is None or self._config.equalization == "none":
            return image
        if self._config.equalization == "histogram":
            return np.asarray(cv2.equalizeHist(image), np.uint8)
        return np.asarray(self._clahe.apply(image), np.uint8)

    def _follow(self, index: int, image: Image, stamp_ns: int) -> None:
        """Track the features of a camera, and find new ones if it is alone.

        A camera that is matched to another one is not yet alone at its first image without one of
        the other, as most often only that one is missing: what is found here would end at once.
        """
        before = self._tracks[index]
        tracker = self._trackers[index]
        after = tracker.follow(before, image, stamp_ns, self._feedback)
        if index in self._alone:
            self._stats.add("tracked", len(after))
            if len(after) < _FEW_FEATURES <= len(before):
                self._diagnostics.warn(
                    "few_features", f"{len(after)} of {len(before)} features could be followed"
                )
            after = tracker.replenish(before, after, self._next_id)
            if len(after):  # the last id is the largest
                self._next_id = max(self._next_id, int(after.ids[-1]) + 1)
        self._alone.add(index)
        self._tracks[index] = after

    def _match(self, index: int, image: Image, stamp_ns: int, first_new_id: int) -> Tracks:
        """The features of the reference camera that another camera sees too."""
        with self._stats.timed("stereo_ms"):
            matcher = self._matchers[index]
            reference = self._tracks[self._references[index]]
            matches = matcher.match(reference, image, stamp_ns, first_new_id)
            self._stats.add("stereo", matcher.counts.matched)
            self._stats.add("rejected_stereo", matcher.counts.rejected)
            return matches


def _masks(rig: Rig, config: FrontendConfig) -> list[Image | None]:
    """The mask of each camera: as configured, and the usable field of a wide lens."""
    if len(config.masks) > len(rig.cameras):
        raise ConfigError(
            f"frontend.masks lists {len(config.masks)} masks, "
            f"the rig has {len(rig.cameras)} cameras"
        )
    paths = [*config.masks, *[None] * (len(rig.cameras) - len(config.masks))]
    return [
        camera_mask(mounted.camera, path, config.window_px)
        for mounted, path in zip(rig.cameras, paths, strict=True)
    ]
