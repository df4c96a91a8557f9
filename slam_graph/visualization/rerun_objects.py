# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects in Rerun: points, trails and velocities in the world, regions in the image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.sensors import FeatureFrame
from slam_graph.visualization.rerun_images import on_screen
from slam_graph.visualization.rerun_palette import (
    GREEN,
    GREY,
    OBJECTS,
    PURPLE,
    Colour,
    Colours,
)
from slam_graph.visualization.rerun_stream import RerunStream

if TYPE_CHECKING:
    from slam_graph.backend import ObjectFrame

TRAILS = "trails"
"""Entity, below that of all objects, of the ways they have come: one for all, so that the layout
can say that it accumulates before any object is known."""

_POINT_RADIUS, _TRAIL_RADIUS, _TRACK_RADIUS, _REGION_RADIUS = -4.0, -1.5, -3.0, -1.5
"""In points of the screen."""


def object_colour(number: int) -> Colour:
    """The colour of an object by its number, from 1; 0 is what moves and is of no object."""
    return OBJECTS[(number - 1) % len(OBJECTS)] if number else PURPLE


class ObjectViews:
    """Logs moving objects. A frame logs no more than what is new in it.

    Args:
        stream: where to.
        world: entity of the world.
        image: entity of the first camera's image.
        shrink: how many pixels of a camera are one on the screen.
    """

    def __init__(self, stream: RerunStream, world: str, image: str, shrink: int) -> None:
        self._stream, self._world, self._shrink = stream, f"{world}/objects", shrink
        self._image = f"{image}/objects"
        self._trails: dict[int, list[FloatArray]] = {}
        self._seen: set[int] = set()
        self._watching, self._regions = False, 0

    def show(self, found: ObjectFrame, features: FeatureFrame) -> None:
        """Log what was found in a frame.

        Args:
            found: objects, their tracks, and the probability that tracks move.
            features: all features of the frame, those that move among them.
        """
        if not self._watching:
            self._watching = True
            self._style()
        self._show_objects(found)
        self._show_trails(found)
        self._show_regions(found)
        self._show_tracks(found, features)

    @property
    def places(self) -> FloatArray:
        """(N, 3) where objects were so far, m."""
        trails = [np.array(trail) for trail in self._trails.values()]
        return np.concatenate([np.zeros((0, 3)), *trails])

    def _style(self) -> None:
        """Send once what all frames have in common."""
        rr = self._stream.rr
        for entity, style in {
            f"{self._world}/{TRAILS}": rr.LineStrips3D.from_fields(radii=[_TRAIL_RADIUS]),
            f"{self._image}/regions": rr.LineStrips2D.from_fields(radii=[_REGION_RADIUS]),
            f"{self._image}/tracks": rr.Points2D.from_fields(radii=[_TRACK_RADIUS]),
        }.items():
            self._stream.log(entity, style, static=True)

    def _show_objects(self, found: ObjectFrame) -> None:
        """The points and velocities of the objects that are seen."""
        rr, seen = self._stream.rr, {state.number for state in found.states}
        for state in found.states:
            number, colour = state.number, object_colour(state.number)
            cloud = found.clouds.get(number, np.zeros((0, 3)))
            points = rr.Points3D(cloud, colors=colour, radii=_POINT_RADIUS)
            self._stream.log(f"{self._world}/{number}/points", points)
            speed = f"object {number}, {np.linalg.norm(state.velocity):.1f} m/s"
            arrow = rr.Arrows3D(
                origins=[state.world_T_object.translation()],
                vectors=[state.velocity],
                colors=colour,
                labels=[speed if state.moving else f"object {number}, at rest"],
            )
            self._stream.log(f"{self._world}/{number}/velocity", arrow)
        for number in self._seen - seen:  # it has just gone out of sight; its trail stays
            self._stream.log(f"{self._world}/{number}", rr.Clear(recursive=True))
        self._seen = seen

    def _show_trails(self, found: ObjectFrame) -> None:
        """The ways that objects came since they were seen last."""
        ways, colours = [], []
        for state in found.states:
            place = np.asarray(state.world_T_object.translation())
            trail = self._trails.setdefault(state.number, [])
            trail.append(place)
            if len(trail) > 1:
                ways.append(trail[-2:])
                colours.append(object_colour(state.number))
        if ways:
            self._stream.log_rows(
                f"{self._world}/{TRAILS}",
                self._stream.rr.LineStrips3D,
                strips=np.array(ways),
                colors=np.array(colours, np.uint8),
            )

    def _show_regions(self, found: ObjectFrame) -> None:
        """Where features of objects, and of what may become one, are looked for in the image."""
        regions = [(number, hull) for number, hull in found.hulls if len(hull) > 2]
        if not regions and not self._regions:
            return  # nothing to show, and nothing to take away
        self._regions = len(regions)
        lines = self._stream.rr.LineStrips2D.from_fields(
            strips=[on_screen(np.vstack([hull, hull[:1]]), self._shrink) for _, hull in regions],
            colors=[object_colour(number) for number, _ in regions],
            labels=[str(number) if number else "moving" for number, _ in regions],
        )
        self._stream.log(f"{self._image}/regions", lines)

    def _show_tracks(self, found: ObjectFrame, features: FeatureFrame) -> None:
        """The features in the image, by what is known of their motion."""
        seen = features.cameras[0]
        if features.moving:
            seen = seen.joined(features.moving[0])
        known, probabilities = found.probabilities
        rows = np.isin(seen.ids, known)
        ids = seen.ids[rows]
        chosen = probabilities[np.searchsorted(known, ids)]
        self._stream.log_rows(
            f"{self._image}/tracks",
            self._stream.rr.Points2D,
            positions=on_screen(seen.pixels[rows], self._shrink),
            colors=_colours(ids, chosen, found),
        )


def _colours(ids: IntArray, probabilities: FloatArray, found: ObjectFrame) -> Colours:
    """Colours (N, 3) of features.

    That of its object; purple where it moves and is of no object; else from green (static) to grey
    (it may move).

    Args:
        ids: (N,) of the features.
        probabilities: (N,) that each moves.
        found: which of them do.
    """
    part = np.clip(probabilities, 0.0, 1.0)[:, None]
    colours = (1.0 - part) * np.array(GREEN) + part * np.array(GREY)
    colours[np.isin(ids, np.setdiff1d(found.moving, found.wrong))] = PURPLE
    for row, feature in enumerate(ids.tolist()):
        if feature in found.members:
            colours[row] = object_colour(found.members[feature])
    return np.asarray(colours, np.uint8)
