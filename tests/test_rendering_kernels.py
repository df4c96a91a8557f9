# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The kernels of the renderer do what their NumPy forms do, in single precision."""

import numpy as np

from slam_graph.kernels.wall_rendering import (
    cast_rays,
    cast_rays_numpy,
    sample_textures,
    sample_textures_numpy,
)


def test_walls_that_are_met_and_their_textures() -> None:
    """In single precision: where two panels are as near, or at an edge, roundings choose."""
    rng = np.random.default_rng(1)
    count, panels, levels = 4000, 7, 4
    rays = rng.normal(size=(count, 3)).astype(np.float32)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    frames = np.linalg.qr(rng.normal(size=(panels, 3, 3)))[0].astype(np.float32)
    heights, starts = -rng.uniform(0.5, 3.0, panels), rng.uniform(-3.0, 0.0, (panels, 2))
    sizes = np.full((panels, 2), 5.0)
    places = np.column_stack([heights, starts, sizes]).astype(np.float32)
    numbers = np.arange(3, 3 + panels)
    found = []
    for cast in (cast_rays, cast_rays_numpy):
        hit, at = np.zeros(count, np.int64), np.zeros((4, count), np.float32)
        at[0], at[1] = 1e6, 1.0
        cast(rays, numbers, frames, places, hit, at)
        found.append((hit, at))
    (hit, at), (expected, expected_at) = found
    same = hit == expected
    assert np.count_nonzero(hit) > count // 4
    assert np.count_nonzero(same) > 0.998 * count
    np.testing.assert_allclose(at[:, same], expected_at[:, same], rtol=1e-4, atol=1e-4)

    sides = 2 ** np.arange(levels + 3, 3, -1)
    lengths = np.tile(sides, (3 + panels, 1))
    widths = lengths + 1
    counts = (lengths * widths).ravel()
    offsets = np.append(0, np.cumsum(counts)[:-1]).reshape(lengths.shape)
    texels = rng.integers(0, 256, counts.sum(), np.uint8)
    texels_m = np.full(3 + panels, 0.05, np.float32)
    footprint = (0.01 * at[0]).astype(np.float32)
    grey = []
    for sample in (sample_textures, sample_textures_numpy):
        values = np.empty(count, np.float32)
        of = texels, offsets, widths, lengths, texels_m, hit, footprint, at[2].copy(), at[3].copy()
        sample(*of, values)
        grey.append(values)
    np.testing.assert_allclose(grey[0], grey[1], atol=0.02)
