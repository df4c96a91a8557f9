# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rendered depth images with the noise of a depth sensor."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.sensors import DepthSensor
from slam_graph.simulation.simulation_config import random_stream

_ALIKE_PX = 2.0
"""The errors of pixels that are this far apart are alike: sensors match windows of pixels, which
overlap."""


@dataclass(frozen=True, eq=False)
class DepthRendering:
    """What a depth sensor makes of the exact depth.

    Attributes:
        sensor: noise and range.
        noise_scale: factor on the noise.
        seed: of the simulation.
    """

    sensor: DepthSensor
    noise_scale: float
    seed: int

    def measure(self, exact: NDArray[np.float32], since_ns: int) -> NDArray[np.float32]:
        """The measured depth image in m; NaN outside of the range.

        Args:
            exact: (height, width) depth in m, NaN where there is none.
            since_ns: time since the start, which decides the noise.
        """
        rng = np.random.default_rng(random_stream(self.seed, "depth", since_ns))
        white = rng.standard_normal(exact.shape, np.float32)
        alike = np.asarray(cv2.GaussianBlur(white, (0, 0), _ALIKE_PX), np.float32)
        noise = alike * np.float32(self.noise_scale / float(alike.std()))
        sigma = self.sensor.sigma_m(exact.astype(np.float64)).astype(np.float32)
        return self.sensor.metres(exact + sigma * noise)
