# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the bundle adjustment over a whole recording (docs/bundle_adjustment.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from slam_graph.settings import Settings, expert


class FinalBaConfig(Settings):
    """The bundle adjustment over the whole recording that ends a run."""

    moved: ClassVar[Mapping[str, str]] = {
        key: f"is a constant now: {constant} in backend/smoothing/{file}.py"
        for key, constant, file in (
            ("fusion_reach_px", "REACH_PX", "projected_matches"),
            ("outlier_width", "OUTLIER_WIDTH", "recording_problem"),
            ("gyro_bias_sigma", "GYRO_BIAS_SIGMA", "recording_factors"),
            ("accel_bias_sigma", "ACCEL_BIAS_SIGMA", "recording_factors"),
            ("overlap_keyframes", "OVERLAP", "segment_chain"),
        )
    }

    enabled: bool = True
    """Whether a run ends with it and writes trajectory_smoothed.tum. Turn it off to save time where
    only the causal trajectory matters."""
    keyframe_spacing_s: float = expert(0.2, gt=0)
    """Longest time between two keyframes. Shorter follows fast motion better and takes longer in
    proportion; longer is for slow platforms."""
    robust_width: float = expert(2.45, gt=0)
    """Whitened residual beyond which the robust loss grows more slowly than the square (2.45: the
    95 % circle). Less where many observations are outliers."""
    robust_loss: Literal["none", "huber", "cauchy"] = expert("huber")
    """Robust loss of the reprojection residuals."""
    min_common_features: float = expert(0.5, ge=0, le=1)
    """A frame that sees less than this part of the last keyframe's features is a keyframe."""
    features: int = expert(150, ge=10)
    """Features per keyframe, if there are as many; those of the longest tracks are chosen."""
    average_frames: bool = expert(True)
    """Whether the observations of the frames between keyframes are averaged into the keyframes'."""
    fuse_features: bool = expert(True)
    """Whether tracks that are found to be of the same point become one feature."""
    learn_pixel_sigma: bool = expert(True)
    """Whether the noise of the tracks is estimated, with noise.pixel_sigma as an upper bound of
    single observations, and how far it is correlated from keyframe to keyframe, for which they
    count less."""
    learn_imu_noise: bool = expert(True)
    """Whether the noise of the IMU that residuals show is used; the calibrated one is a lower
    bound."""
    check_calibration: bool = expert(True)
    """Whether mountings, lenses and time offset are estimated at the end, where there is an IMU. If
    they are clearly off, the recording is adjusted again with those that were found."""
    max_iterations: int = expert(20, ge=1)
    """Largest number of Levenberg-Marquardt steps, before outliers are removed and after."""
    tolerance: float = expert(1e-4, gt=0)
    """Steps end when the relative decrease of the cost is less."""
    max_keyframes: int = expert(600, ge=20)
    """Longer recordings are solved in overlapping segments of this many, which bounds memory."""
