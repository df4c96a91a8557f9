# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Textures of walls and objects: band-limited noise, in pyramids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.kernels.wall_rendering import sample_textures
from slam_graph.simulation.simulation_config import random_stream

Grey = NDArray[np.float32]
"""Grey values, or other single-precision numbers per pixel."""

LEVELS = 7
"""Levels of a pyramid: each has half the resolution of the previous one, the last 1/64."""

_FINEST_WAVE_TEXELS = 4
"""Distance of the nodes of the finest noise; linear interpolation of texels is accurate then."""

_COARSEST_WAVE_M = 0.7
_FADING = 0.9
"""Amplitude of each octave of noise relative to the next coarser one."""

MEAN_GREY, CONTRAST = 118.0, 75.0


@dataclass(frozen=True, eq=False)
class Atlas:
    """The pyramids of all panels.

    Attributes:
        texels: (T,) uint8, all levels of all panels, row by row.
        offsets: (P * LEVELS,) index of the first texel of each level of each panel.
        widths, heights: (P * LEVELS,) of each level, in texels.
        texels_m: (P,) sizes of a texel of the finest level of each panel, m.
    """

    texels: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    widths: NDArray[np.int64]
    heights: NDArray[np.int64]
    texels_m: Grey

    def sample(self, panel: IntArray, footprint: Grey, a: Grey, b: Grey) -> Grey:
        """Grey values (N,), interpolated between texels and between levels.

        Args:
            panel: (N,) numbers of the panels.
            footprint: (N,) length on the panel that a pixel covers, m.
            a: (N,) coordinates on the panel, across, m.
            b: (N,) along, m.
        """
        grey = np.empty(len(panel), np.float32)
        offsets, widths, heights = (
            table.reshape(-1, LEVELS) for table in (self.offsets, self.widths, self.heights)
        )
        levels = self.texels, offsets, widths, heights, self.texels_m
        sample_textures(*levels, panel, footprint, a, b, grey)
        return grey


def paint(sizes: Sequence[tuple[float, float]], texels_m: Sequence[float], seed: int) -> Atlas:
    """Textures of all panels of a world, all different, so that places can be recognised.

    Args:
        sizes: of P panels, m.
        texels_m: size of a texel of each of them, m.
        seed: of the simulation.
    """
    images: list[NDArray[np.uint8]] = []
    for index, (size, texel_m) in enumerate(zip(sizes, texels_m, strict=True)):
        rng = np.random.default_rng(random_stream(seed, "texture", index))
        width, height = (max(round(side / texel_m), 2) for side in size)
        images += _pyramid(_noise(width, height, texel_m, rng))
    heights, widths = np.array([image.shape for image in images], np.int64).T.copy()
    ends = np.cumsum(heights * widths)
    return Atlas(
        texels=np.concatenate([image.ravel() for image in images]),
        offsets=np.concatenate([[0], ends[:-1]]),
        widths=widths,
        heights=heights,
        texels_m=np.array(texels_m, np.float32),
    )


def _noise(width: int, height: int, texel_m: float, rng: np.random.Generator) -> Grey:
    """Sum of noise of several wavelengths (height, width), with limited contrast."""
    total: Grey = np.zeros((height, width), np.float32)
    wave, amplitude = _COARSEST_WAVE_M / texel_m, 1.0
    while wave >= _FINEST_WAVE_TEXELS:
        nodes = rng.normal(size=(int(height / wave) + 4, int(width / wave) + 4))
        smooth = cv2.resize(
            nodes.astype(np.float32), None, fx=wave, fy=wave, interpolation=cv2.INTER_CUBIC
        )
        total += np.float32(amplitude) * smooth[:height, :width]
        wave, amplitude = wave / 2.0, amplitude * _FADING
    total -= total.mean()
    total *= np.float32(0.9) / max(float(total.std()), 1e-6)
    return np.float32(MEAN_GREY) + np.float32(CONTRAST) * np.tanh(total)


def _pyramid(finest: Grey) -> list[NDArray[np.uint8]]:
    levels, image = [], finest
    for _ in range(LEVELS):
        levels.append(np.rint(image).clip(0, 255).astype(np.uint8))
        height, width = image.shape
        size = (max((width + 1) // 2, 2), max((height + 1) // 2, 2))
        image = np.asarray(cv2.pyrDown(image, dstsize=size), dtype=np.float32)
    return levels
