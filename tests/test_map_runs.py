# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Maps from the command line: a flight makes one, another is located in it, two become one."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from estimating import BELIEVED
from groups import slow
from map_flights import rooms
from typer.testing import CliRunner, Result

from slam_graph.cli.main import app
from slam_graph.config import load_config
from slam_graph.errors import DataError, EstimationError
from slam_graph.pipeline.run_recording import run
from slam_graph.results.map_output import load_map, save_map
from slam_graph.simulation.simulation_config import SimulationConfig, TrackConfig
from slam_graph.simulation.simulator import simulate

HALF_S = 48.0
KNOWN_S, BRIEF_S = 24.0, 11.0
"""What quick tests map of the first lap, and look at of the second, which begins 8 s along it."""
WITHIN_M, WITHIN_DEG = 0.046, 1.1


@pytest.fixture(scope="module")
def tour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording of two laps, `tour`."""
    folder = tmp_path_factory.mktemp("maps")
    rooms(seed=1, duration_s=2 * HALF_S).save(folder / "tour")
    return folder


@cache
def mapped(tour: Path, seconds: float) -> Path:
    """The folder of a run that makes a map of the first seconds."""
    output = tour / f"first_{seconds:g}_s"
    options = ("--duration", seconds, "--save-map", "--output", output)
    done = call("run", tour / "tour", *options)
    assert done.exit_code == 0, done.output
    (folder,) = output.iterdir()
    return folder


@pytest.fixture(scope="module")
def known(tour: Path) -> Path:
    """The folder of a run that made a map of half a lap."""
    return mapped(tour, KNOWN_S)


def call(*arguments: object) -> Result:
    words = [str(word) for word in arguments]
    if words[0] in ("run", "localize"):
        words += ["--no-progress", "--json", "--set", BELIEVED]
    return CliRunner().invoke(app, words)


@cache
def located(tour: Path, known: Path, *options: object) -> Path:
    """The folder of a run over the second lap, located in a map of the first, with its own."""
    output = tour / f"in_{known.parent.name}"
    options = ("--start", HALF_S, "--set", "map.enabled=true", "--output", output, *options)
    done = call("localize", tour / "tour", "--map", known, *options)
    assert done.exit_code == 0, done.output
    return Path(json.loads(done.stdout)["folder"])


@pytest.mark.parametrize("whole", [False, slow(True)], ids=["brief", "whole"])
def test_the_second_half_is_located_in_the_map_of_the_first(
    tour: Path, known: Path, whole: bool
) -> None:
    if whole:
        second = located(tour, mapped(tour, HALF_S))
    else:
        second = located(tour, known, "--duration", BRIEF_S)
    table = json.loads((second / "metrics.json").read_text())
    found = table["localization"]
    assert not table["extent"]["start_was_given"]  # nobody says where the second half begins
    estimated = table["extent"]["estimated_frames"]
    assert estimated >= 0.8 * table["extent"]["frames"]
    assert found["located"] >= 0.95 * estimated
    assert found["located_share"] >= 0.95 or not whole  # most of the others precede the start
    assert found["first_s"] < 2.5
    rows = np.loadtxt(second / "trajectory_map.tum")
    assert len(rows) == found["located"]
    lines = (second / "localization.csv").read_text().splitlines()
    assert sum(line.split(",")[1] == "1" for line in lines[1:]) == len(rows)
    # the map has the world of the truth, but for its drift; aligned by its keyframes less is left
    for alignment in ("none", "map"):
        ate = found["accuracy"][alignment]["ate"]
        assert ate["translation_m"]["max"] < WITHIN_M
        assert ate["rotation_deg"]["max"] < WITHIN_DEG


@pytest.mark.slow
def test_maps_of_both_halves_become_one(tour: Path) -> None:
    known = mapped(tour, HALF_S)
    second = located(tour, known)
    merged = tour / "merged.slam"
    arguments = ("map", "merge", known, second, "--output", merged)
    assert call(*arguments).exit_code == 0
    assert isinstance(call(*arguments).exception, DataError)  # it exists now
    done = call(*arguments, "--force", "--json")
    table = json.loads(done.stdout)
    one, other = load_map(known), load_map(second)
    assert table["keyframes"] == len(one) + len(other)
    assert table["fused"] > 600
    assert table["features"] < len(one.points) + len(other.points)
    assert table["accepted"] >= 42
    truth = rooms(seed=1, duration_s=2 * HALF_S).groundtruth()
    for keyframes in load_map(merged).trajectories():
        rows = np.searchsorted(truth.stamps_ns, keyframes.stamps_ns)
        away = np.linalg.norm(keyframes.positions - truth.positions[rows], axis=1)
        assert away.max() < WITHIN_M


def test_a_map_is_shown_and_exported(tour: Path, known: Path) -> None:
    done = call("map", "info", known)
    assert done.exit_code == 0
    assert "keyframes" in done.output
    assert "cam1" in done.output
    table = json.loads(call("map", "info", known, "--json").stdout)
    assert table["keyframes"] == len(load_map(known))
    assert table["recordings"][0]["poses"] == "smoothed"
    ply, tum = tour / "a.ply", tour / "a.tum"
    assert call("map", "export", known, "--ply", ply, "--tum", tum).exit_code == 0
    before = ply.read_bytes()
    for options in (("--ply", ply), ("--tum", tum), ("--ply", tour / "new.ply", "--tum", tum)):
        done = call("map", "export", known, *options)
        assert isinstance(done.exception, DataError)
        assert "--force" in str(done.exception)
    assert not (tour / "new.ply").exists()
    assert call("map", "export", known, "--ply", ply, "--force").exit_code == 0
    assert ply.read_bytes() == before
    assert "--ply" in str(call("map", "export", known).exception)


def test_maps_are_not_optimised(tour: Path, known: Path) -> None:
    for path in (known, known / "latest" / "map.slam"):
        done = call("optimize", path, "--output", tour / "optimised")
        assert isinstance(done.exception, DataError)
        assert "maps are not optimised" in str(done.exception)
        assert "--save-map" in str(done.exception)
    assert not (tour / "optimised").exists()


@pytest.mark.slow
def test_strangers_are_refused(tour: Path, known: Path) -> None:
    rooms(seed=2, duration_s=6.0).save(tour / "elsewhere")
    result = run(rooms(seed=2, duration_s=20.0), load_config(None, ["map.enabled=true"]))
    assert result.slam_map is not None
    save_map(result.slam_map, tour / "elsewhere.slam")
    merged = tour / "no.slam"
    done = call("map", "merge", known, tour / "elsewhere.slam", "--output", merged)
    assert isinstance(done.exception, EstimationError)
    assert "share no place" in str(done.exception)
    assert not merged.exists()
    done = call(
        "localize", tour / "elsewhere", "--map", known, "--output", tour / "d", "--no-final-ba"
    )
    assert isinstance(done.exception, EstimationError)
    assert "no frame was recognised" in str(done.exception)
    assert json.loads(done.stdout)["localization"]["located"] == 0


def test_what_has_no_descriptors_is_refused_before_the_first_frame(
    tmp_path: Path, known: Path
) -> None:
    plain = simulate(SimulationConfig(duration_s=2.0, rate_hz=10.0, tracks=TrackConfig(features=9)))
    with pytest.raises(DataError, match=r"cannot make a map.*tracks\.descriptors=true"):
        run(plain, load_config(None, ["map.enabled=true"]))
    plain.save(tmp_path / "plain")
    for words in (("run", "--save-map"), ("localize", "--map", known)):
        done = call(words[0], tmp_path / "plain", *words[1:], "--output", tmp_path / "out")
        assert isinstance(done.exception, DataError)
        assert done.exception.exit_code == 1
        assert "tracks.descriptors=true" in str(done.exception)
    assert not any((tmp_path / "out").rglob("*.tum"))


@pytest.mark.slow
def test_two_flights_through_one_place_by_the_recipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commands of docs/maps.md, with shorter flights of fewer frames and features."""
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parent.parent / "docs" / "maps.md").read_text(encoding="utf-8")
    lines = [line for line in page.splitlines() if line.startswith("slam-graph ")]
    names = [line.split()[1] for line in lines]
    recipe = lines[: names.index("localize") + 1]
    assert names[: len(recipe)] == ["simulate", "simulate", "run", "map", "localize"]
    shorter = {"60": "24", "30": "12"}
    sparse = ("--features", 80, "--set", "landmarks.density=4")
    options = ("--rate", 5, *sparse, "--no-progress")
    for line in recipe:
        words = [shorter.get(word, word) for word in line.split()[1:]]
        done = call(*words, *(options if words[0] == "simulate" else ()))
        assert done.exit_code == 0, done.output
    table = json.loads(done.stdout)
    assert table["dataset"]["name"] == "tuesday"
    assert Path(table["folder"]).parent == Path("results") / "tuesday"
    assert table["localization"]["located_share"] > 0.9
    assert table["localization"]["accuracy"]["none"]["ate"]["translation_m"]["rmse"] < 0.1


def test_a_run_that_makes_no_map_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("no points")

    monkeypatch.setattr("slam_graph.pipeline.mapping.build_map", fails)
    tracks = TrackConfig(features=30, descriptors=True)
    simulate(SimulationConfig(duration_s=2.0, rate_hz=10.0, tracks=tracks)).save(tmp_path / "plain")
    done = call("run", tmp_path / "plain", "--save-map", "--output", tmp_path / "out")
    assert isinstance(done.exception, EstimationError)
    assert done.exception.exit_code == 3
    table = json.loads(done.stdout)
    assert table["status"] == "no_map"
    assert (Path(table["folder"]) / "trajectory_smoothed.tum").is_file()
