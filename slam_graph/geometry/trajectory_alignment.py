# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Alignment of an estimated trajectory with a reference: yaw, SE(3) or Sim(3) in closed form.

The unobservable directions of a system decide how much may be aligned: position and heading of a
visual-inertial one (`yaw`), the whole pose of a stereo camera alone (`se3`), the scale too of a
single camera alone (`sim3`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError, closest
from slam_graph.geometry.trajectory import Trajectory

AlignmentMode = Literal["none", "yaw", "se3", "sim3", "scale"]
ALIGNMENT_MODES: tuple[AlignmentMode, ...] = get_args(AlignmentMode)

_LEAST_CORRELATION, _STANDS_M = 0.5, 0.05
"""What spreads over so many metres (rms) or less stands, unless estimate and reference are
correlated as much as this after the alignment. With less, the part that they do not have in common
is 1.7 times the one that they have. Something that stands, seen with noise, has a few times 1/√N; a
short way that is seen at all has nearly 1. An estimate that has drifted far from a reference that
moves has little, too, but no small spread: it is aligned as well as it can be, and its error is
large. What moves along a line is aligned with it, though the rotation about the line is one of
noise."""
_MOVES_M = 1.0
"""A reference that spreads over more (rms) moves: an estimate that stands then is wrong."""
_RELATIVE_RANK = 1e-14
"""A correlation, or a singular value over the largest one, below this counts as zero."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """The map p ↦ scale · rotation · p + translation.

    Attributes:
        rotation: (3, 3), `reference_R_estimate`.
        translation: (3,) in metres of the reference.
        scale: metres of the reference per metre of the estimate.
    """

    rotation: FloatArray
    translation: FloatArray
    scale: float = 1.0

    @staticmethod
    def identity() -> Similarity:
        """The map that changes nothing."""
        return Similarity(np.eye(3), np.zeros(3))

    @staticmethod
    def of_positions(
        reference: FloatArray, estimate: FloatArray, mode: AlignmentMode, doubtful: bool = False
    ) -> Similarity:
        """The map of `mode` from the positions of an estimate to those of the reference.

        Args:
            reference: (N, 3) positions.
            estimate: (N, 3) positions at the same times.
            mode: `scale` corrects the scale of Sim(3) alone, neither rotation nor translation.
            doubtful: whether a map will do that is hardly determined, as one to begin with.

        Raises:
            DataError: if the mode is unknown, or the positions do not determine the map.
        """
        if mode not in ALIGNMENT_MODES:
            raise DataError(f"unknown alignment '{mode}'; {closest(mode, ALIGNMENT_MODES)}")
        if mode == "none":
            return Similarity.identity()
        least = 0.0 if doubtful else _LEAST_CORRELATION
        if mode == "yaw":
            return _align_yaw(reference, estimate, least)
        similarity = _umeyama(reference, estimate, mode != "se3", least)
        if mode == "scale":
            return Similarity(np.eye(3), np.zeros(3), similarity.scale)
        return similarity

    @staticmethod
    def of_first_pose(
        reference: Trajectory, estimate: Trajectory, level: bool = True
    ) -> Similarity:
        """The motion that aligns the first pose of the estimate with that of the reference.

        It is one in position and yaw, or in position and rotation where the estimate is not level.

        Unlike a least-squares fit it leaves the errors that grow from the start as they are. A
        consistency test needs these, because the covariance starts at zero.
        """
        difference = (
            Rotation.from_quat(reference.quaternions[0])
            * Rotation.from_quat(estimate.quaternions[0]).inv()
        ).as_matrix()
        if not level:
            moved = reference.positions[0] - difference @ estimate.positions[0]
            return Similarity(difference, moved)
        yaw = np.arctan2(difference[1, 0] - difference[0, 1], difference[0, 0] + difference[1, 1])
        rotation = Rotation.from_euler("z", yaw).as_matrix()
        return Similarity(rotation, reference.positions[0] - rotation @ estimate.positions[0])

    def apply(self, trajectory: Trajectory) -> Trajectory:
        """The trajectory in the world of the reference; biases are in the body and stay."""
        linear = self.scale * self.rotation
        velocities = trajectory.velocities
        turned = Rotation.from_matrix(self.rotation) * Rotation.from_quat(trajectory.quaternions)
        return replace(
            trajectory,
            positions=trajectory.positions @ linear.T + self.translation,
            quaternions=turned.as_quat(),
            velocities=None if velocities is None else velocities @ linear.T,
        )


def _umeyama(
    reference: FloatArray, estimate: FloatArray, with_scale: bool, least: float
) -> Similarity:
    """The least-squares similarity from the points of an estimate to those of a reference.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
    PAMI 1991, eq. (40) to (42).

    Args:
        reference: (N, 3) points, N ≥ 3.
        estimate: (N, 3) the same points in another frame.
        with_scale: estimate the scale too (Sim(3)); otherwise it is 1 (SE(3)).
        least: correlation of points that stand with which their rotation is defined.

    Raises:
        DataError: if the points lie on one line, or stand but for what is not the same in both:
            their rotation is undefined.
    """
    mean_reference, mean_estimate = reference.mean(axis=0), estimate.mean(axis=0)
    centred, wanted = estimate - mean_estimate, reference - mean_reference
    covariance = wanted.T @ centred / len(reference)
    U, d, Vt = np.linalg.svd(covariance)
    common = len(reference) * float(d.sum())  # as well in a mirror, which is no matter of noise
    is_line = len(reference) < 3 or d[1] <= _RELATIVE_RANK * max(d[0], np.finfo(float).tiny)
    in_metres = [wanted] if with_scale else [wanted, centred]
    if is_line or not _determined(common, wanted, centred, least, in_metres):
        raise DataError(
            f"cannot align {len(reference)} positions that stand or lie on one line; "
            "use --align none or yaw, or a recording that moves"
        )
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    rotation = (U * signs) @ Vt
    variance = float(np.mean(np.sum(centred**2, axis=1)))
    scale = float(d @ signs) / variance if with_scale else 1.0
    return Similarity(rotation, mean_reference - scale * rotation @ mean_estimate, scale)


def _determined(
    common: float,
    reference: FloatArray,
    estimate: FloatArray,
    least: float,
    in_metres: Sequence[FloatArray],
) -> bool:
    """Whether points determine a rotation.

    Args:
        common: Σ r·e of the two, at the best rotation.
        reference: (N, 2 or 3) the points r that it turns, with a mean of zero.
        estimate: (N, 2 or 3) the same e.
        least: correlation of the two with which they do though one of them stands.
        in_metres: those of the two whose unit of length is known.
    """
    sizes = float(np.linalg.norm(reference)) * float(np.linalg.norm(estimate))
    if common <= _RELATIVE_RANK * sizes:
        return False
    spread_m = min(float(np.linalg.norm(points)) for points in in_metres) / np.sqrt(len(reference))
    moves = float(np.linalg.norm(reference)) > _MOVES_M * np.sqrt(len(reference))
    return bool(moves or common > least * sizes or spread_m > _STANDS_M)


def _align_yaw(reference: FloatArray, estimate: FloatArray, least: float) -> Similarity:
    """The least-squares rotation about world z and translation (4 degrees of freedom).

    With C = Σ r eᵀ over centred points, Σ |r - Rz(ψ) e|² is least where
    tan ψ = (C₁₀ - C₀₁) / (C₀₀ + C₁₁).

    Args:
        reference: (N, 3) points.
        estimate: (N, 3) the same points in a frame whose z axis is vertical too.
        least: correlation across the vertical of points that stand with which it is defined.

    Raises:
        DataError: if the points stand or lie above one another, but for what is not the same in
            both: their heading is undefined.
    """
    mean_reference, mean_estimate = reference.mean(axis=0), estimate.mean(axis=0)
    wanted, centred = reference - mean_reference, estimate - mean_estimate
    C = wanted.T @ centred
    sine, cosine = C[1, 0] - C[0, 1], C[0, 0] + C[1, 1]
    common = float(np.hypot(sine, cosine))
    across = wanted[:, :2], centred[:, :2]
    if not _determined(common, *across, least, across):
        raise DataError(
            f"cannot align the yaw of {len(reference)} positions that stand, or lie above one "
            "another; use --align none, or a recording that moves"
        )
    rotation = Rotation.from_euler("z", np.arctan2(sine, cosine)).as_matrix()
    return Similarity(rotation, mean_reference - rotation @ mean_estimate)
