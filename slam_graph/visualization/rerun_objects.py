# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects in Rerun: points, trails and velocities in the world, regions in the image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slam_graph.sensors import FeatureFrame
from slam_graph.visualization.rerun_palette import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    VERMILLION,
    YELLOW,
    Colour,
    Colours,
)
from slam_graph.visualization.rerun_stream import RerunStream

if TYPE_CHECKING:
    from slam_graph.backend import ObjectFrame

_OBJECTS = (ORANGE, PURPLE, YELLOW, VERMILLION, BLUE)
"""Colours of objects: not those of the path and of the features in the state."""
_POINT_RADIUS, _TRAIL_RADIUS, _TRACK_RADIUS = -4.0, -1.5, -3.0
"""In points of the screen."""


def object_colour(number: int) -> Colour:
    """The colour of an object, always the same."""
    return _OBJECTS[number % len(_OBJECTS)]


class ObjectViews:
    """Logs moving objects.

    Args:
        stream: where to.
        world: entity of the world.
        image: entity of the first camera's image.
        shrink: how many pixels of a camera are one on the screen.
    """

    def __init__(self, stream: RerunStream, world: str, image: str, shrink: int) -> None:
        self._stream, self._world, self._image, self._shrink = stream, world, image, shrink
        self._trails: dict[int, list[np.ndarray]] = {}

    def show(self, found: ObjectFrame, features: FeatureFrame) -> None:
        """Log what was found in a frame.

        Args:
            found: objects, their tracks, and the probability that tracks move.
            features: all features of the frame, those that move among them.
        """
        self._show_objects(found)
        self._show_tracks(found, features)

    def _show_objects(self, found: ObjectFrame) -> None:
        rr, world = self._stream.rr, f"{self._world}/objects"
        shown: set[int] = set()
        for state in found.states:
            number, colour = state.number, object_colour(state.number)
            place = np.asarray(state.world_T_object.translation())
            self._trails.setdefault(number, []).append(place)
            shown.add(number)
            cloud = found.clouds.get(number, np.zeros((0, 3)))
            name = f"{world}/{number}"
            self._stream.log(
                f"{name}/points", rr.Points3D(cloud, colors=colour, radii=_POINT_RADIUS)
            )
            trail = np.array(self._trails[number])
            self._stream.log(
                f"{name}/trail", rr.LineStrips3D([trail], colors=colour, radii=_TRAIL_RADIUS)
            )
            speed = f"object {number}, {np.linalg.norm(state.velocity):.1f} m/s"
            arrow = rr.Arrows3D(
                origins=[place],
                vectors=[state.velocity],
                colors=colour,
                labels=[speed if state.moving else f"object {number}, at rest"],
            )
            self._stream.log(f"{name}/velocity", arrow)
        for number in self._trails.keys() - shown:  # it is not seen any more: its trail stays
            for part in ("points", "velocity"):
                self._stream.log(f"{world}/{number}/{part}", rr.Clear(recursive=False))

    def _show_tracks(self, found: ObjectFrame, features: FeatureFrame) -> None:
        rr, seen = self._stream.rr, features.cameras[0]
        regions = [(n, polygon) for n, polygon in found.hulls if len(polygon) > 2]
        self._stream.log(
            f"{self._image}/objects/regions",
            rr.LineStrips2D(
                [np.vstack([p, p[:1]]) / self._shrink for _, p in regions],
                colors=[object_colour(n) if n else GREY for n, _ in regions],
            ),
        )
        moving = (*features.moving, features.cameras[0])[0]
        ids = np.concatenate([seen.ids, moving.ids]) if features.moving else seen.ids
        pixels = np.concatenate([seen.pixels, moving.pixels]) if features.moving else seen.pixels
        known, probabilities = found.probabilities
        rows = np.isin(ids, known)
        chosen = probabilities[np.searchsorted(known, ids[rows])]
        points = rr.Points2D(
            pixels[rows] / self._shrink,
            colors=_colours(ids[rows], chosen, found.members),
            radii=_TRACK_RADIUS,
        )
        self._stream.log(f"{self._image}/objects/tracks", points)


def _colours(ids: np.ndarray, probabilities: np.ndarray, members: dict[int, int]) -> Colours:
    """Colours (N, 3): of its object, or from green (static) to grey (it may move)."""
    part = np.clip(probabilities, 0.0, 1.0)[:, None]
    colours = (1.0 - part) * np.array(GREEN) + part * np.array(GREY)
    for row, feature in enumerate(ids.tolist()):
        if feature in members:
            colours[row] = object_colour(members[feature])
    return np.asarray(colours, np.uint8)
