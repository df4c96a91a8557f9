# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The Rerun viewer inside a notebook, with the paths and the features of a run."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec

import numpy as np
from matplotlib.colors import to_rgb

from slam_graph.arrays import FloatArray
from slam_graph.errors import ConfigError
from slam_graph.geometry import Trajectory
from slam_graph.visualization.style import line_styles

_TRUTH = "ground truth"


def show_inline(
    paths: Mapping[str, Trajectory],
    truth: Trajectory | None,
    points: FloatArray,
    size: tuple[int, int],
) -> None:
    """Show paths and features in the viewer, below the cell.

    Args:
        paths: by their names, in one world.
        truth: ground truth in this world, or None.
        points: (P, 3) features.
        size: width and height in pixels.

    Raises:
        ConfigError: if the viewer for notebooks is not installed.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    if find_spec("rerun_notebook") is None:
        raise ConfigError(
            "the viewer in a notebook needs one more package: pip install 'rerun-sdk[notebook]'"
        )
    stream = rr.RecordingStream("slam_graph")
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    shown = ({} if truth is None else {_TRUTH: truth}) | dict(paths)
    for name, style in line_styles(shown).items():
        entity = f"world/{name.replace(' ', '_')}"
        colour = tuple(round(255 * part) for part in to_rgb(style.color))
        strip = rr.LineStrips3D([shown[name].positions], colors=[colour], labels=[name])
        stream.log(entity, strip, static=True)
        stamps = shown[name].stamps_ns
        stream.send_columns(
            f"{entity}/body",
            [rr.TimeColumn("sensor_time", timestamp=stamps.astype("datetime64[ns]"))],
            rr.Points3D.columns(
                positions=shown[name].positions,
                colors=[colour] * len(stamps),
                radii=np.full(len(stamps), 0.03),
            ),
        )
    stream.log(
        "world/features", rr.Points3D(points, radii=0.01, colors=[150, 150, 150]), static=True
    )
    blueprint = rrb.Blueprint(rrb.Spatial3DView(origin="world"), collapse_panels=True)
    rr.notebook_show(width=size[0], height=size[1], blueprint=blueprint, recording=stream)
