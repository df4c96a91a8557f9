# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose graph files: conventions, round trips, and everything that can be wrong with them."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from pose_graphs import laps

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError
from slam_graph.pose_graph.graph_files import g2o_lines, read_pose_graph
from slam_graph.pose_graph.gtsam_graph import edge_factors, factor_graph, values_of

V2 = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n"
E2 = "EDGE_SE2 0 1 1 0 0.1 4 0 0 4 0 9\n"
V3 = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n"
TRIANGLE = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 4 0 0 4 0 4"
E3 = f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {TRIANGLE}\n"


def read(tmp_path: Path, text: str, diagnostics: Diagnostics | None = None):
    path = tmp_path / "graph.g2o"
    path.write_text(text)
    return read_pose_graph(path, diagnostics)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("meaning", ["angle", "quaternion"])
def test_written_and_read_again_is_the_same(tmp_path: Path, dimension: int, meaning: str) -> None:
    graph, truth = laps(dimension, 0.1)
    path = tmp_path / "graph.g2o"
    path.write_text("".join(g2o_lines(graph, truth)))
    again = read_pose_graph(path, rotation_information=meaning)
    assert again.estimates is not None
    assert np.array_equal(again.keys, graph.keys)
    assert np.array_equal(again.edges, graph.edges)
    assert np.array_equal(again.information, graph.information)
    for mine, theirs in ((again.measured, graph.measured), (again.estimates, truth)):
        np.testing.assert_allclose(mine.rotations, theirs.rotations, atol=1e-15)
        assert np.array_equal(mine.translations, theirs.translations)


@pytest.mark.parametrize(
    ("name", "in_space"),
    [("noisyToyGraph.txt", False), ("pose2example.txt", False), ("pose3example.txt", True)],
)
def test_g2o_files_mean_what_they_mean_to_gtsam(
    gtsam_data: Path, name: str, in_space: bool
) -> None:
    theirs, values = gtsam.readG2o(str(gtsam_data / name), in_space)
    graph = read_pose_graph(gtsam_data / name)
    assert graph.estimates is not None
    ours = factor_graph(edge_factors(graph))
    # Angles of measurements have six digits, and quaternions are not of unit length to the last.
    assert ours.error(values_of(graph.estimates)) == pytest.approx(theirs.error(values), rel=1e-6)


def test_toro_in_space_has_translation_before_rotation(gtsam_data: Path, data_dir: Path) -> None:
    toro = read_pose_graph(gtsam_data / "sphere2500.txt")
    g2o = read_pose_graph(data_dir / "posegraphs" / "sphere2500.g2o")
    assert toro.estimates is None
    ours, theirs = (graph.keep_edges(np.lexsort(graph.edges.T)) for graph in (toro, g2o))
    assert np.array_equal(ours.edges, theirs.edges)
    np.testing.assert_allclose(ours.measured.translations, theirs.measured.translations, atol=1e-4)
    np.testing.assert_allclose(ours.measured.rotations, theirs.measured.rotations, atol=1e-4)
    # The g2o file is of the quaternion's vector part, the TORO file of the angle: a factor of 4.
    np.testing.assert_allclose(toro.information[0, :3, :3], g2o.information[0, :3, :3], atol=1e-3)
    ratio = np.trace(g2o.information[0, 3:, 3:]) / np.trace(toro.information[0, 3:, 3:])
    assert ratio == pytest.approx(4.0, rel=0.01)


def test_toro_on_the_plane_orders_the_information_its_own_way(tmp_path: Path) -> None:
    graph = read(tmp_path, "EDGE2 0 1 1 0 0.1 1 0.1 2 3 0.2 0.3\n")
    expected = [[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]]
    np.testing.assert_array_equal(graph.information[0], expected)


def test_toro_on_the_plane_by_rows_is_understood(gtsam_data: Path) -> None:
    graph = read_pose_graph(gtsam_data / "w20000.txt")
    np.testing.assert_allclose(graph.information[0], np.diag([3.16228, 3.16228, 5.0]))


def test_toro_without_information_has_the_identity(gtsam_data: Path) -> None:
    graph = read_pose_graph(gtsam_data / "sphere_smallnoise.graph")
    assert len(graph.edges) == 8647
    np.testing.assert_array_equal(graph.information[0], np.eye(6))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no edges"),
        ("\x00\x01\x02", "no edges"),
        (V2, "no edges"),
        ("VERTEX_SE2 0 0 0 0\n", "no edges"),
        (V2 + E2.replace("0 1 1 0", "0 7 1 0", 1), "graph.g2o:3: edge to vertex 7"),
        (V2 + E2.replace("0.1", "nan"), "graph.g2o:3: a number is not finite"),
        (V2.replace("1 1 0 0", "1 inf 0 0") + E2, "graph.g2o:2: a number is not finite"),
        (V2 + E2.replace("4 0 9", "-4 0 9"), "graph.g2o:3: the information matrix is not positive"),
        (V2 + E2.replace("4 0 9", "4 0 0"), "graph.g2o:3: the information matrix is not positive"),
        (V2 + E2[:24], "graph.g2o:3: "),
        (V2 + E2 + E2[:20], "graph.g2o:4: "),
        (V2 + E2.replace("0.1", "x"), "graph.g2o:3: 'x' in column"),
        (V2 + E2.replace("0 1 1", "0 1.5 1"), "graph.g2o:3: "),
        (V2 + "EDGE_SE2 0 0 1 0 0 1 0 0 1 0 1\n", "no edges between two poses"),
        (V2 + V3 + E3, "2D and 3D"),
        (V3 + E3.replace("0 0 0 1 1", "0 0 0 0 1"), "graph.g2o:3: the quaternion is not of"),
        (V3.replace("0 1\n", "0 1e17\n") + E3, "graph.g2o:1: the quaternion is not of"),
        (
            V3.replace("0 1\n", "0 1e300\n") + E3,
            "graph.g2o:1: a number is not finite, or too large",
        ),
        (
            V2 + E2.replace("4 0 9", "4 0 1e308"),
            "graph.g2o:3: a number is not finite, or too large",
        ),
    ],
)
def test_bad_files_are_refused_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError) as caught:
        read(tmp_path, text)
    assert message in str(caught.value)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        read_pose_graph(tmp_path / "none.g2o")


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        (V2 + "VERTEX_SE2 1 5 5 5\n" + E2, "pose_graph_repeated_vertex"),
        (V2 + "EDGE_SE2 1 1 1 0 0 1 0 0 1 0 1\n" + E2, "pose_graph_edge_to_itself"),
        (V2 + "FIX 0\n" + E2, "pose_graph_line_ignored"),
        (V2 + "VERTEX_SE2 2 9 9 0\n" + E2, "pose_graph_not_connected"),
    ],
)
def test_harmless_faults_are_counted(tmp_path: Path, text: str, kind: str) -> None:
    diagnostics = Diagnostics()
    graph = read(tmp_path, text + "# a comment\n\n", diagnostics)
    assert dict(diagnostics.counts) == {kind: 1}
    assert graph.estimates is not None
    np.testing.assert_array_equal(graph.estimates.translations[1], [1.0, 0.0])
    assert len(graph.edges) == 1


def test_ids_need_not_begin_at_zero_nor_be_in_order(tmp_path: Path) -> None:
    text = "VERTEX_SE2 900 2 0 0\nVERTEX_SE2 -3 1 0 0\nEDGE_SE2 900 -3 -1 0 0 1 0 0 1 0 1\n"
    graph = read(tmp_path, text)
    assert graph.keys.tolist() == [-3, 900]
    assert graph.edges.tolist() == [[1, 0]]
    assert graph.is_odometry.tolist() == [True]


def test_an_unknown_meaning_of_the_information_is_refused(tmp_path: Path) -> None:
    (tmp_path / "graph.g2o").write_text(V3 + E3)
    with pytest.raises(ConfigError, match="did you mean 'quaternion'"):
        read_pose_graph(tmp_path / "graph.g2o", rotation_information="quaternions")
