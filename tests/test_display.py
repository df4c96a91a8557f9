# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What objects show in Jupyter, what a trajectory can do, and its files in three formats."""

import importlib
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import get_args

import nbclient
import nbformat
import numpy as np
import pytest
from limits import HANG_S
from pose_graphs import laps

import slam_graph as sg
from slam_graph.display import Displayed, _Module
from slam_graph.errors import ConfigError, DataError
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.pose_graph import certify

pytestmark = pytest.mark.usefixtures("rendered")

PACKAGE = Path(sg.__file__).parent
PNG = b"\x89PNG"
VIEWER = "application/vnd.jupyter.widget-view+json"


@pytest.fixture(scope="module")
def result() -> sg.RunResult:
    """Six simulated seconds, smoothed, with ground truth."""
    flight = sg.simulate(trajectory="figure8", duration_s=6.0, rate_hz=10.0, cameras=1)
    found = sg.run(flight)
    found.check()
    return found


@pytest.fixture
def trajectory(result: sg.RunResult) -> Trajectory:
    return result.trajectory


def html_of(shown: Displayed) -> str:
    html = shown._repr_html_()
    assert f"<b>{type(shown).__name__}</b>" in html
    assert html.count("<tr>") == html.count("</tr>") > 0
    return html


def test_results_show_a_table_and_a_picture(result: sg.RunResult, tmp_path: Path) -> None:
    result.save(tmp_path)
    saved = sg.load_result(tmp_path)
    for shown in (result, saved):
        html = html_of(shown)
        assert "image/png" in html
        assert "msckf" in html
        assert "RMS" in html
        assert shown.plot().png(50)[:4] == PNG
    assert (tmp_path / "trajectory.png").read_bytes()[:4] == PNG
    (tmp_path / "map.ply").unlink()
    assert "image/png" not in html_of(sg.load_result(tmp_path)), "a missing file costs the picture"


def test_what_has_places_shows_a_picture(result: sg.RunResult, gtsam_data: Path) -> None:
    truth = result.groundtruth
    assert truth is not None
    flight = sg.simulate(duration_s=1.0, rate_hz=10.0)
    solution = sg.optimize_pose_graph(laps(2, noise=0.01)[0])
    problem = sg.read_bal(gtsam_data / "dubrovnik-3-7-18-pre.txt")
    errors = sg.ape(truth, result.trajectory, alignment="yaw")
    for shown in (result.trajectory, errors, flight, solution, problem):
        assert "image/png" in html_of(shown), type(shown)
        assert len(repr(shown)) < 120
        assert "array" not in repr(shown)
    assert "image/png" not in html_of(replace(solution.graph, estimates=None))


def test_a_certificate_says_whether_it_holds() -> None:
    graph = laps(2, noise=0.01)[0]
    solution = sg.optimize_pose_graph(graph)
    shown = certify(graph, solution.poses)
    assert repr(shown).startswith("Certificate(certified: objective ")
    assert len(repr(shown)) < 120
    assert "this is the global optimum" in html_of(shown)


def test_every_picture_that_is_asked_for_can_be_drawn() -> None:
    asked = {
        name
        for path in PACKAGE.rglob("*.py")
        for name in re.findall(r'_drawn_by\("(\w+)"\)\s*\.(\w+)\(', path.read_text("utf-8"))
    }
    assert len(asked) >= 7
    assert {module for module, _ in asked} == set(get_args(_Module))
    for module, function in asked:
        assert callable(
            getattr(importlib.import_module(f"{PACKAGE.name}.visualization.{module}"), function)
        )


def test_settings_show_what_differs_from_the_defaults() -> None:
    config = sg.load_config("swf", {"backend.noise.pixel_sigma": 2.0}, seed=3)
    assert repr(config) == "RunConfig(algorithm=swf, seed=3, backend.noise.pixel_sigma=2.0)"
    html = html_of(config)
    assert "backend.noise.pixel_sigma" in html
    assert "max_past_poses 15" in html, "the policies of the algorithm"
    assert "first_estimates" in html_of(sg.load_config())
    assert repr(config.frontend) == "FrontendConfig(defaults)"


def test_a_trajectory_is_a_sequence_of_poses(trajectory: Trajectory) -> None:
    part = trajectory[2:6]
    assert isinstance(part, Trajectory)
    assert [pose.equals(trajectory[k], 1e-12) for k, pose in enumerate(part, 2)] == [True] * 4
    mask = trajectory.positions[:, 0] > np.median(trajectory.positions[:, 0])
    assert len(trajectory[mask]) == mask.sum()
    assert part.velocities is not None
    last = trajectory[-1].translation()
    np.testing.assert_array_equal(last, trajectory.positions[-1])


def test_a_pose_is_found_at_any_time(trajectory: Trajectory) -> None:
    first, second = trajectory.stamps_ns[:2].tolist()
    assert trajectory.at(first).equals(trajectory[0], 1e-9)
    between = trajectory.at((first + second) // 2).translation()
    np.testing.assert_allclose(between, trajectory.positions[:2].mean(axis=0), atol=1e-9)
    with pytest.raises(DataError, match="no pose at"):
        trajectory.at(first - 1)
    with pytest.raises(DataError, match="empty"):
        trajectory[:0].at(first)
    with pytest.raises(DataError, match="whole number of nanoseconds"):
        trajectory.at(0.5)  # type: ignore[arg-type]


def test_files_hold_the_trajectory(trajectory: Trajectory, tmp_path: Path) -> None:
    for name in ("a.tum", "b.csv"):
        back = sg.read_groundtruth(trajectory.save(tmp_path / name))
        np.testing.assert_array_equal(back.stamps_ns, trajectory.stamps_ns)
        np.testing.assert_allclose(back.positions, trajectory.positions, atol=1e-9)
        np.testing.assert_allclose(back.quaternions, trajectory.quaternions, atol=1e-8)
    assert back.gyro_biases is not None
    assert trajectory.gyro_biases is not None
    np.testing.assert_allclose(back.gyro_biases, trajectory.gyro_biases, atol=1e-9)
    rows = np.loadtxt(trajectory.save(tmp_path / "c.txt", "kitti")).reshape(-1, 3, 4)
    expected = [pose.matrix()[:3] for pose in trajectory]
    np.testing.assert_allclose(rows, expected, atol=1e-8)
    with pytest.raises(DataError, match="did you mean 'kitti'"):
        trajectory.save(tmp_path / "d.txt", "kiti")  # type: ignore[arg-type]


def test_pandas_is_optional(trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas")
    table = trajectory.to_dataframe()
    assert table.shape == (len(trajectory), 17)
    assert table.index[-1] == pytest.approx(trajectory.duration_s)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ConfigError, match="pip install pandas"):
        trajectory.to_dataframe()


def test_the_viewer_of_a_notebook_is_asked_for_by_name(
    result: sg.RunResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slam_graph.visualization.inline_viewer.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="rerun-sdk\\[notebook\\]"):
        result.show()


@pytest.mark.slow
def test_the_viewer_shows_a_result_inside_a_notebook(result: sg.RunResult, tmp_path: Path) -> None:
    """A cell that shows a saved result has the viewer as its output, and warns of nothing."""
    pytest.importorskip("rerun_notebook")
    result.save(tmp_path)
    source = f"import slam_graph as sg\nsg.load_result({str(tmp_path)!r}).show(400, 300)"
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    nbclient.NotebookClient(notebook, timeout=HANG_S).execute()
    outputs = notebook.cells[0].outputs
    assert not [out for out in outputs if out.get("name") == "stderr"]
    assert [out for out in outputs if VIEWER in out.get("data", {})]
