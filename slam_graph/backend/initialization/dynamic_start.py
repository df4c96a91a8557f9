# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Start in motion: a first guess of a short window, from static features and the IMU.

Gyroscope bias from epipolar geometry, static features by consensus, then velocity, gravity and
scale in closed form. The engine refines the guess (see dynamic_refinement.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import NoiseConfig
from slam_graph.backend.cost.feature_tracks import FeatureTracks
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.initialization.first_state import level_rotation
from slam_graph.backend.initialization.gyroscope_bias import BearingPairs, estimate_gyro_bias
from slam_graph.backend.initialization.inertial_motion import Intervals, Motion
from slam_graph.backend.initialization.start_consensus import static_features
from slam_graph.backend.initialization.start_diagnosis import MIN_FEATURES, Refusal
from slam_graph.backend.initialization.visual_inertial_alignment import (
    Alignment,
    AlignmentEquations,
    Sightings,
    align,
)
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, ImuBuffer, ImuData

OUTLIER_SIGMAS = 3.0
"""Features with a larger root mean square reprojection error are outliers, in units of σ."""


@dataclass(frozen=True, eq=False)
class StartFrames:
    """The frames from which a start in motion is computed.

    Attributes:
        stamps_ns: times on the clock of the IMU.
        frames: their features.
    """

    stamps_ns: list[int]
    frames: list[FeatureFrame]

    @staticmethod
    def thinned(stamps_ns: list[int], frames: list[FeatureFrame], spacing_s: float) -> StartFrames:
        """The last frame, and going back every frame about `spacing_s` before the one chosen."""
        chosen = [len(frames) - 1] if frames else []
        for k in range(len(frames) - 2, -1, -1):
            if stamps_ns[chosen[-1]] - stamps_ns[k] >= round(spacing_s * 0.95e9):
                chosen.append(k)
        chosen.reverse()
        return StartFrames([stamps_ns[k] for k in chosen], [frames[k] for k in chosen])

    def imu_between(self, imu: ImuBuffer) -> list[ImuData]:
        """IMU samples between each frame and the next."""
        ends = zip(self.stamps_ns[:-1], self.stamps_ns[1:], strict=True)
        return [imu.between(a, b) for a, b in ends]

    @cached_property
    def tracks(self) -> FeatureTracks:
        """The observations of all frames, numbered from 0; guess and refinement only read them."""
        window = FeatureTracks()
        for k, frame in enumerate(self.frames):
            window.add(k, frame)
        return window


@dataclass(frozen=True, slots=True, eq=False)
class StartGuess:
    """First estimates for the batch problem of a start.

    Attributes:
        states: of all frames; in motion the first body is at the origin of the world with zero yaw.
        static: ids (J,) of the features that are not known to move and are tracked for long enough,
            ascending.
    """

    states: list[NavState]
    static: IntArray


def guess_states(
    frames: StartFrames,
    imu: ImuBuffer,
    rig: RigProjection,
    config: NoiseConfig,
    rng: np.random.Generator,
) -> StartGuess | Refusal:
    """States of all frames of a window, or what is missing for them.

    Args:
        frames: at least two frames with features in common.
        imu: samples over them.
        rig: mounting of the cameras.
        config: gravity and the noise of the features.
        rng: draws the samples of RANSAC.
    """
    intervals = Intervals(frames.imu_between(imu))
    tracks = frames.tracks
    ids, lengths = tracks.lengths()
    ids = ids[lengths >= max(3, len(frames.frames) // 3)]
    if len(ids) < MIN_FEATURES:
        return Refusal("tracks", f"more features with long tracks ({len(ids)} so far)")
    sightings = Sightings(tracks.observations(ids), rig)
    tolerance = OUTLIER_SIGMAS * config.pixel_sigma / rig.cameras[0].fx

    def consensus(
        common: BearingPairs, near: FloatArray
    ) -> tuple[FloatArray, AlignmentEquations, BoolArray] | None:
        """Gyroscope bias by some features, the equations with it, and the static features."""
        gyro_bias = estimate_gyro_bias(common, intervals, near)
        if gyro_bias is None:
            return None
        equations = sightings.equations(intervals.motion(gyro_bias))
        return gyro_bias, equations, static_features(equations, config.gravity, tolerance, rng)

    common = BearingPairs.between(frames.frames, rig)
    found = consensus(common, np.zeros(3))
    if found is not None and not found[2].all():
        # dynamic features have biased the gyroscope bias, and with it the consensus
        found = consensus(common.only(ids[found[2]]), found[0])
    if found is None:
        return Refusal("tracks", "features in common between frames")
    gyro_bias, equations, static = found
    if np.sum(static) < MIN_FEATURES:
        agree = f"{np.sum(static)} of {len(ids)} do"
        return Refusal("fit", f"features that agree on a motion ({agree})")
    alignment = align(equations.subset(static), config.gravity)
    if alignment is None:
        return Refusal("motion", "motion that determines gravity and scale")
    return StartGuess(_states(frames, equations.motion, alignment, gyro_bias), ids[static])


def _states(
    frames: StartFrames, motion: Motion, alignment: Alignment, gyro_bias: FloatArray
) -> list[NavState]:
    world_R_first = level_rotation(-alignment.gravity).matrix()
    positions = alignment.positions(motion) @ world_R_first.T
    velocities = alignment.velocities(motion) @ world_R_first.T
    rotations = world_R_first @ motion.rotations
    return [
        NavState(
            stamp_ns,
            gtsam.Pose3(gtsam.Rot3.ClosestTo(rotations[k]), positions[k]),
            velocities[k],
            accel_bias=np.zeros(3),
            gyro_bias=gyro_bias,
        )
        for k, stamp_ns in enumerate(frames.stamps_ns)
    ]
