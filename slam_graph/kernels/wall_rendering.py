# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rays that meet flat panels, and the textures there: the images of a simulation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["cast_rays", "cast_rays_numpy", "sample_textures", "sample_textures_numpy"]

_Single = NDArray[np.float32]
_Texels = NDArray[np.uint8]

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_BORDER = 1.001
"""So far from the end of a texture, or of its levels, interpolation has a neighbour."""


@compiled("void(f4[:, ::1], i8[::1], f4[:, :, ::1], f4[:, ::1], i8[::1], f4[:, ::1])")
def cast_rays(
    rays: _Single,
    numbers: IntArray,
    frames: _Single,
    panels: _Single,
    hit: IntArray,
    places: _Single,
) -> None:
    """Find the nearest panel along each ray; what meets none stays as it is.

    Args:
        rays: (N, 3) unit vectors.
        numbers: (P,) of the panels that are seen from the front.
        frames: (P, 3, 3) their normals and unit vectors across and along, in rows.
        panels: (P, 5) corner minus eye in these axes, then size across and along, m.
        hit: (N,) the number of the panel, filled.
        places: (4, N) distance (m), cosine between ray and normal, coordinates across and along
            (m), filled; the distances before are the largest that count.
    """
    for n in range(len(rays)):
        x, y, z = rays[n, 0], rays[n, 1], rays[n, 2]
        for p in range(len(numbers)):
            F = frames[p]
            slope = F[0, 0] * x + F[0, 1] * y + F[0, 2] * z
            distance = panels[p, 0] / slope
            if not (distance > _ZERO and distance < places[0, n]):
                continue
            a = distance * (F[1, 0] * x + F[1, 1] * y + F[1, 2] * z) - panels[p, 1]
            b = distance * (F[2, 0] * x + F[2, 1] * y + F[2, 2] * z) - panels[p, 2]
            if a >= _ZERO and a <= panels[p, 3] and b >= _ZERO and b <= panels[p, 4]:
                hit[n] = numbers[p]
                places[0, n], places[1, n], places[2, n], places[3, n] = distance, -slope, a, b


def cast_rays_numpy(
    rays: _Single,
    numbers: IntArray,
    frames: _Single,
    panels: _Single,
    hit: IntArray,
    places: _Single,
) -> None:
    """`cast_rays` in NumPy."""
    for number, frame, panel in zip(numbers, frames, panels, strict=True):
        slope, across, along = frame @ rays.T
        with np.errstate(divide="ignore"):
            distance = panel[0] / slope
        near = np.flatnonzero((distance > 0) & (distance < places[0]))
        t = distance[near]
        a, b = t * across[near] - panel[1], t * along[near] - panel[2]
        inside = (a >= 0) & (a <= panel[3]) & (b >= 0) & (b <= panel[4])
        hit[near[inside]] = number
        places[:, near[inside]] = np.stack([t, -slope[near], a, b])[:, inside]


@compiled()
def _within(
    texels: _Texels,
    offset: int,
    width: int,
    height: int,
    scale: np.float32,
    x: np.float32,
    y: np.float32,
) -> np.float32:
    """Grey value of a level, at coordinates in texels of the finest one."""
    u = np.float32(min(max(x * scale, _ZERO), np.float32(width - _BORDER)))
    v = np.float32(min(max(y * scale, _ZERO), np.float32(height - _BORDER)))
    column, line = int(u), int(v)
    u, v = u - np.float32(column), v - np.float32(line)
    place = offset + line * width + column
    left, right = np.float32(texels[place]), np.float32(texels[place + 1])
    top = left + u * (right - left)
    left, right = np.float32(texels[place + width]), np.float32(texels[place + width + 1])
    return np.float32(top + v * (left + u * (right - left) - top))


@compiled(
    "void(u1[::1], i8[:, ::1], i8[:, ::1], i8[:, ::1], f4[::1], i8[::1], f4[::1], f4[::1], f4[::1],"
    " f4[::1])"
)
def sample_textures(
    texels: _Texels,
    offsets: IntArray,
    widths: IntArray,
    heights: IntArray,
    texels_m: _Single,
    panel: IntArray,
    footprint: _Single,
    a: _Single,
    b: _Single,
    grey: _Single,
) -> None:
    """Fill grey values, interpolated linearly between texels and between levels (trilinear).

    The centre of texel i of a level is that of texel i · 2^level of the finest level, because
    `cv2.pyrDown` keeps every other texel.

    Args:
        texels: (T,) all levels of all panels, row by row.
        offsets: (P, L) index of the first texel of each level of each panel.
        widths: (P, L) of each level, in texels.
        heights: (P, L) of each level, in texels.
        texels_m: (P,) sizes of a texel of the finest level of each panel, m.
        panel: (N,) numbers of the panels.
        footprint: (N,) length on the panel that a pixel covers, m.
        a: (N,) coordinates on the panel, across, m.
        b: (N,) along, m.
        grey: (N,), filled.
    """
    highest = np.float32(offsets.shape[1] - _BORDER)
    for n in range(len(panel)):
        p, texel_m = panel[n], texels_m[panel[n]]
        octave = np.float32(math.log2(footprint[n] / texel_m))
        level = np.float32(min(max(octave, _ZERO), highest))
        fine = int(level)
        x, y = np.float32(a[n] / texel_m - _HALF), np.float32(b[n] / texel_m - _HALF)
        scale = np.float32(1.0 / (1 << fine))
        first = texels, offsets[p, fine], widths[p, fine], heights[p, fine]
        lower = _within(*first, scale, x, y)
        second = texels, offsets[p, fine + 1], widths[p, fine + 1], heights[p, fine + 1]
        upper = _within(*second, np.float32(scale * _HALF), x, y)
        grey[n] = lower + (level - np.float32(fine)) * (upper - lower)


def sample_textures_numpy(
    texels: _Texels,
    offsets: IntArray,
    widths: IntArray,
    heights: IntArray,
    texels_m: _Single,
    panel: IntArray,
    footprint: _Single,
    a: _Single,
    b: _Single,
    grey: _Single,
) -> None:
    """`sample_textures` in NumPy."""
    texel_m = texels_m[panel]
    level = np.clip(np.log2(footprint / texel_m), 0.0, offsets.shape[1] - _BORDER)
    fine = level.astype(np.int64)
    x, y = a / texel_m - _HALF, b / texel_m - _HALF
    values = []
    for at in (fine, fine + 1):
        scale, width = np.ldexp(_ONE, -at), widths[panel, at]
        u = np.clip(x * scale, 0, (width - _BORDER).astype(np.float32))
        v = np.clip(y * scale, 0, (heights[panel, at] - _BORDER).astype(np.float32))
        column, line = u.astype(np.int64), v.astype(np.int64)
        u, v = u - column.astype(np.float32), v - line.astype(np.float32)
        place = offsets[panel, at] + line * width + column
        left, right, below_left, below_right = (
            texels[place + n].astype(np.float32) for n in (0, 1, width, width + 1)
        )
        top, bottom = left + u * (right - left), below_left + u * (below_right - below_left)
        values.append(top + v * (bottom - top))
    grey[:] = values[0] + (level - fine).astype(np.float32) * (values[1] - values[0])
