# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels in shared libraries: who makes them, that they are used, and what they refuse."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_graph.interrupts import Interrupts
from slam_graph.kernels import library_files, library_making, linked
from slam_graph.kernels.ascending import are_among
from slam_graph.kernels.gate import observation_distances
from slam_graph.kernels.spacing import apart

pytestmark = pytest.mark.skipif(
    not library_making._tools_are_there(), reason="needs compilers and the headers of Python"
)

_RESULTS = """
import sys
import numpy as np
from slam_graph.kernels.epipolar import ray_depths
from slam_graph.kernels.null_space import triangularize_features
rng = np.random.default_rng(0)
A, B = rng.normal(size=(50, 6, 3)), rng.normal(size=(50, 6, 4))
triangularize_features(A, B)
depths = ray_depths(np.eye(3), np.ones(3), rng.normal(size=(50, 2)), rng.normal(size=(50, 2)))
print("numba" in sys.modules, *(found.tobytes().hex() for found in (A, B, depths)))
"""

_MODULES = """
import sys
from pathlib import Path
from slam_graph.kernels import linking
linking.main(0, Path(sys.argv[1]), sys.argv[2:])
"""


def _output(code: str, *arguments: str, **environment: str) -> list[str]:
    """What a process of its own prints."""
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *arguments],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    ).stdout.split()


def test_libraries_are_used_where_they_can_be_made() -> None:
    assert linked.are_linked()


def test_libraries_do_without_numba_and_give_the_same_bits() -> None:
    linked_modules, *linked_results = _output(_RESULTS)
    in_process = {"SLAM_GRAPH_KERNELS": "numba", "SLAM_GRAPH_SECOND_COMPILER": "1"}  # no second one
    compiled_modules, *compiled_results = _output(_RESULTS, **in_process)
    assert (linked_modules, compiled_modules) == ("False", "True")
    assert linked_results == compiled_results


def _observations() -> list[Any]:
    return [
        np.zeros((2, 2)),
        np.zeros((2, 2, 3)),
        np.zeros((4, 3), order="F"),
        np.zeros((2, 3), np.int64),
        np.zeros(2),
    ]


def _read_only(array: Any) -> Any:
    array.flags.writeable = False
    return array


@pytest.mark.parametrize(
    ("argument", "wrong"),
    [
        (0, np.zeros((2, 2), np.float32)),
        (0, np.zeros((2, 2), np.int64)),
        (0, np.zeros(4)),
        (0, np.zeros((2, 4))[:, ::2]),
        (0, np.zeros((2, 2), ">f8")),
        (0, [[0.0, 0.0], [0.0, 0.0]]),
        (0, None),
        (2, np.zeros((4, 3))),
        (3, np.zeros((2, 3))),
        (4, _read_only(np.zeros(2))),
    ],
)
def test_arrays_that_do_not_fit_are_refused(argument: int, wrong: object) -> None:
    given = _observations()
    observation_distances(*given)
    given[argument] = wrong
    with pytest.raises(TypeError, match=f"argument {argument} of observation_distances"):
        observation_distances(*given)


def test_other_wrong_arguments_are_refused() -> None:
    kernel: Callable[..., object] = are_among
    with pytest.raises(TypeError, match="takes 2 arguments, not 1"):
        kernel(np.arange(3))
    points: Any = np.zeros((2, 2), np.float32)
    count: Any = None
    with pytest.raises(TypeError, match="argument 1 of apart is no number"):
        apart(points, count)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A library of three modules, one of which imports another, away from the sources."""
    path = tmp_path_factory.mktemp("library") / f"made{library_files._SUFFIX}"
    _output(_MODULES, str(path), "ascending", "state_rows", "null_space")
    return path


def test_a_library_can_be_made_anywhere(made: Path) -> None:
    assert list(made.parent.iterdir()) == [made]
    library = linked._loaded(made, library_files.module_name(0))
    assert library.are_among(np.arange(4), np.array([1, 3])).tolist() == [False, True, False, True]


def test_a_module_that_another_one_imports_keeps_its_kernels(made: Path) -> None:
    library = linked._loaded(made, library_files.module_name(0))
    names = [name for name in dir(library) if not name.startswith("_")]
    assert names == ["are_among", "fill_state_rows", "triangularize_features"]


def test_a_part_that_was_left_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other part may have been made with other kernels in it."""
    paths = [tmp_path / "kernels-0.so", tmp_path / "kernels-1.so"]
    paths[0].write_text("left by a process that was interrupted")
    there: list[bool] = []
    monkeypatch.setattr(
        library_making, "_run", lambda *_: there.append(any(p.is_file() for p in paths)) or ""
    )
    library_making.make(paths)
    assert there == [False]
    assert not any(path.is_file() for path in paths)


def test_what_fails_is_not_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [tmp_path / "kernels-0.so", tmp_path / "kernels-1.so"]
    monkeypatch.setattr(library_making, "_LINKING", "slam_graph.kernels.no_such_module")
    library_making.make(paths)
    said = (tmp_path / "kernels-0.failed").read_text(encoding="utf-8")
    assert "no_such_module" in said
    monkeypatch.setattr(library_making, "_run", lambda *_: pytest.fail("tried again"))
    library_making.make(paths)


def test_a_process_that_was_killed_has_not_failed() -> None:
    kill_itself = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    fail = "raise SystemExit('this one fails')"
    run = [[sys.executable, "-c", code] for code in (kill_itself, fail)]
    assert library_making._run(run[:1]) == ""
    assert "this one fails" in library_making._run(run)


def test_ctrl_c_ends_the_wait_although_it_is_deferred() -> None:
    with Interrupts.deferred() as deferral:
        deferral(signal.SIGINT, None)
        with pytest.raises(KeyboardInterrupt):
            library_making._run([[sys.executable, "-c", "input()"]])


def test_an_old_failure_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failed = tmp_path / "kernels-0.failed"
    failed.touch()
    os.utime(failed, (0, 0))
    tried: list[int] = []
    monkeypatch.setattr(library_making, "_run", lambda commands, *_: tried.append(len(commands)))
    library_making.make([tmp_path / "kernels-0.so"])
    assert tried == [1]


def test_without_a_compiler_nothing_is_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler -pthread")
    library_making.make([tmp_path / "kernels-0.so"])
    assert not list(tmp_path.iterdir())


def test_libraries_of_long_ago_are_removed(tmp_path: Path) -> None:
    old, new = tmp_path / "kernels-old-0.so", tmp_path / "kernels-new-0.so"
    for path in (old, new):
        path.touch()
    os.utime(old, (0, 0))
    library_making._remove_stale(tmp_path)
    assert list(tmp_path.iterdir()) == [new]


def test_another_source_is_another_library(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    before = library_files.library_paths()
    copied = tmp_path / "kernels"
    copied.mkdir()
    for path in Path(library_files.__file__).parent.glob("*.py"):
        (copied / path.name).write_bytes(path.read_bytes())
    (copied / "gate.py").write_text("# another", encoding="utf-8")
    monkeypatch.setattr(library_files, "__file__", str(copied / "library_files.py"))
    library_files._digest.cache_clear()
    try:
        after = library_files.library_paths()
    finally:
        library_files._digest.cache_clear()
    assert {path.name for path in before}.isdisjoint(path.name for path in after)
    assert after[0].parent == copied / "__pycache__"
