# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures: one colour for one name, σ in the axes of the world, and something for every input."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import slam_graph as sg
from slam_graph.evaluation.evaluation_report import nees_of_run
from slam_graph.geometry.trajectory import Trajectory, interpolate
from slam_graph.geometry.trajectory_alignment import Similarity
from slam_graph.results.run_picture import (
    IN_MAP,
    LOOPS_CLOSED,
    PoseEstimate,
    _title,
    with_path_in_map,
)
from slam_graph.visualization.bundle_picture import bundle_figure
from slam_graph.visualization.panels import Panel, panel_figure
from slam_graph.visualization.style import line_styles

pytestmark = pytest.mark.usefixtures("rendered")

PNG = b"\x89PNG"


def test_a_name_has_one_style_and_no_two_are_alike() -> None:
    names = ["ekf", "mine", "msckf", "msckf_no_fej", "swf", "okvis", "a", "b", "c", "d", "e", "f"]
    styles = line_styles(names)
    assert sorted(styles) == sorted(names)
    assert len({(style.color, style.dash) for style in styles.values()}) == len(names)
    assert styles["msckf"] == line_styles(["swf", "msckf"])["msckf"]
    assert styles["msckf_no_fej"].color == styles["msckf"].color


def test_sigmas_are_turned_into_the_axes_of_the_world() -> None:
    rng = np.random.default_rng(0)
    turns = Rotation.random(4, random_state=1)
    roots = rng.normal(size=(4, 6, 6))
    P = roots @ roots.transpose(0, 2, 1)
    stamps = np.arange(4) * 10**9
    sigmas = PoseEstimate(Trajectory(stamps, np.zeros((4, 3)), turns.as_quat()), P).world_sigmas()
    for R, covariance, row in zip(turns.as_matrix(), P, sigmas, strict=True):
        position = np.sqrt(np.diag(R @ covariance[3:, 3:] @ R.T))
        yaw = np.degrees(np.sqrt((R @ covariance[:3, :3] @ R.T)[2, 2]))
        np.testing.assert_allclose(row, [*position, yaw])


def test_a_run_without_any_estimate_is_pictured_too(tmp_path: Path) -> None:
    result = sg.run("demo", duration_s=0.5)
    assert result.status == "not_initialized"
    result.save(tmp_path)
    assert (tmp_path / "trajectory.png").read_bytes()[:4] == PNG
    assert sg.load_result(tmp_path).plot().png(40)[:4] == PNG


@pytest.mark.parametrize("runs", [0, 1, 5])
def test_bars_and_boxes_of_any_number_of_samples(runs: int) -> None:
    rng = np.random.default_rng(0)
    samples = {"swf": rng.uniform(1, 2, runs), "ekf": rng.uniform(90, 99, runs), "mine": np.ones(1)}
    curve = (np.arange(3.0), np.array([1.0, np.nan, 2.0]))
    panels = [
        Panel("error [m]", "", samples=samples),
        Panel("x", "y", {"swf": curve}),
        Panel("", ""),
    ]
    assert panel_figure("runs", panels).png(40)[:4] == PNG


@pytest.mark.parametrize("largest", [0.0181, 4000.0])
def test_numbers_and_the_ideal_lie_inside_of_their_panel(largest: float) -> None:
    """Linear and logarithmic."""
    for low, samples in ((0.00875, 1), (0.005, 5)):
        values = {"msckf": low, "swf": 0.00875, "okvis": largest}
        columns = {name: np.linspace(0.9, 1.0, samples) * value for name, value in values.items()}
        ideal = 3.0 * largest
        figure = panel_figure("", [Panel("error", "", samples=columns, ideal=ideal)])
        figure.draw_without_rendering()
        (axes,) = figure.axes
        frame = axes.get_window_extent()
        for text in axes.texts:
            if text.get_text() != " ideal":
                assert text.get_window_extent().x1 <= frame.x1
        assert axes.get_xlim()[0] <= 0.005
        assert axes.get_xlim()[1] >= ideal


def test_no_path_hides_another() -> None:
    x = np.linspace(0.0, 1.0, 9)
    curves = dict.fromkeys(("ground truth", "causal", "smoothed", "loops closed"), (x, x))
    figure = panel_figure("", [Panel("x", "y", curves, "path")])
    widths = [line.get_linewidth() for line in figure.axes[0].lines if line.get_label() in curves]
    assert all(np.diff(widths) < -0.5)


def test_a_path_after_loop_closure_is_shown_where_loops_were_accepted() -> None:
    tracks = {"features": 30, "descriptors": True}
    flight = sg.simulate(duration_s=2.0, rate_hz=10.0, tracks=tracks)
    result = sg.run(flight, overrides={"loop_closure.enabled": True})
    assert result.loop_closed is not None
    assert not len(result.loop_ends_ns)
    assert LOOPS_CLOSED not in result._view().paths
    assert result._facts()["error, loops closed"] is None


def test_a_path_in_a_map_is_aligned_by_itself() -> None:
    result = sg.run(sg.simulate(trajectory="figure8", duration_s=4.0, rate_hz=10.0))
    view = result._view()
    elsewhere = Similarity(Rotation.from_euler("z", 0.7).as_matrix(), np.array([3.0, 1.0, -2.0]))
    path = with_path_in_map(view, elsewhere.apply(result.trajectory)).paths[IN_MAP]
    assert result.groundtruth is not None
    error = sg.ape(result.groundtruth, path).statistics.rmse
    aligned = sg.ape(result.groundtruth, result.trajectory, alignment="yaw").statistics.rmse
    assert error == pytest.approx(aligned, rel=1e-6)


@pytest.mark.parametrize("mode", ["yaw", "se3"])
def test_a_path_in_a_map_is_aligned_in_what_nothing_measured_there(mode: str) -> None:
    result = sg.run(sg.simulate(trajectory="figure8", duration_s=4.0, rate_hz=10.0))
    tilted = Similarity(Rotation.from_euler("xz", [0.8, 0.7]).as_matrix(), np.ones(3))
    path = tilted.apply(result.trajectory)
    view = with_path_in_map(result._view(), path, {"alignment": mode})
    assert view.truth is not None
    error = sg.ape(view.truth, view.paths[IN_MAP]).statistics.rmse
    assert (error < 0.05) == (mode == "se3")


def test_a_truth_of_another_time_is_a_warning_with_both_spans(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    flight = sg.simulate(duration_s=1.5, rate_hz=10.0)
    truth = flight.groundtruth()
    assert truth is not None
    later = replace(truth, stamps_ns=truth.stamps_ns + 100_000_000_000)
    monkeypatch.setattr(flight, "groundtruth", lambda: later)
    result = sg.run(flight, overrides=["final_ba.enabled=false"])
    assert result.warnings["groundtruth_elsewhere"] == 1
    said = [line for line in caplog.messages if "groundtruth_elsewhere" in line]
    for stamp_ns in (*later.stamps_ns[[0, -1]], *result.input.states_ns):
        assert f"{stamp_ns * 1e-9:.3f}" in said[0]
    assert "the ground truth shares no time with the run" in _title(result.metrics)


def test_a_picture_for_a_notebook_has_a_palette_and_looks_the_same() -> None:
    """No pixel is far off: thin lines keep their colours beside many shades."""
    x = np.linspace(0.0, 1.0, 200)
    curves = {name: (x, np.sin(5 * x + k)) for k, name in enumerate(("msckf", "swf", "okvis"))}
    shades = np.random.default_rng(0).uniform(size=(300, 2))
    figure = panel_figure("runs", [Panel("x", "y", curves, dots=shades)])
    light = figure._repr_png_()
    assert light[25] == 3, "a palette"
    assert len(light) < 0.6 * len(figure.png(100))
    whole, reduced = (
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(float)
        for data in (figure.png(100), light)
    )
    apart = np.abs(whole - reduced).max(axis=2)
    assert apart.mean() < 1.0
    assert np.percentile(apart, 99.9) < 32


@pytest.mark.parametrize("points", [1, 3, 500])
def test_scenes_of_any_size_keep_their_proportions(points: int) -> None:
    rng = np.random.default_rng(0)
    scene = rng.normal(size=(points, 3)) * (20.0, 5.0, 0.1)
    scene[0] = 0.0 if points < 500 else 1e6
    figure = bundle_figure("scene", scene, rng.normal(size=(2, 3)), {"before": np.ones(4)})
    assert figure.png(40)[:4] == PNG
    projections = [axes for axes in figure.axes if axes.get_xscale() == "linear"]
    assert len(projections) == 3
    for axes in projections:
        assert axes.get_aspect() == 1.0
        assert axes.get_xlabel()
        assert axes.get_ylabel()
        assert np.ptp(axes.get_xlim()) < 1e4, "one point far away makes the others no smaller"


def test_errors_and_bounds_of_a_picture_are_those_of_the_nees() -> None:
    """Without a given start the estimate is aligned, and its covariance is of what is left."""
    flight = sg.simulate(duration_s=8.0, rate_hz=10.0, cameras=1, flight={"hover_s": 2.0})
    result = sg.run(flight, overrides={"backend.initialization.mode": "static"})
    result.check()
    truth = result.groundtruth
    assert truth is not None
    assert not result.start_was_given
    view = result._view()
    for name, history in (("causal", result.history), ("smoothed", result.final_ba.history)):
        judged, alignment = nees_of_run(truth, history, False, result.final_ba)
        assert alignment == "yaw"
        estimate = view.estimates[name]
        own = np.isin(estimate.trajectory.stamps_ns, judged.stamps_ns)
        true, _ = interpolate(truth, judged.stamps_ns)
        error = estimate.trajectory.positions[own] - true.positions
        R = Rotation.from_quat(estimate.trajectory.quaternions[own]).as_matrix()
        P = R @ estimate.covariances[own, 3:, 3:] @ R.transpose(0, 2, 1)
        nees = np.einsum("ni,ni->n", error, np.linalg.solve(P, error[:, :, None])[:, :, 0])
        np.testing.assert_allclose(nees, judged.position, rtol=1e-6)
