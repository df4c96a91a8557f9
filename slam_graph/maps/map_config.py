# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of maps: how one is saved, how a run is located in one, and its bundle adjustment."""

from __future__ import annotations

from pydantic import Field

from slam_graph.bundle_adjustment.bal_policy import BalCostPolicy, BalPolicy, Intrinsics, Robust
from slam_graph.settings.base import Settings


class MapConfig(Settings):
    """The map of a run, to be used by later ones."""

    enabled: bool = False
    """Whether the map is saved; keyframes, words and matches are those of loop_closure."""


class LocalizationConfig(Settings):
    """How a run is located in a map; words and matches are those of loop_closure."""

    period_s: float = Field(0.2, ge=0)
    """How often a frame is compared with the map; every frame is as long as none fits."""
    candidates: int = Field(3, ge=1)
    """How many keyframes of the map that look alike are compared with a frame."""
    neighbours: int = Field(10, ge=0)
    """How many other keyframes that share most features add theirs to a candidate's."""
    agreeing: int = Field(3, ge=1)
    """So many comparisons must agree with each other before they are believed: at the start, and
    where they contradict the estimate."""
    patience: int = Field(6, ge=1)
    """After so many comparisons in a row that contradict the estimate the run counts as lost."""
    memory: int = Field(30, ge=1)
    """How many recent comparisons are held until enough of them agree."""
    confidence: float = Field(0.999, gt=0, lt=1)
    """χ² quantile of the differences that agree."""
    odometry_rotation_sigma: float = Field(1e-3, gt=0)
    """Drift of the orientation of the run in a second, rad/√s."""
    odometry_position_sigma: float = Field(0.01, gt=0)
    """Drift of its position in a second, m/√s."""
    map_rotation_sigma: float = Field(5e-3, gt=0)
    """How far the orientation of places in the map may be wrong, rad."""
    map_position_sigma: float = Field(0.02, gt=0)
    """How far places in the map may be wrong, m."""
    tilt_sigma: float = Field(5e-3, gt=0)
    """How far roll and pitch of the run may be wrong, rad; not used if the map is not level."""
    max_position_sigma: float = Field(0.2, gt=0)
    """Beyond this uncertainty of the position on any axis the run counts as lost, m."""


class MapCostPolicy(BalCostPolicy):
    """Module 1: all keyframes, all features, and how a residual counts."""

    intrinsics: Intrinsics = "fixed"
    """Focal length and distortion, beyond the calibration: as calibrated, estimated for the first
    camera of each recording, or once for all."""
    robust: Robust = "huber"
    """Loss that weighs down large reprojection errors."""


class MapPriorPolicy(Settings):
    """How far the visual-inertial estimate may be wrong that a map was made with."""

    rotation_sigma: float = Field(1e-4, gt=0)
    """Standard deviation of the orientation of a keyframe about each axis, rad."""
    position_sigma: float = Field(1e-3, gt=0)
    """Of its position along each axis, m."""
    point_sigma: float = Field(0.03, gt=0)
    """Of the position of a feature along each axis, relative to the distance from which the nearest
    keyframe sees it."""


class MapBalPolicy(BalPolicy):
    """Bundle adjustment of a map as a row of the table."""

    cost: MapCostPolicy = MapCostPolicy()
    """Cost construction."""
    prior: MapPriorPolicy = MapPriorPolicy()
    """What the visual-inertial estimate says."""
