# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A result in the folder of another one: files of the other are gone, and nothing else."""

import ast
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from flight import rig

import slam_graph
from slam_graph.config import load_config
from slam_graph.datasets.sequence import SequenceInfo
from slam_graph.errors import DataError
from slam_graph.results import result_files as names
from slam_graph.results.earlier_result import is_file_of_result
from slam_graph.results.run_input import RunInput
from slam_graph.results.run_result import RunResult
from slam_graph.results.saved_run import load_result

OPTIONAL = (
    *(names.SMOOTHED, names.SMOOTHED_STATES, names.LOOP_CLOSED, names.LOOPS, names.IN_MAP),
    *(names.GROUNDTRUTH, names.MAP_NAME, names.ESTIMATED_RIG, "calibration.csv", "run.log"),
    *("trajectory_segment_0.tum", "graph_1400_graph.txt", "graph_-5_graph.dot", "objects.csv"),
    *("objects/3.tum", "objects/3.ply", "objects/3_smoothed.tum", "recording.rrd"),
)
OF_A_USER = ("notes.txt", "trajectory_segment_a.tum", "objects/mine.tum", "paper.tex")


def result_of(name: str) -> RunResult:
    info = SequenceInfo(name, "euroc", "images", 1, 0, 0, 0, 0, False)
    return RunResult(RunInput(info, load_config(), rig(), 0, 10**9))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A result with files of all kinds, and files of a user beside them."""
    result_of("first").save(tmp_path)
    (tmp_path / "objects").mkdir()
    for name in (*OPTIONAL, *OF_A_USER):
        (tmp_path / name).write_text("of the first")
    past_ns = (tmp_path / names.METRICS).stat().st_mtime_ns - 10**9
    os.utime(tmp_path / "recording.rrd", ns=(past_ns, past_ns))
    return tmp_path


def left_of_the_first(folder: Path) -> set[str]:
    return {name for name in OPTIONAL if (folder / name).exists()}


def test_no_file_of_another_result_is_left(folder: Path) -> None:
    files = result_of("second").save(folder)
    assert not left_of_the_first(folder)
    assert all((folder / name).read_text() == "of the first" for name in OF_A_USER)
    saved = load_result(folder)
    assert saved.metrics["dataset"]["name"] == "second"
    assert (saved.smoothed, saved.loop_closed, saved.slam_map) == (None, None, None)
    assert {path.name for path in files} <= {path.name for path in folder.iterdir()}
    (folder / "objects" / "mine.tum").unlink()
    (folder / "objects" / "3.tum").write_text("")
    result_of("third").save(folder)
    assert not (folder / "objects").exists(), "nothing is left in it"


def test_files_that_are_of_no_result_stay(tmp_path: Path) -> None:
    """The folder of a recording has a ground truth, say, and other metrics."""
    for text in ("{}", "[1]", "no JSON"):
        (tmp_path / names.GROUNDTRUTH).write_text("of a user")
        (tmp_path / names.METRICS).write_text(text)
        result_of("second").save(tmp_path)
        assert (tmp_path / names.GROUNDTRUTH).read_text() == "of a user"


def test_a_later_recording_for_the_viewer_is_of_the_run_that_is_saved(folder: Path) -> None:
    later_ns = (folder / names.METRICS).stat().st_mtime_ns + 10**9
    os.utime(folder / "recording.rrd", ns=(later_ns, later_ns))
    result_of("second").save(folder)
    assert left_of_the_first(folder) == {"recording.rrd"}


def test_what_a_run_wrote_on_its_way_is_its_own(folder: Path) -> None:
    result = result_of("second")
    result.save_so_far(folder, 1.0)
    assert not left_of_the_first(folder)
    assert load_result(folder).status == "unfinished"
    (folder / "recording.rrd").write_text("of the second")
    before_ns = (folder / names.METRICS).stat().st_mtime_ns - 10**9
    os.utime(folder / "recording.rrd", ns=(before_ns, before_ns))
    result.save(folder)
    assert (folder / "recording.rrd").read_text() == "of the second"
    result.save(folder)
    assert not left_of_the_first(folder), "saved again it replaces itself"


@pytest.mark.parametrize("step", range(0, 36, 2))
def test_an_interruption_at_any_file_leaves_no_mixture(
    folder: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """Nothing can be read then, or the second result with its mark."""
    steps = iter(range(100))

    def counted(call: object) -> object:
        def wrapped(*arguments: object, **options: object) -> object:
            if next(steps) == step:
                raise KeyboardInterrupt
            return call(*arguments, **options)  # type: ignore[operator]

        return wrapped

    monkeypatch.setattr(Path, "unlink", counted(Path.unlink))
    monkeypatch.setattr(os, "replace", counted(os.replace))
    with suppress(KeyboardInterrupt):
        result_of("second").save(folder)
    monkeypatch.undo()
    try:
        saved = load_result(folder)
    except DataError:
        assert not (folder / names.TRAJECTORY).exists()
        return
    if left_of_the_first(folder):  # nothing has happened yet
        assert (saved.metrics["dataset"]["name"], saved.status) == ("first", "ok")
        assert left_of_the_first(folder) == set(OPTIONAL)
        return
    assert saved.metrics["dataset"]["name"] == "second"
    assert saved.status == "unfinished" or (folder / names.RIG).is_file()


def test_a_corrected_calibration_has_a_file(tmp_path: Path) -> None:
    result = result_of("clip")
    result.save(tmp_path)
    saved = load_result(tmp_path)
    assert not (tmp_path / names.ESTIMATED_RIG).exists()
    assert saved.estimated_rig is saved.rig
    result.corrected_rig = result.rig.shifted(0.06)
    result.save_so_far(tmp_path, 1.0)
    assert load_result(tmp_path).estimated_rig.pose_offset_s == pytest.approx(0.06)
    result.save(tmp_path)
    saved = load_result(tmp_path)
    assert result.estimated_rig.pose_offset_s == saved.estimated_rig.pose_offset_s
    assert saved.estimated_rig.pose_offset_s == pytest.approx(0.06)
    assert saved.rig.pose_offset_s == 0.0
    result.corrected_rig = None  # as that start was given up
    result.save_so_far(tmp_path, 1.0)
    assert not (tmp_path / names.ESTIMATED_RIG).exists()


def written_names() -> Iterator[str]:
    """The names that results write, by the source."""
    for path in sorted((Path(slam_graph.__file__).parent / "results").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            match node:
                case ast.Call(
                    func=ast.Attribute(
                        value=ast.Name(id="files"), attr="text" | "path" | "appearing" | "json"
                    ),
                    args=[name, *_],
                ):
                    yield _text_of(name, path)


def _text_of(node: ast.expr, path: Path) -> str:
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.Attribute(value=ast.Name(id="names"), attr=name) | ast.Name(id=name):
            module = __import__(f"slam_graph.results.{path.stem}", fromlist=[name])
            return str(getattr(names, name, None) or getattr(module, name))
        case ast.JoinedStr(values=parts):
            return "".join(
                part.value
                if isinstance(part, ast.Constant)
                else ("graph.txt" if ast.unparse(part.value) == "name" else "0")  # type: ignore[attr-defined]
                for part in parts
            )
    raise AssertionError(ast.dump(node))


def test_all_files_of_results_are_known() -> None:
    found = set(written_names())
    assert len(found) > 30
    assert {name for name in found if not is_file_of_result(name)} == {names.METRICS}
    assert not any(map(is_file_of_result, OF_A_USER))
