# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What landmarks look like: binary descriptors with wrong bits, some looks shared by many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.simulation.simulation_config import TrackConfig, random_stream

DESCRIPTOR_BYTES = 32


class Appearance:
    """Describes landmarks.

    Args:
        landmarks: how many there are.
        config: number of looks, and how many bits are wrong.
        seed: of the simulation.
    """

    def __init__(self, landmarks: int, config: TrackConfig, seed: int) -> None:
        rng = np.random.default_rng(random_stream(seed, "looks"))
        shape = (config.descriptor_looks, DESCRIPTOR_BYTES)
        self._looks = rng.integers(0, 256, shape, dtype=np.uint8)
        self._look_of = rng.integers(0, config.descriptor_looks, landmarks)
        self._noise = config.descriptor_noise
        self._rng = np.random.default_rng(random_stream(seed, "descriptors"))

    def of(self, landmarks: IntArray) -> NDArray[np.uint8]:
        """Descriptors (N, 32) of landmarks (N,) as they are seen now."""
        wrong = self._rng.random((len(landmarks), 8 * DESCRIPTOR_BYTES)) < self._noise
        return self._looks[self._look_of[landmarks]] ^ np.packbits(wrong, axis=1)
