# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a rotation that was found in the place of the calibrated one may come from."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray

_AXES = "xyz"


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """A way in which a rotation may have come about.

    Attributes:
        kind: `inverse`, `axes` or `other`.
        what: in words.
        away_rad: angle between it and the rotation that was found.
        axes: (3, 3) signed permutation that turns the recorded axes of the IMU into the right ones.
    """

    kind: str
    what: str
    away_rad: float
    axes: FloatArray


def signed_permutations(determinant: int) -> list[FloatArray]:
    """The 24 signed permutation matrices of a determinant, 1 or -1; the plainest first."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            P = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if round(np.linalg.det(P)) == determinant:
                found.append(P)
    return sorted(found, key=lambda P: -float(np.trace(P)))


def axes_text(P: FloatArray) -> str:
    """A signed permutation as what the recorded axes should have been, e.g. `(y, -x, z)`."""
    names = []
    for row in P:
        k = int(np.argmax(np.abs(row)))
        names.append(("-" if row[k] < 0 else "") + _AXES[k])
    return f"({', '.join(names)})"


def explained(Q: FloatArray, calibrated: FloatArray) -> Explanation:
    """The explanation nearest to a rotation from the camera to the recorded axes of the IMU.

    Args:
        Q: (3, 3) orthogonal, found; with determinant -1 for a left-handed gyroscope.
        calibrated: (3, 3) body_R_camera.
    """
    handed = 1 if np.linalg.det(Q) > 0 else -1
    candidates = [
        Explanation(
            "axes",
            f"the IMU's axes should be read as {axes_text(P.T)}",
            _angle(P @ calibrated, Q),
            P.T,
        )
        for P in signed_permutations(handed)
    ]
    if handed > 0:
        what = "the calibration is inverted (T_cam_imu and T_imu_cam, EuRoC's T_BS, exchanged)"
        away = _angle(calibrated.T, Q)
        candidates.insert(0, Explanation("inverse", what, away, np.eye(3)))
    return min(candidates, key=lambda c: c.away_rad)


def _angle(A: FloatArray, B: FloatArray) -> float:
    """Angle between two orthogonal matrices of the same handedness, rad."""
    handed = np.sign(np.linalg.det(A))
    return float(Rotation.from_matrix(handed * A.T @ (handed * B)).magnitude())
