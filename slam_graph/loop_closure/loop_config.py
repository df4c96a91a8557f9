# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of loop closure: keyframes, place recognition, verification, pose graph."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from slam_graph.settings import Settings, expert


def _constants(file: str, **names: str) -> dict[str, str]:
    """What to say of settings that have become constants of a file."""
    return {key: f"is a constant now: {name} in {file}" for key, name in names.items()}


class KeyframeConfig(Settings):
    """Which frames become keyframes of loop closure and maps."""

    moved: ClassVar[Mapping[str, str]] = _constants(
        "loop_closure/loop_keyframes.py",
        points_from_frames="POINT_FRAMES",
        frame_spacing_s="POINT_FRAME_SPACING_S",
        max_reprojection_px="MAX_REPROJECTION_PX",
        max_depth_error="MAX_DEPTH_ERROR",
    ) | {"triangulation": "is not set apart any more: points have the defaults of that table"}

    distance_m: float = expert(0.5, gt=0)
    """Distance from the last keyframe at which a frame becomes one. Less where flights stay within
    a metre or two, or maps are to be merged; more for large scenes, to save time and memory."""
    angle_rad: float = expert(0.35, gt=0)
    """Rotation from the last keyframe at which a frame becomes one; change it with distance_m."""
    min_common_features: float = expert(0.5, ge=0, le=1)
    """A frame that sees less than this part of the last keyframe's features becomes one."""
    further_corners: int = expert(200, ge=0)
    """Corners of the image that get descriptors beside the tracked features."""


class PlaceConfig(Settings):
    """Place recognition by bags of words."""

    moved: ClassVar[Mapping[str, str]] = _constants(
        "loop_closure/place_recognition.py",
        training_descriptors="TRAINING_DESCRIPTORS",
        training_iterations="TRAINING_ROUNDS",
        min_score_ratio="MIN_SCORE_RATIO",
        consecutive="CONSECUTIVE",
        same_place="SAME_PLACE",
    )

    words: int = expert(2000, ge=2)
    """Size of the vocabulary, which is trained on the keyframes of the recording."""
    min_gap_s: float = expert(15.0, ge=0)
    """Keyframes that are less old are no candidates for a loop closure."""
    candidates: int = expert(3, ge=1)
    """Largest number of candidates of a keyframe."""


class VerificationConfig(Settings):
    """Geometric verification of candidates."""

    moved: ClassVar[Mapping[str, str]] = _constants(
        "loop_closure/loop_verification.py", max_tilt_rad="MAX_TILT_RAD", sigma_px="SIGMA_PX"
    ) | _constants("sensors/perspective.py", ransac_iterations="RANSAC_ITERATIONS")

    max_descriptor_bits: int = expert(64, ge=0)
    """Largest Hamming distance of matching descriptors, bits."""
    min_inliers: int = expert(20, ge=6)
    """Least number of inliers of a loop closure."""
    min_inlier_share: float = expert(0.3, ge=0, le=1)
    """Least part of the matches that are inliers."""
    max_error_px: float = expert(3.0, gt=0)
    """Largest reprojection error of an inlier."""


class LoopClosureConfig(Settings):
    """Loop closure at the end of a run; the other trajectories stay as they are."""

    enabled: bool = False
    """Whether loops are closed. For recordings of minutes that come back to known places; it takes
    some seconds per 100 keyframes, and needs images or tracks with descriptors."""
    keyframes: KeyframeConfig = KeyframeConfig()
    """Which frames become keyframes."""
    places: PlaceConfig = PlaceConfig()
    """Place recognition."""
    verification: VerificationConfig = VerificationConfig()
    """Geometric verification."""
    degrees_of_freedom: Literal[4, 6] = expert(4)
    """4: position and yaw, because gravity determines roll and pitch; 6 without an IMU."""
    learn_drift: bool = expert(True)
    """Whether the drift of odometry is estimated from the loop closures, if there are ten."""
    odometry_rotation_sigma: float = expert(1e-3, gt=0)
    """Drift of the yaw, a random walk, rad/√s; where it is not learned."""
    odometry_position_sigma: float = expert(0.01, gt=0)
    """Drift of the position, a random walk, m/√s; where it is not learned."""
    odometry_scale_sigma: float = expert(0.01, gt=0)
    """Drift of the scale of one camera without an IMU, a random walk of its logarithm, 1/√s; where
    it is not learned."""
