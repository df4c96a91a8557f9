# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What ties images to the gyroscope: clock, mounting, focal length, shutter, bias, scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Values of the unknowns.

    Attributes:
        offset_s: t_imu = t_camera + offset, of the middle row.
        focal: factor on the calibrated focal lengths.
        readout_s: of the rows.
        body_R_camera: (3, 3).
        bias: (3,) of the gyroscope, rad/s.
        scale: of the gyroscope: measured rate - bias = scale * rate of the body.
    """

    offset_s: float
    focal: float
    readout_s: float
    body_R_camera: FloatArray
    bias: FloatArray
    scale: float = 1.0

    def moved(self, by: FloatArray) -> Kinematics:
        """With a change (10,) in the order of `rotation_fit.WITH_SCALE`.

        Mountings turn in the camera frame.
        """
        return Kinematics(
            self.offset_s + float(by[0]),
            self.focal * float(np.exp(by[1])),
            self.readout_s + float(by[2]),
            self.body_R_camera @ Rotation.from_rotvec(by[3:6]).as_matrix(),
            self.bias + by[6:9],
            self.scale * float(np.exp(by[9])),
        )
