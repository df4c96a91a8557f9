# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A result in the folder of another one: files of the other make room, and nothing else.

What may be the only copy, a map and a recording for the viewer, is kept under another name.
"""

import ast
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from flight import rig
from groups import slow
from interruption import interrupted_at

import slam_graph
from slam_graph.config import load_config
from slam_graph.datasets.sequence import SequenceInfo
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.results import result_files as names
from slam_graph.results import run_files
from slam_graph.results.earlier_result import is_file_of_result
from slam_graph.results.run_input import RunInput
from slam_graph.results.run_result import RunResult
from slam_graph.results.saved_run import load_result

OPTIONAL = (
    *(names.SMOOTHED, names.SMOOTHED_STATES, names.LOOP_CLOSED, names.LOOPS, names.IN_MAP),
    *(names.GROUNDTRUTH, names.MAP_NAME, names.ESTIMATED_RIG, names.ADJUSTED_RIG),
    *("calibration.csv", "run.log"),
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


def with_map(name: str, monkeypatch: pytest.MonkeyPatch) -> RunResult:
    """A result with a map, in whose file its name is."""
    result = result_of(name)
    nowhere = SimpleNamespace(stamps_ns=np.zeros(0, np.int64))
    known = {"summary": dict, "recordings": [1], "trajectory": lambda _: nowhere, "name": name}
    result.slam_map = SimpleNamespace(**known)  # type: ignore[assignment]

    def save(made: SimpleNamespace, path: Path, force: bool) -> None:
        assert force
        Files.write_text(path, [made.name])

    monkeypatch.setattr(run_files, "save_map", save)
    return result


def test_no_file_of_another_result_is_left(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    files = result_of("second").save(folder)
    assert not left_of_the_first(folder)
    for name in ("map-earlier.slam", "recording-earlier.rrd"):
        assert (folder / name).read_text() == "of the first"
        assert sum(name in line for line in caplog.messages) == 1
    assert len(caplog.messages) == 2
    assert not any("\n" in line for line in caplog.messages)
    assert all((folder / name).read_text() == "of the first" for name in OF_A_USER)
    saved = load_result(folder)
    assert saved.metrics["dataset"]["name"] == "second"
    assert (saved.smoothed, saved.loop_closed, saved.slam_map) == (None, None, None)
    assert {path.name for path in files} <= {path.name for path in folder.iterdir()}
    (folder / "objects" / "mine.tum").unlink()
    (folder / "objects" / "3.tum").write_text("")
    result_of("third").save(folder)
    assert not (folder / "objects").exists(), "nothing is left in it"


def test_a_map_is_lost_only_to_a_map_in_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As by a cell of a notebook that is run again and again."""
    for name in ("first", "second"):
        with_map(name, monkeypatch).save(tmp_path)
        assert {path.name: path.read_text() for path in tmp_path.glob("*.slam")} == {
            "map.slam": name
        }
    assert not caplog.messages
    for _ in range(3):
        result_of("without").save(tmp_path)
        with_map("third", monkeypatch).save(tmp_path)
        result_of("without").save(tmp_path)
        result_of("without").save(tmp_path)
    assert {path.name: path.read_text() for path in tmp_path.glob("*.slam")} == {
        "map-earlier.slam": "second",
        "map-earlier-2.slam": "third",
        "map-earlier-3.slam": "third",
        "map-earlier-4.slam": "third",
    }
    assert len(caplog.messages) == 4


def test_a_run_that_cannot_write_its_map_keeps_that_of_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_map("first", monkeypatch).save(tmp_path)
    second = with_map("second", monkeypatch)

    def full(*_: object, **__: object) -> None:
        raise DataError("the disk is full")

    monkeypatch.setattr(run_files, "save_map", full)
    with pytest.raises(DataError, match="full"):
        second.save(tmp_path)
    assert (tmp_path / "map-earlier.slam").read_text() == "first"
    assert load_result(tmp_path).status == "unfinished"


def test_a_link_to_the_folder_of_objects_is_no_error(folder: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    (folder / "objects" / "mine.tum").unlink()
    (folder / "objects").rename(elsewhere)
    (folder / "objects").symlink_to(elsewhere)
    result_of("second").save(folder)
    assert (folder / "objects").is_symlink()
    assert load_result(folder).status == "ok"


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


@pytest.mark.parametrize("step", [1, slow(15), 23])
def test_it_is_so_after_an_interruption_too(folder: Path, step: int) -> None:
    """Whether the second result has its own metrics there by then, or not yet."""
    later_ns = (folder / names.METRICS).stat().st_mtime_ns + 1
    os.utime(folder / "recording.rrd", ns=(later_ns, later_ns))
    second = result_of("second")
    with interrupted_at(step), pytest.raises(KeyboardInterrupt):
        second.save(folder)
    second.save(folder)
    assert [path.name for path in folder.glob("*.rrd")] == ["recording.rrd"]


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
    (folder / "run.log").write_text("of the second")
    (folder / names.MAP_NAME).write_text("of the second")
    for _ in range(2):
        result.save(folder)
        for name in ("recording.rrd", "run.log", names.MAP_NAME):
            assert (folder / name).read_text() == "of the second"
    third = result_of("third")
    third.save(folder)
    result.save(folder)
    assert not left_of_the_first(folder), "the third has taken the place of the second meanwhile"
    assert load_result(folder).metrics["dataset"]["name"] == "second"


PLACES = 41
"""Files that are written, renamed or removed when a result takes the place of the first."""


@pytest.mark.parametrize("step", [slow(n) if n % 2 else n for n in range(PLACES)])
def test_an_interruption_at_any_file_leaves_no_mixture(folder: Path, step: int) -> None:
    """Nothing can be read then, or one of the results; with its mark if it is not whole."""
    second = result_of("second")
    with interrupted_at(step), pytest.raises(KeyboardInterrupt):
        second.save(folder)
    for pattern in ("map*.slam", "recording*.rrd"):
        assert [path.read_text() for path in folder.glob(pattern)] == ["of the first"]
    with suppress(DataError):
        saved = load_result(folder)
        left, name = left_of_the_first(folder), saved.metrics["dataset"]["name"]
        assert not left or (name, left) == ("first", set(OPTIONAL))
        assert saved.status == ("ok" if step == 0 else "unfinished")
        return
    assert not (folder / names.TRAJECTORY).exists()
    second.save(folder)
    assert not left_of_the_first(folder)
    assert load_result(folder).status == "ok"


def test_no_place_is_left_out(folder: Path) -> None:
    with interrupted_at(1000) as begun:
        result_of("second").save(folder)
    assert len(begun) == PLACES


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
