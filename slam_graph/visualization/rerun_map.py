# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Maps in Rerun: their points, keyframes and links; and the points of a run as they come."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.maps import SlamMap
from slam_graph.visualization.rerun_blueprints import SQUARE, Eye, space, whole
from slam_graph.visualization.rerun_outcome import END_RADIUS, POINT_RADIUS, FinishedRun
from slam_graph.visualization.rerun_palette import CYCLE, GREEN, robust_range, scaled
from slam_graph.visualization.rerun_stream import RerunStream

_FEWEST_FOR_RANGE = 50
"""Points from which the range of heights is taken where it cannot wait for all of them."""


class MapLog:
    """The points that a run leaves behind, coloured by their height on one scale.

    In a file the scale is that of all points. Where somebody watches, it is that of the first ones:
    it cannot change any more without changing what earlier colours mean.

    Args:
        stream: where they go.
        world: entity of the world of the run.
    """

    def __init__(self, stream: RerunStream, world: str) -> None:
        self._stream, self._entity = stream, f"{world}/map/points"
        self._times: list[tuple[int, int]] = []
        self._waiting: list[FloatArray] = []
        self._range: tuple[float, float] | None = None
        self._sent: list[FloatArray] = []

    @property
    def points(self) -> FloatArray:
        """(P, 3) all that were sent, m."""
        return np.concatenate([*self._sent, np.zeros((0, 3))])

    def add(self, number: int, stamp_ns: int, points: FloatArray) -> None:
        """Add points (N, 3) that were left at a frame."""
        if not len(points):
            return
        self._times.append((number, stamp_ns))
        self._waiting.append(points)
        if self._stream.saves:
            return
        enough = sum(map(len, self._waiting)) >= _FEWEST_FOR_RANGE
        if enough or self._range is not None:
            self.flush()

    def flush(self) -> None:
        """Send the points that are kept."""
        if not self._times:
            return
        points = np.concatenate(self._waiting)
        self._range = self._range or robust_range(points[:, 2])
        cloud = self._stream.rr.Points3D.columns(
            positions=points, colors=scaled(points[:, 2], *self._range)
        )
        frames, stamps_ns = np.array(self._times, np.int64).T
        rows = cloud.partition([len(part) for part in self._waiting])
        self._stream.send_columns(self._entity, frames, stamps_ns, rows)
        self._sent.append(points)
        self._times, self._waiting = [], []


def show_map(stream: RerunStream, content: SlamMap) -> None:
    """Log a map: points by the number of their observations, keyframes and links."""
    import rerun.blueprint as rrb

    log_map(stream, "map", content)
    sizes = content.summary()
    rows = "\n".join(
        f"| {name.replace('_', ' ')} | {sizes[name]} |"
        for name in ("keyframes", "features", "observations", "links", "words", "created")
    )
    names = ", ".join(recording.name for recording in content.recordings)
    text = (
        f"# Map of {names}\n\n| | |\n|---|---|\n{rows}\n\n**Points** are coloured by the number of "
        "their observations: dark blue few, yellow many. Lines through the keyframes have a colour "
        "for each recording; green lines are links between keyframes of the same place."
    )
    stream.log("summary", stream.rr.TextDocument(text, media_type="text/markdown"), static=True)
    eye = Eye.on(content.poses.translations, content.points, SQUARE)
    stream.arrange(
        whole(
            rrb.Horizontal(
                space("Map", "/map", eye=eye),
                rrb.TextDocumentView(name="Summary", origin="/summary"),
                column_shares=[78, 22],
            ),
            timeline=None,
        )
    )


def places_in_map(run: FinishedRun, known_map: SlamMap | None) -> FloatArray | None:
    """(N, 3) where a run was in a map, and the keyframes of this; None if it was not located."""
    if run.in_map is None or len(run.in_map) == 0:
        return None
    keyframes = np.zeros((0, 3)) if known_map is None else known_map.poses.translations
    return np.concatenate([run.in_map.positions, keyframes])


def log_map(stream: RerunStream, entity: str, content: SlamMap) -> None:
    """Log the points, keyframes and links of a map.

    Args:
        stream: where it goes.
        entity: of its world.
        content: the map.
    """
    rr, places = stream.rr, content.poses.translations
    stream.log(entity, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    known = content.features[content.features >= 0]
    views = np.bincount(known, minlength=len(content.points)).astype(np.float64)
    colours = scaled(np.log(np.maximum(views, 1.0)), 0.0, robust_range(np.log1p(views))[1])
    cloud = rr.Points3D(content.points, colors=colours, radii=POINT_RADIUS)
    stream.log(f"{entity}/points", cloud, static=True)
    for number, trajectory in enumerate(content.trajectories()):
        colour = CYCLE[number % len(CYCLE)]
        name = f"{entity}/recordings/{number}"
        path = rr.LineStrips3D([trajectory.positions], colors=colour, radii=-1.0)
        stream.log(name, path, static=True)
        marks = rr.Points3D(trajectory.positions, colors=colour, radii=-2.0)
        stream.log(f"{name}/keyframes", marks, static=True)
    if len(content.links):
        ends = places[content.links.ends]
        stream.log(f"{entity}/links", rr.LineStrips3D(ends, colors=GREEN, radii=-0.7), static=True)
        # both ends are at one place: the line between them alone would hardly be seen
        marks = rr.Points3D(ends.reshape(-1, 3), colors=GREEN, radii=END_RADIUS)
        stream.log(f"{entity}/links/ends", marks, static=True)
