# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of loop closure: from keyframes over place recognition to the pose graph."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from slam_graph.backend.backend_config import TriangulationConfig
from slam_graph.settings.base import Settings


class KeyframeConfig(Settings):
    """Which frames are kept as places to come back to."""

    distance_m: float = Field(0.5, gt=0)
    """A frame this far from the last keyframe is one."""
    angle_rad: float = Field(0.35, gt=0)
    """A frame turned by this much from the last keyframe is one."""
    min_common_features: float = Field(0.5, ge=0, le=1)
    """A frame that still sees less than this part of the last keyframe's features is one."""
    points_from_frames: int = Field(10, ge=1)
    """From how many recent frames the points that a keyframe sees are triangulated."""
    frame_spacing_s: float = Field(0.1, ge=0)
    """Time between these frames."""
    further_corners: int = Field(200, ge=0)
    """Corners of an image that are described beside the tracked features."""
    max_reprojection_px: float = Field(3.0, gt=0)
    """Points that fit their observations worse than this (root mean square) are left out."""
    max_depth_error: float = Field(0.1, gt=0)
    """Points whose inverse depth is known worse than this, relative to it, are left out."""
    triangulation: TriangulationConfig = TriangulationConfig()
    """When a triangulated point can be trusted."""


class PlaceConfig(Settings):
    """How places are recognised."""

    words: int = Field(2000, ge=2)
    """Words of the vocabulary that is trained on the keyframes of the recording."""
    training_descriptors: int = Field(30_000, ge=2)
    """How many descriptors it is trained on at most."""
    training_iterations: int = Field(6, ge=1)
    """Rounds of the training."""
    min_gap_s: float = Field(15.0, ge=0)
    """Keyframes of so short a time before are not taken for a place that was come back to."""
    candidates: int = Field(3, ge=1)
    """How many places are looked at for each keyframe."""
    min_score_ratio: float = Field(0.3, ge=0)
    """Least similarity of a candidate, relative to that of the keyframe just before."""
    consecutive: int = Field(1, ge=0)
    """How many keyframes just before must have had candidates of the same place."""
    same_place: int = Field(5, ge=1)
    """Keyframes whose numbers differ by no more than this show the same place."""


class VerificationConfig(Settings):
    """What makes two keyframes that look alike a loop closure."""

    max_descriptor_bits: int = Field(64, ge=0)
    """Descriptors that differ in more bits do not match."""
    min_inliers: int = Field(20, ge=6)
    """Points that must be seen where the relative pose puts them."""
    min_inlier_share: float = Field(0.3, ge=0, le=1)
    """Share of the matches that must be."""
    max_error_px: float = Field(3.0, gt=0)
    """How far from there they may be seen."""
    ransac_iterations: int = Field(200, ge=1)
    """Random samples that are tried at most."""
    max_tilt_rad: float = Field(0.05, gt=0)
    """How much roll and pitch may contradict the estimator, which knows them by gravity."""
    sigma_px: float = Field(2.0, gt=0)
    """Standard deviation of reprojection errors, those of the points included."""


class LoopClosureConfig(Settings):
    """Loop closure after a run; the causal trajectory stays as it is."""

    enabled: bool = False
    """Whether loops are closed."""
    keyframes: KeyframeConfig = KeyframeConfig()
    """Which frames are kept."""
    places: PlaceConfig = PlaceConfig()
    """How places are recognised."""
    verification: VerificationConfig = VerificationConfig()
    """What makes a loop closure."""
    degrees_of_freedom: Literal[4, 6] = 4
    """4: yaw and position, as gravity shows roll and pitch; 6 without an accelerometer."""
    learn_drift: bool = True
    """Whether loop closures, if there are ten, say how much odometry drifts; else what follows."""
    odometry_rotation_sigma: float = Field(1e-3, gt=0)
    """Drift of the orientation in a second, rad/√s."""
    odometry_position_sigma: float = Field(0.01, gt=0)
    """Drift of the position in a second, m/√s."""
