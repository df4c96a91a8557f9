# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The alignment of the estimator's own world with that of absolute measurements.

Cameras and IMU know neither where they are nor in which direction north is; without an IMU not even
where down is. Fixes along a path tell it: the motion of the world, in position and yaw or in all
six degrees of freedom, that brings the path to the fixes. A few known orientations tell the
rotation without a path. Some fixes are wrong by far (multipath, ambiguous tags), so it is found by
graduated non-convexity with the loss of Geman and McClure (Yang, Antonante, Tzoumas & Carlone
2020).

One camera alone does not know its unit of length either. Then the path of that camera is scaled as
well, and the world is found as a similarity: by positions, as orientations tell no length.

The clock of the fixes may be off by a time that is known to some extent only. Then that time is one
more unknown: a fix that is late by τ is where the path was τ before, along its velocity. The same
holds for the place of the antenna in the body, which moves the fixes as the body turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend.aiding.fix_factors import Fix, OrientationFix
from slam_graph.backend.aiding.path_of_fixes import (
    MIN_FIXES,
    MIN_ORIENTATIONS,
    PathFix,
    PathOfFixes,
    SensorUnknowns,
)
from slam_graph.backend.aiding.rescaling import rescaled_states
from slam_graph.backend.world_gauge import in_moved_world, with_unknown_gauge
from slam_graph.geometry import NavState

_SINGULAR = 1e12
"""Condition number from which the fixes tell no world, with every unknown in units of its own."""
_LARGEST_SIGMA = 0.03
"""Largest standard deviation of a rotation (rad), and of the logarithm of the scale, that counts as
known: the engine is linear over it."""
_VAGUE = 0.5
"""The world is taken once the error that time offset (by its σ times the mean speed) and lever arm
(its σ) leave is below this many σ of a fix."""
_MOST_VAGUE = 40
"""With so many fixes it is taken in any case: on a straight road at an even speed nothing tells
offset and lever arm."""
_WIDTH = 3.4
"""Residuals (σ) beyond which a fix is an outlier: the 99 % sphere."""
_SHRINKING = 1.4
"""Factor by which the loss comes nearer to that of outliers from one step to the next."""
_STEPS = 4
"""Gauss-Newton steps at the end."""


@dataclass(frozen=True, slots=True, eq=False)
class WorldAlignment:
    """Where the estimator's world is in that of the fixes.

    Attributes:
        motion: fixes_T_own of the two worlds, in metres: after the scaling.
        covariance: of the gauge after the motion, (4, 4), (6, 6) or (7, 7), in the order of
            `world_gauge`: position (m), then yaw or rotation (rad), then the logarithm of the scale
            where nothing else measures it.
        centre: (3,) the point about which the world turns, in the world of the fixes.
        fits: (N,) which fixes fit.
        offset_s: to be added to the times of fixes with a velocity.
        offset_sigma_s: its standard deviation; zero if it is known.
        arm_m: (3,) to be added to the lever arm of these fixes.
        joint_covariance: of the gauge as above, then of the offset (s), then of the lever arm (m),
            as far as these are unknown.
        scale: metres per unit of length of the estimator's own world.
        scaled_camera: body_T_camera of the camera whose path is scaled; None where it is in metres.
    """

    motion: gtsam.Pose3
    covariance: FloatArray
    centre: FloatArray
    fits: BoolArray
    offset_s: float = 0.0
    offset_sigma_s: float = 0.0
    arm_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    joint_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    scale: float = 1.0
    scaled_camera: gtsam.Pose3 | None = None

    def is_vague(self, timed: Sequence[PathFix]) -> bool:
        """Whether clock or lever arm are known so badly that they count beside the noise.

        Args:
            timed: the fixes whose sensor has these, with the path at their times.
        """
        gauge = len(self.covariance) + (self.offset_sigma_s > 0.0)
        of_arm = np.diag(self.joint_covariance)[gauge:]
        if self.offset_sigma_s == 0.0 and not len(of_arm):
            return False
        if not 0 < len(timed) < _MOST_VAGUE:
            return False
        speed = self.scale * np.mean([np.linalg.norm(pair.velocity) for pair in timed])
        sigma = np.sqrt(np.mean([np.trace(pair.fix.covariance) / 3.0 for pair in timed]))
        arm_sigma = float(np.sqrt(of_arm.max(initial=0.0)))
        return bool(max(self.offset_sigma_s * speed, arm_sigma) > _VAGUE * sigma)

    def moved(self, states: list[NavState]) -> list[NavState]:
        """States of the estimator's own world, in the order of time, in that of the fixes."""
        states = rescaled_states(states, self.scale, self.scaled_camera)
        return in_moved_world(states, self.motion)

    def settled(self, states: list[NavState]) -> list[NavState]:
        """The same with what is not known of the gauge added to their covariances."""
        unknown = self.covariance, self.centre, self.scaled_camera
        return [with_unknown_gauge(state, *unknown) for state in self.moved(states)]


def enough_fixes(fixes: Sequence[Fix]) -> bool:
    """Whether so many fixes may tell a world, with outliers among them."""
    orientations = sum(isinstance(fix, OrientationFix) for fix in fixes)
    return len(fixes) - orientations >= MIN_FIXES or orientations >= MIN_ORIENTATIONS


def align_world(
    pairs: Sequence[PathFix],
    centre: FloatArray,
    level: bool,
    offset: tuple[float, float] = (0.0, 0.0),
    arm: tuple[FloatArray, float] | None = None,
    scaled_camera: gtsam.Pose3 | None = None,
) -> WorldAlignment | None:
    """The motion that brings a path to fixes of it; None as long as they do not tell it.

    Args:
        pairs: N fixes with the path at their times.
        centre: (3,) the point, in the world of the estimate, about which the world turns.
        level: whether gravity is measured, so that the motion is one in position and yaw.
        offset: mean and standard deviation of what is to be added to the times of fixes with a
            velocity, s; none is sought if the latter is zero.
        arm: mean (3,) and standard deviation of what is to be added to the lever arm of the same
            fixes, m; None if it is known.
        scaled_camera: body_T_camera of the camera whose path is known up to a scale; None if
            lengths are in metres.
    """
    if not enough_fixes([pair.fix for pair in pairs]):
        return None
    path = PathOfFixes.of(pairs, centre, level, SensorUnknowns.of(offset, arm), scaled_camera)
    guess = path.start()
    if guess is None:
        return None
    path = path.in_unit(guess.scale)
    distances = path.distances(guess)
    width = max(2.0 * float(distances.max() / _WIDTH) ** 2, 1.0)
    while width > 1.0:  # the loss is nearly quadratic at first
        weights = (width * _WIDTH**2 / (distances**2 + width * _WIDTH**2)) ** 2
        guess, _ = path.step(guess, weights)
        distances = path.distances(guess)
        width /= _SHRINKING
    path = path.in_unit(guess.scale)
    information = np.zeros((4, 4))
    for _ in range(_STEPS):
        fits = distances < _WIDTH
        if not path.supported(fits):
            return None
        guess, information = path.step(guess, fits.astype(np.float64))
        distances = path.distances(guess)
    units = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(np.float64).tiny))
    if np.linalg.cond(information * np.outer(units, units)) > _SINGULAR:
        return None
    whole, extra = np.asarray(np.linalg.inv(information), np.float64), guess.extra
    gauge, timed = len(whole) - len(extra), offset[1] > 0.0
    covariance = whole[:gauge, :gauge]
    late = float(extra[0]) if timed else 0.0
    sigma_s = float(np.sqrt(whole[gauge, gauge])) if timed else 0.0
    if np.sqrt(np.diag(covariance)[3:].max()) > _LARGEST_SIGMA:
        return None
    fitting = np.zeros(len(fits), np.bool_)
    fitting[path.order] = fits
    there = guess.moved(centre[None], centre[None])[0]
    added = np.zeros(3) if arm is None else extra[-3:]
    return WorldAlignment(
        *(guess.motion, covariance, there, fitting, late, sigma_s, added, whole),
        *(guess.scale, scaled_camera),
    )
