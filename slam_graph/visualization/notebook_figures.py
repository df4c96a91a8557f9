# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What `plot()` of trajectories, errors and maps draws, and the small pictures in Jupyter.

`slam_graph/display.py` calls these functions by their names.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.geometry import Trajectory
from slam_graph.sensors import ImuData
from slam_graph.visualization.panels import Panel, panel_figure
from slam_graph.visualization.style import Picture

_SKETCH_INCHES = (3.6, 2.9)
_SERIES = ("x [m]", "y [m]", "z [m]", "yaw [deg]")


def path_figure(paths: Mapping[str, Trajectory], points: FloatArray | None = None) -> Picture:
    """Paths from above and from the side.

    Args:
        paths: by their names.
        points: (P, 3) features around them, if there are any.
    """
    return panel_figure("", _path_panels(paths, points), ("A", "B"), *_sketched(2))


def trajectory_figure(trajectory: Trajectory, others: Mapping[str, Trajectory]) -> Picture:
    """Paths from above and from the side, and x, y, z and yaw over time.

    Args:
        trajectory: the first.
        others: further ones in the same world, by their names; `_` stands for a blank.
    """
    paths = {"trajectory": trajectory}
    paths |= {name.replace("_", " "): other for name, other in others.items()}
    start_ns = min((int(t.stamps_ns[0]) for t in paths.values() if len(t)), default=0)
    series = {
        name: np.asarray((t.stamps_ns - start_ns) * 1e-9) for name, t in paths.items() if len(t)
    }
    values = {name: _position_and_yaw(paths[name]) for name in series}
    panels = _path_panels(paths)
    panels += [
        Panel(
            "time [s]",
            label,
            {name: (seconds, values[name][:, k]) for name, seconds in series.items()},
            "series",
        )
        for k, label in enumerate(_SERIES)
    ]
    title = "  ·  ".join(
        f"{name}: {len(t)} poses, {t.duration_s:.1f} s, {t.length_m:.1f} m"
        for name, t in paths.items()
    )
    return panel_figure(title, panels, ("AAAAABBB", "CDEF"), (5.0, 5.4), 6.2)


def recording_figure(title: str, imu: ImuData | None, truth: Trajectory | None) -> Picture:
    """What the IMU measured, and the true path.

    Args:
        title: of the picture.
        imu: all samples, if there is an IMU.
        truth: ground truth, if there is one.
    """
    panels = [] if truth is None else _path_panels({"ground truth": truth})
    if imu is not None and len(imu):
        seconds = np.asarray((imu.stamps_ns - imu.stamps_ns[0]) * 1e-9)
        for label, values in (("gyroscope [rad/s]", imu.gyro), ("accelerometer [m/s²]", imu.accel)):
            curves = {axis: (seconds, values[:, k]) for k, axis in enumerate("xyz")}
            panels.append(Panel("time [s]", label, curves, "series"))
    if truth is None:
        return panel_figure(title, panels, ("AB"[: len(panels)],), (8.0,), 4.4)
    columns = ("AAABB", "CD") if len(panels) > 2 else ("A", "B")
    return panel_figure(title, panels, columns, (4.0, 5.6), 4.4)


def error_figure(stamps_ns: IntArray, values: FloatArray, label: str, rmse: float) -> Picture:
    """Errors over time, and how they are distributed.

    Args:
        stamps_ns: (N,) their times.
        values: (N,).
        label: their name and unit.
        rmse: their root mean square.
    """
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    ordered = np.sort(values)
    share = np.arange(1, len(ordered) + 1) / len(ordered)
    panels = [
        Panel("time [s]", label, {"error": (seconds, values)}),
        Panel(label, "share of the poses below", {"error": (ordered, share)}, "series"),
    ]
    return panel_figure(f"RMSE {rmse:.4g}", panels, ("A", "B"), (5.0, 3.0), 2.7)


def map_figure(points: FloatArray, paths: Mapping[str, Trajectory]) -> Picture:
    """The features of a map and the keyframes of its recordings.

    Args:
        points: (P, 3).
        paths: the keyframes, by the names of the recordings.
    """
    return panel_figure("", _path_panels(paths, points), ("A", "B"), *_sketched(2, 1.35))


def _sketched(columns: int, scale: float = 1.0) -> tuple[tuple[float, ...], float]:
    """Widths and height of a small picture."""
    return (scale * _SKETCH_INCHES[0],) * columns, scale * _SKETCH_INCHES[1]


def _path_panels(paths: Mapping[str, Trajectory], points: FloatArray | None = None) -> list[Panel]:
    """From above and from the side."""
    return [
        Panel(
            "x [m]",
            f"{'xyz'[axis]} [m]",
            {name: (t.positions[:, 0], t.positions[:, axis]) for name, t in paths.items()},
            "path",
            dots=None if points is None or not len(points) else points[:, [0, axis]],
            title=title,
        )
        for axis, title in ((1, "from above"), (2, "from the side"))
    ]


def _position_and_yaw(trajectory: Trajectory) -> FloatArray:
    """(N, 4) x, y, z [m] and yaw [deg], which goes on beyond ±180° instead of jumping."""
    R = Rotation.from_quat(trajectory.quaternions).as_matrix()
    yaw = np.degrees(np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0])))
    return np.column_stack([trajectory.positions, yaw])
