# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Results of runs and optimisations in one folder: saved again, of another kind, interrupted."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from flight import rig
from groups import slow
from interruption import interrupted_at
from pose_graphs import laps

from benchmarks.bal_problems import ring
from slam_graph.bundle_adjustment import BalPolicy, adjust_bundle
from slam_graph.config import load_config
from slam_graph.datasets.sequence import SequenceInfo
from slam_graph.errors import DataError
from slam_graph.pose_graph import PoseGraphPolicy, optimize_pose_graph
from slam_graph.results import BalResult, PoseGraphResult, RunInput, RunResult

Result = RunResult | PoseGraphResult | BalResult
Make = Callable[[float], Result]
"""Makes a result; another one for each number."""


def run(number: float) -> RunResult:
    info = SequenceInfo(f"run {number}", "euroc", "images", 1, 0, 0, 0, 0, False)
    return RunResult(RunInput(info, load_config(), rig(), 0, 10**9))


def graph(number: float) -> PoseGraphResult:
    solution = optimize_pose_graph(laps(2, 0.02, poses=25, seed=int(number))[0])
    covariances = solution.covariances() if number == 1 else None
    return PoseGraphResult(PoseGraphPolicy(), solution, None, covariances, {"solve": number})


def bundle(number: float) -> BalResult:
    policy = BalPolicy()
    solution = adjust_bundle(ring(6, 60, views=9.0, seed=int(number)).problem, policy)
    return BalResult(policy, solution, {"solve": number})


KINDS: dict[str, Make] = {"run": run, "pose graph": graph, "bundle adjustment": bundle}
OPTIMISATIONS = [graph, bundle]


def content(folder: Path) -> dict[str, bytes]:
    """All files but pictures."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.suffix != ".png"
    }


def kept(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Lines that say what was kept under another name."""
    return [line for line in caplog.messages if "kept as" in line]


@pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)
def test_a_result_that_is_saved_again_keeps_what_is_its_own(
    tmp_path: Path, make: Make, caplog: pytest.LogCaptureFixture
) -> None:
    result = make(1)
    first = result.save(tmp_path)
    for name in ("run.log", "recording.rrd", "map.slam"):
        (tmp_path / name).write_text("of this result")
    before = content(tmp_path)
    assert result.save(str(tmp_path)) == first
    result.save(tmp_path / ".." / tmp_path.name)
    assert content(tmp_path) == before
    renamed = tmp_path.rename(tmp_path.with_name(f"{tmp_path.name} renamed"))
    result.save(renamed)
    assert content(renamed) == before
    assert not kept(caplog)


def test_a_result_that_has_changed_leaves_nothing_of_what_it_was(tmp_path: Path) -> None:
    """What is not of it stays, and so does its map."""
    whole = graph(1)
    less = replace(whole, covariances=None)
    less.save(tmp_path / "alone")
    kept = tmp_path / "kept"
    whole.save(kept)
    (kept / "map.slam").write_text("of somebody")
    with interrupted_at(1), pytest.raises(KeyboardInterrupt):
        less.save(kept)
    less.save(kept)
    found = content(kept)
    assert found.pop("map.slam") == b"of somebody"
    assert found == content(tmp_path / "alone")
    graph(2).save(kept)
    (kept / "covariances.csv").write_text("of somebody")
    less.save(kept)
    less.save(kept)
    assert "covariances.csv" not in content(kept), "derived, of the other result"
    (kept / "covariances.csv").write_text("of somebody")
    less.save(kept)
    assert (kept / "covariances.csv").read_text() == "of somebody"


@pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)
def test_the_last_result_is_there_as_if_it_were_alone(
    tmp_path: Path, make: Make, caplog: pytest.LogCaptureFixture
) -> None:
    """As by a cell of a notebook that is run again and again, and then an older one."""
    results = [make(number) for number in (1, 2, 3)]
    for result in (*results, results[0]):
        result.save(tmp_path / "kept")
    results[0].save(tmp_path / "alone")
    assert content(tmp_path / "kept") == content(tmp_path / "alone")
    assert not kept(caplog)


def test_a_log_goes_with_its_result_and_a_recording_stays(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    graph(1).save(tmp_path)
    for name in ("run.log", "recording.rrd"):
        (tmp_path / name).write_text("of the first")
    (tmp_path / "metrics.json").touch()
    graph(2).save(tmp_path)
    there = content(tmp_path)
    assert there["recording-earlier.rrd"] == b"of the first"
    assert not there.keys() & {"run.log", "recording.rrd", "covariances.csv"}
    (line,) = kept(caplog)
    assert "recording-earlier.rrd" in line


@pytest.mark.parametrize("second", KINDS)
@pytest.mark.parametrize("first", [*KINDS, "comparison"])
def test_a_result_of_another_kind_is_refused(tmp_path: Path, first: str, second: str) -> None:
    if first == second:
        return
    if first == "comparison":
        (tmp_path / "summary.json").write_text('{"rows": [], "failures": [], "versions": {}}')
    else:
        KINDS[first](1).save(tmp_path)
    (tmp_path / "map.slam").write_text("the only one")
    before, result = content(tmp_path), KINDS[second](2)
    with pytest.raises(DataError) as error:
        result.save(tmp_path)
    said = str(error.value)
    assert str(tmp_path) in said
    assert f"of a {first}" in said
    assert "choose another folder" in said
    assert "\n" not in said
    assert content(tmp_path) == before
    result.save(tmp_path / "another")


def test_a_run_that_goes_on_does_not_replace_another_kind(tmp_path: Path) -> None:
    graph(1).save(tmp_path)
    before = content(tmp_path)
    with pytest.raises(DataError, match="pose graph"):
        run(1).save_so_far(tmp_path, 1.0)
    assert content(tmp_path) == before


PLACES = {graph: 14, bundle: 13}
"""Files that are written or removed where a result takes the place of another one."""


@pytest.mark.parametrize(
    ("make", "step"),
    [
        slow(make, step) if step % 2 else (make, step)
        for make in OPTIMISATIONS
        for step in range(PLACES[make])
    ],
)
def test_an_interruption_at_any_file_leaves_what_is_whole_or_says_that_it_is_not(
    tmp_path: Path, make: Make, step: int
) -> None:
    folder, first, second = tmp_path / "kept", make(1), make(2)
    first.save(folder)
    second.save(tmp_path / "alone")
    before = content(folder)
    with interrupted_at(step), pytest.raises(KeyboardInterrupt):
        second.save(folder)
    found = content(folder)
    if "status" not in json.loads(found["metrics.json"]):
        assert found == before
    else:
        assert json.loads(found["metrics.json"])["status"] == "unfinished"
    second.save(folder)
    assert content(folder) == content(tmp_path / "alone")


@pytest.mark.parametrize("make", OPTIMISATIONS)
def test_an_interruption_of_a_second_save_loses_nothing(tmp_path: Path, make: Make) -> None:
    result = make(1)
    result.save(tmp_path)
    before = content(tmp_path)
    for step in range(len(before) + 1):
        with interrupted_at(step), pytest.raises(KeyboardInterrupt):
            result.save(tmp_path)
        found = content(tmp_path)
        assert found.keys() == before.keys()
        assert all(found[name] == before[name] for name in before if name != "metrics.json")
    result.save(tmp_path)
    assert content(tmp_path) == before


@pytest.mark.parametrize("make", OPTIMISATIONS)
def test_no_place_is_left_out(tmp_path: Path, make: Make) -> None:
    make(1).save(tmp_path)
    with interrupted_at(1000) as begun:
        make(2).save(tmp_path)
    assert len(begun) == PLACES[make]
    assert begun[-1] == tmp_path / "metrics.json"
