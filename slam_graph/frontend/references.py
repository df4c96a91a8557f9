# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which cameras of a rig see the same: each that does is matched to an earlier one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam_graph.sensors.rig import Rig, RigCamera

GRID = 8
"""Rays through GRID x GRID pixels are followed into the other camera."""

DEPTHS_M = (1.0, 3.0, 10.0, 100.0)
"""How far away points may be that both see."""

MIN_SHARE = 0.25
"""A camera that sees less than this of another one's view has features of its own."""

MAX_TANGENT = 3.0
"""Points further from the axis than this are outside of any camera."""


def reference_cameras(rig: Rig) -> tuple[int, ...]:
    """For each camera the one whose features it looks for: an earlier one, or itself."""
    references: list[int] = []
    for index, mounted in enumerate(rig.cameras):
        leaders = [i for i in sorted(set(references)) if references[i] == i]
        shares = [overlap(rig.cameras[i], mounted) for i in leaders]
        if shares and max(shares) >= MIN_SHARE:
            references.append(leaders[int(np.argmax(shares))])
        else:
            references.append(index)
    return tuple(references)


def overlap(reference: RigCamera, other: RigCamera) -> float:
    """The share of a camera's view that another one sees too, at the depth where it is largest."""
    camera = reference.camera
    u, v = np.meshgrid(
        np.linspace(0, camera.width - 1, GRID), np.linspace(0, camera.height - 1, GRID)
    )
    rays, usable = camera.visible(np.column_stack([u.ravel(), v.ravel()]))
    if not usable.any():
        return 0.0
    rays = rays[usable]
    ends = np.column_stack([rays, np.ones(len(rays))])
    other_T_reference = other.body_T_camera.between(reference.body_T_camera)
    shares = []
    for depth_m in DEPTHS_M:
        points = np.asarray(other_T_reference.transformFrom((depth_m * ends).T)).T
        shares.append(float(np.mean(_sees(other, points))))
    return max(shares)


def _sees(mounted: RigCamera, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (N, 3) of its frame a camera sees."""
    camera = mounted.camera
    ahead = points[:, 2] > 0
    m = points[:, :2] / np.where(ahead, points[:, 2], np.inf)[:, None]
    ahead &= np.all(np.abs(m) < MAX_TANGENT, axis=1)
    pixels = camera.distort(np.where(ahead[:, None], m, 0.0))[0]
    sees: NDArray[np.bool_] = (
        ahead & np.all(pixels >= 0, axis=1) & np.all(pixels < (camera.width, camera.height), axis=1)
    )
    return sees
