# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a run shows of its own consistency, without ground truth.

A wrong calibration bends what is estimated until images and IMU agree. It shows in three places:
the noise of the IMU is raised to its limit, as the corrections by images keep their direction; the
trajectory that is smoothed as a whole differs from the causal one by more than the covariances of
both allow; and innovations are larger than expected, or grow. How far each goes in good runs, and
which of them tell wrong runs from these, is in docs/lab_notes.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.geometry import StateHistory, interpolate

_FEWEST = 20
"""Innovations and pairs of states that tell something."""
_ROTATION, _POSITION = slice(0, 3), slice(3, 6)
"""Columns of the standard deviations of a state."""

USUAL_NOISE_AT_LIMIT, USUAL_SHIFT = 0.25, 2.5
"""What nearly all good runs stay below: more is a reason to look at calibration and clocks."""
MOST_SHIFT = 5.0
"""More, and noise at its limit more often than usual, makes a run suspect. Either alone does not:
after a second of images that show nothing a good run may be shifted by six."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Statistics of one run; None where there is nothing to take one from.

    Attributes:
        nis: squared Mahalanobis distances of what passed the gate, over what is expected of them.
        nis_trend: the same of the second half over that of the first.
        noise_at_limit: share of the frames, since the estimator last began, in which a noise
            density of the IMU was at its limit.
        smoothed_sigma: standard deviation of the smoothed position over that of the causal one.
        position_shift: difference of the causal position from the smoothed one, root mean square
            over the run, in that of the standard deviations of both. So it says nothing
            where a part of the run is hardly known, as a segment that nothing joins.
        rotation_shift: the same of the rotation.
    """

    nis: float | None = None
    nis_trend: float | None = None
    noise_at_limit: float | None = None
    smoothed_sigma: float | None = None
    position_shift: float | None = None
    rotation_shift: float | None = None

    @staticmethod
    def of(
        innovations: Mapping[str, FloatArray],
        noise_at_limit: float | None,
        causal: StateHistory,
        smoothed: StateHistory | None,
    ) -> Evidence:
        """The statistics of a run.

        Args:
            innovations: columns (N,) of the innovations of its frames, by name.
            noise_at_limit: see the class.
            causal: the causal estimate.
            smoothed: the smoothed one, in the same world, if there is one.
        """
        nis, trend = _nis(innovations)
        shifts = (None, None, None) if smoothed is None else _shifts(causal, smoothed)
        return Evidence(nis, trend, noise_at_limit, *shifts)

    @property
    def is_unusual(self) -> bool:
        """Whether something is beyond what good runs show."""
        return (self.noise_at_limit or 0.0) > USUAL_NOISE_AT_LIMIT or not self.agrees

    @property
    def contradicts(self) -> bool:
        """Whether both signs say that the run is wrong, so that it is suspect by that alone."""
        return (self.noise_at_limit or 0.0) > USUAL_NOISE_AT_LIMIT and self.is_apart

    @property
    def agrees(self) -> bool:
        """Whether the smoothed trajectory is as near to the causal one as in good runs."""
        return self.shift <= USUAL_SHIFT

    @property
    def is_apart(self) -> bool:
        """Whether it is so far away that one of the two is wrong."""
        return self.shift > MOST_SHIFT

    @property
    def shift(self) -> float:
        """The larger one of the two shifts, 0 where there is none."""
        return max(self.position_shift or 0.0, self.rotation_shift or 0.0)

    @property
    def causes(self) -> list[str]:
        """What is beyond its limit and the likeliest cause, in words."""
        causes, share = [], self.noise_at_limit
        if share is not None and share > USUAL_NOISE_AT_LIMIT:
            causes.append(
                f"images contradict the IMU in {share:.0%} of the frames, as with a "
                "wrong calibration, clock or noise of the IMU"
            )
        if not self.agrees:
            causes.append(
                f"the smoothed trajectory is {self.shift:.1f} σ away from the causal one, as with "
                "a wrong calibration or a wrong start"
            )
        return causes


def _nis(innovations: Mapping[str, FloatArray]) -> tuple[float | None, float | None]:
    """NIS over what is expected, and that of the second half over that of the first."""
    found, expected = innovations["passed_distance"], innovations["expected"]
    middle = len(expected) // 2
    parts = [slice(None), slice(None, middle), slice(middle, None)]
    sums = [float(np.sum(expected[part])) for part in parts]
    if len(expected) < _FEWEST or min(sums) <= 0.0:
        return None, None
    whole, first, second = (
        float(np.sum(found[part])) / total for part, total in zip(parts, sums, strict=True)
    )
    return whole, second / first if first > 0.0 else None


def _shifts(
    causal: StateHistory, smoothed: StateHistory
) -> tuple[float | None, float | None, float | None]:
    """Sigma of the smoothed positions, and shifts of position and rotation; see `Evidence`."""
    one = causal.trajectory()
    other, covered = interpolate(smoothed.trajectory(), one.stamps_ns)
    one, before, after = one.select(covered), causal.sigmas()[covered], smoothed.sigmas()
    if len(one) < _FEWEST:
        return None, None, None
    # both, as the smoothed trajectory does not use a state that was given
    stamps_ns = smoothed.trajectory().stamps_ns
    near = np.clip(np.searchsorted(stamps_ns, one.stamps_ns), 0, len(after) - 1)
    sizes = [_size(np.hypot(before, after[near])[:, part]) for part in (_POSITION, _ROTATION)]
    if not min(sizes) > 0.0:  # NaN is not either
        return None, None, None
    turns = [a.rotation().between(b.rotation()) for a, b in zip(one, other, strict=True)]
    turned = np.array([gtsam.Rot3.Logmap(turn) for turn in turns])
    ratio = _size(after[:, _POSITION]) / _size(before[:, _POSITION])
    sigma = ratio * math.sqrt(len(before) / len(after))
    return (
        sigma if math.isfinite(sigma) else None,
        _size(one.positions - other.positions) / sizes[0],
        _size(turned) / sizes[1],
    )


def _size(values: FloatArray) -> float:
    """Root of the sum of squares."""
    return float(np.linalg.norm(values))
