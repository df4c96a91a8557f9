# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A disk that is full or cannot be written: one line, a documented exit code, nothing half done."""

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import slam_graph

from slam_graph.cli.main import main
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.simulation.simulator import simulate

SMALL = 4000
"""Bytes that a file may have where the disk is said to be full."""

HANG_S = 300

Arguments = Callable[["Stock", Path], list[str]]


class Stock:
    """Recordings and results to begin with."""

    def __init__(self, folder: Path) -> None:
        self.fonts = folder / "fonts"
        self.images, self.tracks, self.run = folder / "images", folder / "tracks", folder / "runs"
        images = ["--kind", "images", "--duration", "1", "--rate", "4"]
        tracks = ["--duration", "2.5", "--set", "tracks.descriptors=true"]
        short = ["--no-progress", "--no-final-ba", "--save-map"]
        for arguments in (
            ["simulate", str(self.images), "--no-progress", *images],
            ["simulate", str(self.tracks), "--no-progress", *tracks],
            ["run", str(self.tracks), "--output", str(self.run), *short],
            ["frontend", "run", str(self.images), "--picture", os.devnull],
        ):
            done = self.command(arguments, folder)
            assert done.returncode == 0, done.stderr
        self.run = self.run / "tracks" / "latest"
        self.map = self.run / "map.slam"
        self.graph = folder / "a.g2o"
        poses = range(60)
        self.graph.write_text(
            "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in poses)
            + "".join(f"EDGE_SE2 {k} {k + 1} 1 0 0 9 0 0 9 0 9\n" for k in poses[:-1])
        )

    def command(
        self,
        arguments: list[str],
        folder: Path,
        limit: int | None = None,
        fonts: Path | None = None,
    ) -> subprocess.CompletedProcess[str]:
        """Run a command; its files may have so many bytes.

        Matplotlib looks for fonts only once, unless the folder for what it found is another one.
        """
        env = {**os.environ, "MPLCONFIGDIR": str(fonts or self.fonts)}
        return slam_graph(*arguments, cwd=folder, env=env, limit=limit, rendered=limit is not None)


@pytest.fixture(scope="module")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Stock:
    return Stock(tmp_path_factory.mktemp("stock"))


COMMANDS: dict[str, Arguments] = {
    "run": lambda s, to: ["run", f"{s.tracks}", "--no-progress", "--output", f"{to}/out"],
    "localize": lambda s, to: [
        *("localize", f"{s.tracks}", "--map", f"{s.map}", "--no-progress", "--output", f"{to}/out"),
    ],
    "batch": lambda s, to: ["batch", f"{s.tracks}", "--jobs", "1", "--output", f"{to}/out"],
    "compare": lambda s, to: [
        *("compare", f"{s.tracks}", "--algorithms", "msckf", "--workers", "1"),
        *("--output", f"{to}/out"),
    ],
    "optimize": lambda s, to: ["optimize", f"{s.graph}", "--output", f"{to}/out"],
    "optimize --save": lambda s, to: [
        *("optimize", f"{s.graph}", "--output", f"{to}/out", "--save", f"{to}/b.g2o"),
    ],
    "simulate": lambda _, to: ["simulate", f"{to}/out", "--duration", "2", "--no-progress"],
    "simulate images": lambda _, to: [
        *("simulate", f"{to}/out", "--kind", "images", "--duration", "1", "--rate", "3"),
    ],
    "convert": lambda s, to: ["data", "convert", f"{s.images}", f"{to}/out", "--no-progress"],
    "export": lambda s, to: ["export", f"{s.run}", "--tum", f"{to}/a.tum"],
    "map export": lambda s, to: ["map", "export", f"{s.map}", "--ply", f"{to}/a.ply"],
    "frontend": lambda s, to: ["frontend", "run", f"{s.images}", "--picture", f"{to}/a.png"],
    "frontend --video": lambda s, to: [
        *("frontend", "run", f"{s.images}", "--picture", os.devnull, "--video", f"{to}/a.mp4"),
    ],
    "frontend --record": lambda s, to: [
        *("frontend", "run", f"{s.images}", "--picture", os.devnull, "--record", f"{to}/out"),
    ],
    "view": lambda s, to: ["view", f"{s.run}", "--output", f"{to}/a.rrd"],
}


def check_refused(done: subprocess.CompletedProcess[str]) -> None:
    """One line of ours, and the documented exit code."""
    assert done.returncode == 1, done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert done.stderr.splitlines()[-1] == errors[0]
    assert "Traceback" not in done.stderr
    assert "internal error" not in done.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_in_the_place_of_a_folder(stock: Stock, tmp_path: Path, name: str) -> None:
    place = tmp_path / "place"
    place.write_text("kept")
    check_refused(stock.command(COMMANDS[name](stock, place), tmp_path))
    assert place.read_text() == "kept"


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ("view", "localize")])
def test_a_full_disk_leaves_nothing_half_written(stock: Stock, tmp_path: Path, name: str) -> None:
    """Rerun writes by itself and knows no limit to the size of files; localize writes like run."""
    place = tmp_path / "place"
    place.mkdir()
    done = stock.command(COMMANDS[name](stock, place), tmp_path, limit=SMALL)
    check_refused(done)
    assert not [path for path in place.rglob("*") if path.name.startswith(".")]
    assert not list(place.rglob("latest"))


def test_a_disk_that_is_too_full_for_fonts_is_no_traceback(stock: Stock, tmp_path: Path) -> None:
    arguments = COMMANDS["frontend"](stock, tmp_path)
    check_refused(stock.command(arguments, tmp_path, limit=SMALL, fonts=tmp_path / "fonts"))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
@pytest.mark.parametrize("name", ["export", "optimize --save", "frontend"])
def test_dev_full(stock: Stock, tmp_path: Path, name: str) -> None:
    before = os.stat("/dev/full")
    arguments = COMMANDS[name](stock, tmp_path)
    arguments[-1] = "/dev/full"
    check_refused(
        stock.command([*arguments, *(["--force"] if name.startswith("opt") else [])], tmp_path)
    )
    assert os.stat("/dev/full").st_rdev == before.st_rdev  # it is not replaced by a file


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_an_output_that_cannot_be_written(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "slam_graph.cli.launch", "config", "dump"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=HANG_S,
        )
    check_refused(done)


def test_what_was_there_stays_where_the_new_cannot_be_written(stock: Stock, tmp_path: Path) -> None:
    old = tmp_path / "a.tum"
    old.write_text("older results\n")
    again = [*COMMANDS["export"](stock, tmp_path), "--force"]
    check_refused(stock.command(again, tmp_path, limit=200))
    assert old.read_text() == "older results\n"
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".tum"] == ["a.tum"]


def test_a_folder_that_is_no_folder_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(sys, "argv", ["slam-graph", "simulate", f"{tmp_path}/file/flight"])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 1
    assert "a file is in the place of a folder" in capsys.readouterr().err


def test_recordings_say_what_they_lack_and_leave_nothing(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (SMALL, limits[1]))
    try:
        with pytest.raises(DataError, match=r"flight: cannot be written \(File too large"):
            simulate(duration_s=2.0).save(tmp_path / "flight")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert not list(tmp_path.iterdir())


def test_remains_of_killed_processes_are_removed(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _LEAVES, str(tmp_path)], timeout=HANG_S, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert len(list(tmp_path.glob(".*.partial"))) == 2
    own = Files.partial_folder(tmp_path / "own")
    Files.remove_remains(tmp_path)
    assert list(tmp_path.iterdir()) == [own]


_LEAVES = """
import os, signal, sys
from pathlib import Path
from slam_graph.files import Files
folder = Path(sys.argv[1])
Files.partial_folder(folder / "flight")
with Files.appearing(folder / "a.txt") as partial:
    partial.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_long_names_are_cut(tmp_path: Path) -> None:
    path = tmp_path / ("é" * 100)
    with Files.appearing(path) as partial:
        partial.write_text("whole")
    assert path.read_text() == "whole"
