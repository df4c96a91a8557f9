# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the estimation of moving objects."""

from __future__ import annotations

from slam_graph.settings import Settings, expert


class ObjectsConfig(Settings):
    """Moving objects: how they are found among the tracks, and how their motion is estimated."""

    enabled: bool = expert(default=False)
    """Whether moving objects are estimated (option `--objects`). Without it nothing of this is
    done, and what moves is only rejected."""
    window_s: float = expert(0.5, gt=0)
    """Length of the tracks over which motion is told from estimation errors."""
    false_alarm: float = expert(1e-4, gt=0, lt=1)
    """Probability with which the test of a static track says that it moves."""
    min_speed: float = expert(0.3, gt=0)
    """Speed, m/s, that a track must be known not to have in any direction to be called static.
    Where a track is not known so well, the test says that it cannot tell."""
    min_points: int = expert(6, ge=4)
    """Fewest tracks that make an object."""
    features: int = expert(40, ge=0)
    """How many features the front end finds on each object, where it has so many corners."""
    algorithm: str = expert("")
    """Policies of the estimators of objects: the name of an algorithm, or a YAML file of one; empty
    for `configs/objects.yaml`, a window of the last frames. Where features outside of the state are
    linearised anew in every step, as with `okvis`, objects have none in the state."""
    accel_density: float = expert(1.5, gt=0)
    """White noise of the acceleration of an object, m/s²/√Hz. Raise it for objects that swerve."""
    angular_accel_density: float = expert(0.3, gt=0)
    """White noise of the angular acceleration of an object, rad/s²/√Hz. It decides which way an
    object turns whose points are nearly on a plane that faces the cameras."""
    max_occlusion_s: float = expert(2.0, gt=0)
    """How long an object that is not seen is kept; if it appears again within this time it has the
    same number."""
