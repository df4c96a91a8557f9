# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the bundle adjustment over a whole recording."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from slam_graph.settings.base import Settings


class FinalBaConfig(Settings):
    """The bundle adjustment over the whole recording that ends a run."""

    enabled: bool = True
    """Whether a run ends with it."""
    keyframe_spacing_s: float = Field(0.2, gt=0)
    """Longest time between two keyframes where there are frames."""
    min_common_features: float = Field(0.5, ge=0, le=1)
    """A keyframe is taken earlier if fewer than this part of the last one's features are left."""
    features: int = Field(150, ge=10)
    """How many features each keyframe is given at least, if it has as many: the longest tracks."""
    average_frames: bool = True
    """Whether the frames between keyframes add what they saw to the observations of these."""
    fuse_features: bool = True
    """Whether tracks that are found to be of the same point are made one feature."""
    fusion_reach_px: float = Field(8.0, gt=0)
    """How far drift may have moved the projection of a feature for it to be recognised."""
    learn_pixel_sigma: bool = True
    """Whether the noise of the tracks may be less than noise.pixel_sigma, if residuals say so."""
    robust_loss: Literal["none", "huber", "cauchy"] = "huber"
    """Loss that weighs down large reprojection residuals."""
    robust_width: float = Field(2.45, gt=0)
    """Width of the loss on the length of a whitened residual (2.45: the 95 % circle)."""
    outlier_width: float = Field(3.7, gt=0)
    """Longer whitened residuals are left out after the first minimum (3.7: the 99.9 % circle)."""
    max_iterations: int = Field(20, ge=1)
    """Levenberg-Marquardt steps before outliers are left out, and again after that."""
    tolerance: float = Field(1e-4, gt=0)
    """Steps end when the cost falls by less than this part of it."""
    gyro_bias_sigma: float = Field(0.05, gt=0)
    """How well the causal estimate knows the first gyroscope bias, rad/s."""
    accel_bias_sigma: float = Field(0.3, gt=0)
    """How well the causal estimate knows the first accelerometer bias, m/s²."""
    max_keyframes: int = Field(600, ge=20)
    """Recordings with more keyframes are solved in pieces of this many, for a bound on memory."""
    overlap_keyframes: int = Field(50, ge=2)
    """How many keyframes two pieces share."""
