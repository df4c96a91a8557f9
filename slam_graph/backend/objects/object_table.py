# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""States of objects as rows of `objects.csv`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.objects.object_frame import ObjectDirection
from slam_graph.backend.objects.object_state import ObjectState

_COLUMNS = (
    *("timestamp_ns", "object", "moving", "points", "label", "class"),
    *("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
    *("vx_m_s", "vy_m_s", "vz_m_s"),
    *(f"sigma_rotation_{axis}_rad" for axis in "xyz"),
    *(f"sigma_position_{axis}_m" for axis in "xyz"),
    *(f"sigma_v{axis}_m_s" for axis in "xyz"),
    *("step_s", *(f"step_rotation_{axis}_rad" for axis in "xyz")),
    *(f"step_{axis}_m" for axis in "xyz"),
    *(f"sigma_step_rotation_{axis}_rad" for axis in "xyz"),
    *(f"sigma_step_{axis}_m" for axis in "xyz"),
)

_VECTORS = (("direction", ""), ("rate", "_rad_s"))


def csv_lines(states: Iterable[ObjectState], classes: Mapping[int, str]) -> Iterator[str]:
    """One row for each object and frame. Sigmas of poses and steps are in axes of the object.

    Args:
        states: in the order of the rows.
        classes: name of the class by label.
    """
    yield ",".join(_COLUMNS) + "\n"
    for state in states:
        named = '"{}"'.format(classes.get(state.label, "").replace('"', "'"))
        cells = [str(state.stamp_ns), str(state.number), str(int(state.moving))]
        cells += [str(state.points), str(state.label), named]
        yield ",".join([*cells, *(f"{value:.9g}" for value in _numbers(state))]) + "\n"


def direction_lines(directions: Iterable[ObjectDirection]) -> Iterator[str]:
    """`object_directions.csv`: a row for each object and frame."""
    axes = [f"{name}_{axis}{unit}" for name, unit in _VECTORS for axis in "xyz"]
    columns = ["timestamp_ns", "object", "points", *axes, "sigma_direction_rad", "sigma_rate_rad_s"]
    yield ",".join(columns) + "\n"
    for seen in directions:
        numbers = [*seen.direction, *seen.rate, seen.sigma, seen.rate_sigma]
        cells = [str(seen.stamp_ns), str(seen.number), str(seen.points)]
        yield ",".join([*cells, *(f"{value:.9g}" for value in numbers)]) + "\n"


def _numbers(state: ObjectState) -> Iterator[float]:
    pose = state.world_T_object
    quaternion: Any = pose.rotation().toQuaternion()  # a type that the stubs do not know
    yield from pose.translation()
    yield from quaternion.coeffs()
    yield from state.velocity
    yield from _sigmas(state.covariance)
    yield from _sigmas(state.velocity_covariance)
    if state.step is None:
        yield from [np.nan] * 13
        return
    yield state.step.seconds
    yield from gtsam.Rot3.Logmap(state.step.motion.rotation())
    yield from state.step.motion.translation()
    yield from _sigmas(state.step.covariance)


def _sigmas(covariance: FloatArray) -> FloatArray:
    """Standard deviations (n,) of a covariance (n, n)."""
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))
