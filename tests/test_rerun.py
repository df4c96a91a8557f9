# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings for Rerun, read back by Rerun: what is promised is in them, at its times."""

import json
import logging
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED
from flight import rig
from groups import slow
from map_flights import World
from pose_graphs import laps
from rerun.chunk import RrdReader
from typer.testing import CliRunner

import slam_graph as sg
from slam_graph.bundle_adjustment import adjust_bundle, read_bal
from slam_graph.cli import view_files
from slam_graph.cli.main import app
from slam_graph.errors import DataError
from slam_graph.pose_graph import optimize_pose_graph
from slam_graph.results import BalResult, RunResult
from slam_graph.visualization import RerunRecording
from slam_graph.visualization.rerun_blueprints import GROWING, Eye, with_ticks
from slam_graph.visualization.rerun_palette import line_colours
from slam_graph.visualization.rerun_progress import StepSeries
from slam_graph.visualization.rerun_series import PLOTS

DURATION_S, RATE_HZ = 4.0, 10.0
PLOTTED = ("/state/", "/imu/", "/error/", "/consistency/", "/backend/")
TIMELINES = {"frame", "sensor_time"}
OF_A_RUN = {
    *("/world/path/causal", "/world/path/smoothed", "/world/path/groundtruth", "/world/gravity"),
    *("/world/body", "/world/body/position_sigma", "/world/features", "/world/map/points"),
    *("/world/window", "/world/body/cam0", "/world/body/cam0/features", "/world/body/cam0/tails"),
    *("/world/body/cam0/residuals", "/world/body/cam0/residuals/reprojected", "/log", "/legend"),
    *("/state/velocity", "/state/gyro_bias", "/state/gyro_bias/bounds", "/state/accel_bias"),
    *("/state/accel_bias/bounds", "/imu/gyro", "/imu/accel", "/error/position"),
    *("/error/position/bounds", "/error/orientation", "/consistency/nees", "/consistency/nis"),
    *(
        "/backend/milliseconds",
        "/backend/stages",
        "/backend/counts",
        "/backend/rejected",
        "/backend/cost",
    ),
    *("/window/graph/variables", "/window/graph/projections", "/window/graph/prior"),
    *("/window/before/matrix", "/window/after/matrix"),
}


@dataclass
class Content:
    """What is in a recording.

    Attributes:
        rows: of each entity.
        static: entities that hold for all times.
        timelines: all that there are.
        components: of each entity.
        layouts: names of the views and containers of each layout that was sent.
    """

    rows: Counter[str] = field(default_factory=Counter)
    static: set[str] = field(default_factory=set)
    timelines: set[str] = field(default_factory=set)
    components: dict[str, set[str]] = field(default_factory=dict)
    layouts: list[set[str]] = field(default_factory=list)

    @property
    def entities(self) -> set[str]:
        return set(self.rows) | self.static

    def has_layout(self, *names: str) -> bool:
        """Whether one of the layouts has all of these."""
        return any(layout >= set(names) for layout in self.layouts)


def content(path: Path) -> Content:
    """Everything in a recording."""
    reader, found = RrdReader(path), Content()
    for chunk in reader.stream():
        entity = str(chunk.entity_path)
        batch = chunk.to_record_batch()
        found.components.setdefault(entity, set()).update(batch.schema.names)
        if chunk.is_static:
            found.static.add(entity)
        else:
            found.rows[entity] += chunk.num_rows
            found.timelines |= set(chunk.timeline_names)
    for blueprint in reader.blueprints():
        batches = [chunk.to_record_batch() for chunk in reader.stream(store=blueprint)]
        columns = [
            b.column(n) for b in batches for n in b.schema.names if n.endswith("display_name")
        ]
        found.layouts.append({text for c in columns for row in c.to_pylist() for text in row or ()})
    return found


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunResult, Content]:
    """A short run that was watched in all detail."""
    path = tmp_path_factory.mktemp("rerun") / "recording.rrd"
    viewer = RerunRecording("save", "flight", path).viewer(detail="graph")
    sequence = sg.simulate(trajectory="figure8", duration_s=DURATION_S, rate_hz=RATE_HZ, seed=1)
    logger = logging.getLogger("slam_graph")
    level = logger.level
    logger.setLevel(logging.INFO)  # as the command line has it
    result = sg.run(sequence, viewer=viewer, overrides=[BELIEVED])
    logger.setLevel(level)
    assert not result.warnings["viewer_failed"]
    return result, content(path)


def test_a_run_has_everything_that_is_promised(watched: tuple[RunResult, Content]) -> None:
    _, found = watched
    assert found.entities >= OF_A_RUN
    assert found.timelines == TIMELINES


def test_objects_have_points_a_trail_and_a_velocity(tmp_path: Path) -> None:
    sequence = sg.simulate(
        duration_s=3.0, rate_hz=10.0, tracks={"pixel_sigma": 0.5}, objects={"count": 1}
    )
    viewer = RerunRecording("save", "objects", tmp_path / "objects.rrd").viewer()
    changes = {"objects.enabled": True, "backend.noise.pixel_sigma": 0.5}
    result = sg.run(sequence, viewer=viewer, overrides={**changes, "final_ba.enabled": False})
    assert not result.warnings["viewer_failed"]
    assert result.objects is not None
    found, number = content(tmp_path / "objects.rrd"), result.objects.numbers[0]
    frames = len(result.objects.states(number))
    assert found.rows["/world/objects/trails"] >= frames - 1
    for part in ("points", "velocity"):
        assert found.rows[f"/world/objects/{number}/{part}"] >= frames > 5
    assert found.rows["/world/body/cam0/objects/regions"] > frames
    assert found.rows["/world/body/cam0/objects/tracks"] > frames


def test_a_path_is_one_entity_with_a_piece_for_each_frame(
    watched: tuple[RunResult, Content],
) -> None:
    result, found = watched
    states = len(result.trajectory)
    assert found.rows["/world/path/causal"] == states
    assert found.rows["/world/body"] == states
    assert result.smoothed is not None
    assert found.rows["/world/path/smoothed"] == len(result.smoothed) - 1
    assert found.rows["/window/before/matrix"] == states
    assert len([entity for entity in found.entities if "/path/" in entity]) == 3


def test_the_layout_has_space_cameras_plots_and_window(
    watched: tuple[RunResult, Content],
) -> None:
    _, found = watched
    views = ("Run", "cam0", "Window", "Factor graph of the window", "Legend", "Log")
    plots = ("velocity [m/s]", "gyro bias [rad/s]", "time [ms]", "NIS / dof")
    assert len(found.layouts) == 1, "a file has the layout of the end only"
    assert found.has_layout(*views, *plots, "position error [m]", "NEES")


def test_a_result_that_was_not_watched_is_shown_from_its_files(
    watched: tuple[RunResult, Content], tmp_path: Path
) -> None:
    result, _ = watched
    result.save(tmp_path / "run")
    found = viewed(tmp_path, tmp_path / "run")
    paths = {f"/world/path/{name}" for name in ("causal", "smoothed", "groundtruth")}
    plots = {entity for entity in OF_A_RUN if entity.startswith(PLOTTED)}
    points = {"/world/map/points", "/world/body", "/world/body/position_sigma", "/legend"}
    assert found.entities >= paths | points | (plots - {"/imu/gyro", "/imu/accel"})
    for plot in ("/consistency/nis", "/backend/cost", "/backend/counts"):
        assert found.rows[plot] == watched[1].rows[plot]
    assert found.timelines == TIMELINES
    assert found.rows["/world/path/causal"] == len(result.trajectory) - 1
    assert found.rows["/world/body/position_sigma"] == len(result.trajectory)


def test_the_recording_of_a_run_adds_its_inputs(tmp_path: Path) -> None:
    flight = sg.simulate(trajectory="figure8", duration_s=2.0, rate_hz=10.0)
    flight.save(tmp_path / "flight")
    sg.run(tmp_path / "flight").save(tmp_path / "run")
    found = viewed(tmp_path, tmp_path / "run", "--recording", tmp_path / "flight")
    assert found.rows["/world/body/cam0/features"] == 21
    samples = sum(len(packet.imu) for packet in flight.packets())
    assert found.rows["/imu/gyro"] == found.rows["/imu/accel"] == samples


@pytest.mark.slow
def test_every_run_is_judged_by_its_own_truth(tmp_path: Path) -> None:
    """Two flights through one place, of the same algorithm: errors are those of their metrics."""
    for seed, day in enumerate(("monday", "tuesday"), start=1):
        result = sg.run(sg.simulate(trajectory="rooms", duration_s=4.0, seed=seed, world_seed=7))
        result.save(tmp_path / day / "run")
    days = [tmp_path / day / "run" for day in ("monday", "tuesday")]
    found = viewed(tmp_path, *days)
    assert found.static >= {"/paths/monday", "/paths/tuesday"}
    shown = []
    show_comparison = RerunRecording.show_comparison
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            RerunRecording,
            "show_comparison",
            lambda self, runs, *rest: (shown.append(runs), show_comparison(self, runs, *rest)),
        )
        viewed(tmp_path, *days)
    for day, folder in zip(("monday", "tuesday"), days, strict=True):
        said = sg.load_result(folder).metrics["accuracy"]["yaw"]["ate"]["translation_m"]["rmse"]
        errors = shown[0][day]["position error [m]"]
        assert np.sqrt(np.mean(errors**2)) == pytest.approx(said, rel=1e-6)
    (days[1] / "groundtruth.tum").unlink()
    assert "different recordings" in refused(*days, "--output", tmp_path / "no.rrd")


def test_runs_of_an_earlier_comparison_are_not_shown(tmp_path: Path) -> None:
    """They stay beside those of a later one with the same data."""
    for name in ("ekf", "msckf"):
        file = tmp_path / "runs" / "flight_seed0" / f"{name}.npz"
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, path=np.ones((4, 3)))
    shown: list[list[str]] = []
    recording = SimpleNamespace(show_comparison=lambda runs, *_: shown.append(list(runs)))
    for summary in ({}, {"runs": ["runs/flight_seed0/msckf"]}):
        (tmp_path / "summary.json").write_text(json.dumps(summary))
        show = view_files.of_folder(tmp_path)
        assert show is not None
        show(cast(RerunRecording, recording))
    assert shown == [["ekf", "msckf"], ["msckf"]]
    (tmp_path / "summary.json").write_text('{"runs": [')
    with pytest.raises(DataError, match=r"summary\.json: not the summary of a comparison"):
        view_files.of_folder(tmp_path)


def test_files_are_replaced_only_if_that_is_asked_for(tmp_path: Path) -> None:
    for option, name in (("--output", "a.rrd"), ("--screenshot", "a.png")):
        (tmp_path / name).write_text("kept")
        assert "exists already" in refused(tmp_path, option, tmp_path / name)
        assert (tmp_path / name).read_text() == "kept"


def test_an_optimised_bundle_is_seen_before_and_after_from_its_files(tmp_path: Path) -> None:
    file = Path(gtsam.__file__).parent / "Data" / "dubrovnik-3-7-pre.txt"
    BalResult(sg.BalPolicy(), adjust_bundle(read_bal(file))).save(tmp_path / "bundle")
    found = viewed(tmp_path, tmp_path / "bundle")
    assert found.static >= {"/before/points", "/after/points"}
    assert found.has_layout("Before", "After")


def test_options_that_change_nothing_are_refused(tmp_path: Path) -> None:
    graph, _ = laps(2, noise=0.01)
    (tmp_path / "laps.g2o").write_text("".join(optimize_pose_graph(graph).g2o_lines()))
    view = viewed(tmp_path, tmp_path / "laps.g2o")
    assert view.has_layout("Odometry alone", "As in the file")
    assert "changes nothing" in refused(tmp_path / "viewed.rrd", "--no-images")
    out = ("--output", tmp_path / "again.rrd")
    assert "folder of one run" in refused(tmp_path / "laps.g2o", "--map", "place.slam", *out)


def test_colours_of_algorithms_are_those_of_the_pictures() -> None:
    from slam_graph.visualization.style import COLOUR_NAMES, line_styles

    names = ["msckf", "swf", "okvis"]
    styles = line_styles(names)
    for name, (colour, said) in line_colours(names).items():
        assert "#{:02X}{:02X}{:02X}".format(*colour) == styles[name].color
        assert said == COLOUR_NAMES[styles[name].color]


def viewed(tmp_path: Path, *what: Path | str) -> Content:
    """What `slam-graph view` saves."""
    path = tmp_path / "viewed.rrd"
    done = CliRunner().invoke(app, ["view", *map(str, what), "--output", str(path), "--force"])
    assert done.exit_code == 0, done.exception
    return content(path)


@pytest.mark.parametrize(("images", "frames"), [slow("none", 0), ("keyframes", 3), slow("all", 13)])
def test_images_are_sent_of_the_frames_that_are_asked_for(
    images: str, frames: int, tmp_path: Path
) -> None:
    path = tmp_path / "recording.rrd"
    viewer = RerunRecording("save", "images", path).viewer(images)
    sequence = sg.simulate(
        trajectory="figure8", kind="images", duration_s=1.2, rate_hz=10.0, cameras=1
    )
    sg.run(sequence, viewer=viewer, final_ba={"enabled": False})
    found = content(path)
    assert found.rows["/world/body/cam0/features"] == 13
    assert found.rows["/world/body/cam0/image"] == frames


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_pose_graph_is_shown_before_and_after(dimension: int, tmp_path: Path) -> None:
    graph, _ = laps(dimension, noise=0.01)
    solution = optimize_pose_graph(graph)
    with RerunRecording("save", "graph", tmp_path / "graph.rrd") as recording:
        recording.show_pose_graph(solution)
    found = content(tmp_path / "graph.rrd")
    for stage in ("before", "after"):
        parts = {f"/{stage}/{kind}" for kind in ("odometry", "loop_closures", "poses")}
        assert found.static >= parts
        loops = int(np.count_nonzero(~graph.is_odometry))
        assert found.rows[f"/residuals/{stage}/loop_closures"] == loops
    assert found.timelines == {"edge"}
    assert found.has_layout("Before: as in the file", "After", "log10 χ² of each edge", "Summary")


def test_graph_files_are_shown_as_they_are(tmp_path: Path) -> None:
    graph, _ = laps(3, noise=0.01)
    file = tmp_path / "laps.g2o"
    file.write_text("".join(optimize_pose_graph(graph).g2o_lines()))
    assert viewed(tmp_path, file).entities >= {"/before/poses", "/after/poses"}


def test_a_bundle_adjustment_is_shown_before_and_after(tmp_path: Path) -> None:
    file = Path(gtsam.__file__).parent / "Data" / "dubrovnik-3-7-pre.txt"
    with RerunRecording("save", "bundle", tmp_path / "bundle.rrd") as recording:
        recording.show_bundle(adjust_bundle(read_bal(file)))
    found = content(tmp_path / "bundle.rrd")
    for stage in ("before", "after"):
        assert found.static >= {f"/{stage}/points", f"/{stage}/cameras", f"/errors/{stage}"}
    assert found.has_layout("Before", "After", "Errors before [px]", "Errors after [px]")
    problem = viewed(tmp_path, file)
    assert "/before/points" in problem.static
    assert "/after/points" not in problem.static


def test_a_map_is_shown(tmp_path: Path) -> None:
    content_of_map = World().map()
    sg.save_map(content_of_map, tmp_path / "map.slam")
    found = viewed(tmp_path, tmp_path / "map.slam")
    assert found.static >= {"/map/points", "/map/recordings/0", "/map/recordings/0/keyframes"}


def test_a_recording_is_shown_as_it_is(tmp_path: Path) -> None:
    sg.simulate(trajectory="figure8", duration_s=1.0).save(tmp_path / "flight")
    found = viewed(tmp_path, tmp_path / "flight")
    assert found.entities >= {"/imu/gyro", "/imu/accel", "/world/body/cam0/features"}
    assert "/world/path/groundtruth" in found.entities
    assert found.timelines == TIMELINES


def refused(*arguments: str | Path) -> str:
    """The error of a command that cannot be done."""
    done = CliRunner().invoke(app, ["view", *map(str, arguments)])
    assert done.exit_code != 0
    assert done.exception is not None
    return str(done.exception) if isinstance(done.exception, sg.SlamGraphError) else done.output


@pytest.mark.parametrize("aspect", [1.0, 1.8])
def test_a_whole_path_is_in_view(aspect: float) -> None:
    rng = np.random.default_rng(3)
    for scale in ((10.0, 3.0, 1.0), (1.0, 8.0, 2.0), (1.0, 1.0, 0.0)):
        path = rng.normal(size=(200, 3)) * scale + rng.normal(size=3)
        eye = Eye.on(path, aspect=aspect)
        assert eye is not None
        ahead = np.subtract(eye.target, eye.position)
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        seen = (path - eye.position) @ np.column_stack([right, np.cross(right, ahead), ahead])
        across, up = (np.abs(seen[:, :2]) / seen[:, 2:]).max(axis=0)
        half = np.tan(np.deg2rad(55.0 / 2))  # of the view of Rerun, from top to bottom
        assert seen[:, 2].min() > 0.0
        assert 0.6 < max(across / aspect, up) / half < 1.0


def test_two_numbers_stand_beside_an_axis() -> None:
    rng = np.random.default_rng(5)
    for low, size in zip(rng.normal(size=300), 10 ** rng.uniform(-6, 4, size=300), strict=True):
        first, last = with_ticks(low, low + size)
        assert first < low < low + size < last
        step = 10 ** np.ceil(np.log10(0.1 * (last - first)))
        assert np.floor(last / step) - np.ceil(first / step) >= 1


@pytest.mark.parametrize("call", ["open", "show", "finish"])
def test_a_viewer_that_fails_does_not_end_the_run(call: str, tmp_path: Path) -> None:
    viewer = RerunRecording("save", "flight", tmp_path / "recording.rrd").viewer()

    def fail(*_: object) -> None:
        raise RuntimeError("the window was closed")

    setattr(viewer, call, fail)
    sequence = sg.simulate(trajectory="figure8", duration_s=2.0)
    result = sg.run(sequence, viewer=viewer, final_ba={"enabled": False})
    assert result.status == "ok"
    assert result.warnings["viewer_failed"] == 1


def test_an_estimator_tells_which_features_move_by_themselves() -> None:
    estimator = sg.Estimator(rig(), sg.load_config().algorithm)
    assert len(estimator.dynamic) == 0
    estimator._standstill.add_dynamic(np.array([7, 3]))
    assert estimator.dynamic.tolist() == [3, 7]


def test_every_series_of_a_step_has_a_plot_and_every_path_accumulates() -> None:
    assert set(PLOTS) >= StepSeries.PLOTS
    assert {"path/causal", "path/smoothed", "path/loop_closed", "path/groundtruth"} <= set(GROWING)
