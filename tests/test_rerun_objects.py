# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects in Rerun: a frame adds what is new in it, and colours tell what is what."""

from pathlib import Path

import cv2
import gtsam
import numpy as np
from rerun.chunk import RrdReader
from rerun_rows import colour, rows_of

from slam_graph.arrays import FloatArray
from slam_graph.backend import ObjectFrame
from slam_graph.backend.objects.object_state import ObjectState
from slam_graph.sensors import FeatureFrame, FeatureObservations
from slam_graph.visualization.rerun_blueprints import GROWING
from slam_graph.visualization.rerun_objects import TRAILS, ObjectViews, object_colour
from slam_graph.visualization.rerun_palette import GREEN, GREY, SKY, WHITE
from slam_graph.visualization.rerun_stream import RerunStream

PERIOD_NS = 50_000_000
MEMBERS, ALONE, PERHAPS, STATIC, WRONG = range(8), 8, 9, 10, 11
"""Ids of features: of the object, moving alone, perhaps moving, static, and neither."""


def place(frame: int) -> FloatArray:
    """Where the object is."""
    return np.array([0.1 * frame, np.sin(0.3 * frame), 1.0])


def state(frame: int, number: int) -> ObjectState:
    return ObjectState(
        stamp_ns=frame * PERIOD_NS,
        number=number,
        label=0,
        world_T_object=gtsam.Pose3(gtsam.Rot3(), place(frame)),
        covariance=np.eye(6),
        world_T_body=gtsam.Pose3(),
        step=None,
        velocity=np.array([2.0, 0.0, 0.0]),
        velocity_covariance=np.eye(3),
        moving=True,
        points=len(MEMBERS),
    )


def found(frame: int, number: int = 1, seen: bool = True) -> ObjectFrame:
    """An object with eight points, beside features of every other kind."""
    ids = np.arange(12)
    probabilities = np.array([1.0] * 9 + [1.0, 0.0, 1.0])
    hull = np.array([[10.0, 10.0], [90.0, 10.0], [50.0, 70.0]])
    return ObjectFrame(
        [state(frame, number)] if seen else [],
        moving=np.array([*MEMBERS, ALONE, WRONG]),
        wrong=np.array([WRONG]),
        probabilities=(ids, probabilities),
        members=dict.fromkeys(MEMBERS, number),
        clouds={number: place(frame) + np.eye(8, 3)} if seen else {},
        hulls=[(number, hull)] if seen else [],
    )


def features(frame: int) -> FeatureFrame:
    pixels = np.stack([np.arange(12.0), np.arange(12.0)], axis=1) + frame
    return FeatureFrame(0, (FeatureObservations(np.arange(12), pixels, pixels / 400.0),))


class Recorded:
    """What was recorded of objects.

    Attributes:
        rows: of each entity.
        bytes: of all entities of objects.
    """

    def __init__(self, path: Path, frames: list[ObjectFrame]) -> None:
        stream = RerunStream("save", "objects", path)
        views = ObjectViews(stream, "world", "world/body/cam0", shrink=2)
        for number, frame in enumerate(frames):
            stream.at(number, number * PERIOD_NS)
            views.show(frame, features(number))
        stream.close()
        self.rows = rows_of(path)
        self.bytes = sum(
            chunk.to_record_batch().nbytes
            for chunk in RrdReader(path).stream()
            if not chunk.is_static and "objects" in str(chunk.entity_path)
        )

    def pieces(self) -> list[tuple[int, FloatArray]]:
        """Ways (2, 3) of all trails, and the frames at which they were added."""
        rows = self.rows[f"/world/objects/{TRAILS}"]
        return [(row["frame"], np.array(way)) for row in rows for way in row["strips"]]


def test_a_recording_grows_by_the_same_with_every_frame(tmp_path: Path) -> None:
    sizes = [
        Recorded(tmp_path / f"{count}.rrd", [found(frame) for frame in range(count)]).bytes
        for count in (100, 200, 400, 800)
    ]
    # of a trail that is logged as a whole every time, the second part would have twice the first
    first, second, third = np.diff(sizes) / np.array([100, 200, 400])
    np.testing.assert_allclose([second, third], first, rtol=0.02)


def test_a_trail_at_any_time_is_the_way_up_to_then(tmp_path: Path) -> None:
    pieces = Recorded(tmp_path / "trail.rrd", [found(frame) for frame in range(30)]).pieces()
    for now in (1, 7, 29):
        ways = np.array([way for at, way in pieces if at <= now])
        path = np.array([place(frame) for frame in range(now + 1)])
        np.testing.assert_allclose(ways[:, 0], path[:-1], atol=1e-6)
        np.testing.assert_allclose(ways[:, 1], path[1:], atol=1e-6)
    assert f"objects/{TRAILS}" in GROWING, "or the viewer shows the last piece only"


def test_an_object_is_cleared_once_when_it_goes_out_of_sight(tmp_path: Path) -> None:
    seen = [*[True] * 10, *[False] * 15, *[True] * 5, *[False] * 20]
    frames = [found(frame, seen=visible) for frame, visible in enumerate(seen)]
    recorded = Recorded(tmp_path / "clear.rrd", frames)
    cleared = recorded.rows["/world/objects/1"]
    assert [row["frame"] for row in cleared] == [10, 30]
    assert all(row["is_recursive"] == [True] for row in cleared)
    regions = recorded.rows["/world/body/cam0/objects/regions"]
    assert [row["frame"] for row in regions if not row["strips"]] == [10, 30]
    for part in ("points", "velocity"):
        at = [row["frame"] for row in recorded.rows[f"/world/objects/1/{part}"]]
        assert at == np.flatnonzero(seen).tolist()
    # the trail stays, and leads over the gap to where the object is found again
    (gap,) = [way for at, way in recorded.pieces() if at == 25]
    np.testing.assert_allclose(gap, [place(9), place(25)], atol=1e-6)


def test_features_are_coloured_by_what_is_known_of_their_motion(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "tracks.rrd", [found(0, number=3)])
    (row,) = recorded.rows["/world/body/cam0/objects/tracks"]
    colours = [colour(packed) for packed in row["colors"]]
    assert {colours[i] for i in MEMBERS} == {object_colour(3)}
    assert colours[STATIC] == GREEN
    assert colours[PERHAPS] == colours[WRONG] == GREY
    assert colours[ALONE] == object_colour(0)
    assert len({colours[i] for i in (0, STATIC, PERHAPS, ALONE)}) == 4


def test_ten_objects_have_colours_that_can_be_told_apart() -> None:
    numbers = [object_colour(number) for number in range(11)]
    colours = np.array([*numbers, GREEN, GREY, SKY, WHITE], np.float32) / 255.0
    lab = cv2.cvtColor(colours[:, None], cv2.COLOR_RGB2Lab)[:, 0]
    distances = np.linalg.norm(lab[:, None] - lab, axis=2)[:11] + 1e3 * np.eye(11, len(lab))
    # orange and red of the palette of Okabe and Ito are 34 apart, its green and blue 46
    assert distances.min() > 25.0
    assert len({object_colour(number) for number in range(11)}) == 11
