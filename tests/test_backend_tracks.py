# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The tracks of the window: under which angles two frames see the same features."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.backend.cost.feature_tracks import FeatureTracks, Outcome, is_in
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of, imu_state_keys
from slam_graph.backend.window import Window
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations

POINTS = np.random.default_rng(0).uniform([-2.0, -2.0, 3.0], [2.0, 2.0, 9.0], (50, 3))


def seen(turn: NDArray[np.float64], place: NDArray[np.float64], ids: slice) -> FeatureFrame:
    """What a camera at a place, turned by `turn`, sees of some points."""
    local = (POINTS - place)[ids] @ turn
    normalized = local[:, :2] / local[:, 2:]
    numbers = np.arange(len(POINTS), dtype=np.int64)[ids]
    observed = FeatureObservations(numbers, normalized.astype(np.float32), normalized)
    return FeatureFrame(0, (observed,))


def test_parallax_is_of_the_place_and_not_of_the_direction() -> None:
    turn = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    here, there = np.zeros(3), np.array([0.4, -0.1, 0.2])
    tracks = FeatureTracks()
    tracks.add(0, seen(np.eye(3), here, slice(0, 40)))
    tracks.add(1, seen(turn, here, slice(0, 40)))
    tracks.add(2, seen(turn, there, slice(10, 50)))
    np.testing.assert_allclose(tracks.parallax(0, 1, [turn.T]), 0.0, atol=1e-12)
    both = POINTS[10:40]
    cosine = np.sum(both * (both - there), axis=1)
    cosine /= np.linalg.norm(both, axis=1) * np.linalg.norm(both - there, axis=1)
    np.testing.assert_allclose(tracks.parallax(0, 2, [turn.T]), np.arccos(cosine), atol=1e-9)


def test_parallax_is_the_same_in_the_second_camera_when_the_first_one_is_lost() -> None:
    turn, mounted = (Rotation.from_rotvec(v).as_matrix() for v in ([0.1, -0.2, 0.3], [0, 0, 0.2]))
    turns = [turn.T, mounted.T @ turn.T @ mounted]
    begin, end = (np.eye(3), np.zeros(3)), (turn, np.array([0.4, -0.1, 0.2]))

    def angles(*parts: slice) -> NDArray[np.float64]:
        """What each of two cameras at one place sees at the end; at the beginning they see all."""
        tracks = FeatureTracks()
        for index, (R, t), slices in ((0, begin, [slice(None)] * len(parts)), (1, end, parts)):
            views = [seen(R @ M, t, s) for M, s in zip((np.eye(3), mounted), slices, strict=True)]
            tracks.add(index, FeatureFrame(index, tuple(view.cameras[0] for view in views)))
        return tracks.parallax(0, 1, turns)

    nothing, everything = slice(0, 0), slice(None)
    assert len(angles(everything, nothing)) == len(POINTS)
    for parts in ((everything, everything), (nothing, everything)):
        np.testing.assert_allclose(angles(*parts), angles(everything, nothing), atol=1e-9)
    assert len(angles(nothing, nothing)) == 0


@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint16])
def test_ids_of_any_integers_can_be_compared(kind: type) -> None:
    """Also those of a file in memory, which cannot be written to."""
    values = np.frombuffer(np.array([7, 3, 9], kind).tobytes(), kind)
    ascending = np.frombuffer(np.array([3, 4, 9], kind).tobytes(), kind)
    assert not values.flags.writeable
    assert is_in(values, ascending).tolist() == [False, True, True]


def test_features_that_are_lost_come_first_and_others_keep_their_order() -> None:
    layout = Layout(dims_of([L(8), L(3), X(0), L(5), *imu_state_keys(1)]))
    window = Window(2, 0, State(), SquareRootInformation(layout, np.eye(layout.size + 1)))
    window.tracks.seen = np.array([2, 3, 5, 9])
    # of the new features 2, 4 and 9 one is lost already: nothing is known of it
    keys = window.keys([0, 1], [1], np.array([2, 3, 4, 5, 8, 9]))
    motion = [*imu_state_keys(1), *imu_state_keys(2)]
    assert keys == [L(8), L(3), L(5), L(2), L(9), X(0), *motion]


def test_the_table_of_outcomes_is_the_code() -> None:
    """docs/engine.md names for each outcome the function that decides it, which uses it."""
    root = Path(__file__).parent.parent
    page = (root / "docs" / "engine.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \|[^|]*\| `([\w.]+)` \|$", page, re.M))
    assert rows.keys() == {outcome.value for outcome in Outcome}
    uses: dict[str, str] = {}
    for path in (root / "slam_graph" / "backend").rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ClassDef):
                for inner in node.body:
                    if isinstance(inner, ast.FunctionDef):
                        uses[f"{node.name}.{inner.name}"] = ast.unparse(inner)
            elif isinstance(node, ast.FunctionDef):
                uses[node.name] = ast.unparse(node)
    for value, function in rows.items():
        assert function in uses, f"{value}: no {function}"
        assert f"Outcome.{Outcome(value).name}" in uses[function], f"{function}: not {value}"
