# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of maps. This module imports nothing heavy, as every run reads all settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from slam_graph.settings import Settings, expert


class MapConfig(Settings):
    """The map of a run, for later runs."""

    enabled: bool = False
    """Whether the map is saved (--save-map), for `localize` and `map merge`. Keyframes, vocabulary
    and verification have the settings of loop_closure."""


class LocalizationConfig(Settings):
    """Localization of a run in a map; recognition and verification are those of loop_closure."""

    moved: ClassVar[Mapping[str, str]] = {
        "agreeing": "is a constant now: MIN_CONSISTENT in maps/map_localization.py",
        "patience": "is a constant now: MAX_REJECTED in maps/map_localization.py",
        "memory": "is a constant now: MAX_PENDING in maps/map_localization.py",
        "confidence": "is a constant now: CONFIDENCE in maps/map_localization.py",
        "tilt_sigma": "is a constant now: TILT_SIGMA in maps/map_localization.py",
    }

    period_s: float = expert(0.2, ge=0)
    """Time between two frames that are matched with the map; until the run is localized, every
    frame is."""
    candidates: int = expert(3, ge=1)
    """Number of similar keyframes that a frame is matched with."""
    neighbours: int = expert(10, ge=0)
    """Number of covisible keyframes whose features are added to those of a candidate."""
    odometry_rotation_sigma: float = expert(1e-3, gt=0)
    """Drift of the yaw of the run, a random walk, rad/√s."""
    odometry_position_sigma: float = expert(0.01, gt=0)
    """Drift of the position of the run, a random walk, m/√s."""
    map_rotation_sigma: float = expert(5e-3, gt=0)
    """Standard deviation of the orientation of keyframes in the map, rad."""
    map_position_sigma: float = expert(0.02, gt=0)
    """Standard deviation of the position of keyframes in the map, m."""
    max_position_sigma: float = expert(0.2, gt=0)
    """The run is localized while the standard deviation of its position is less on all axes, m."""
