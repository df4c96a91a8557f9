# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Does what a page tells one to type, in one folder, in its order, as written.

What differs from a user's machine, so that all pages take two minutes:

- recordings are short (`documented_stock.py`), `demo` too; simulations last `TRACKS_S`, those of
  images `IMAGES_S`, those with descriptors, of which maps are made, `MAPPED_S`; comparisons last
  `COMPARED_S`, those of simulations and of front ends `BRIEFLY_S`, and have at most `SEEDS` seeds;
- pictures of matplotlib are made, but not rendered, which takes as long as a short run;
- `slam-graph` is called in this process, and so are the tasks of `batch` and `compare`;
- a window of Rerun is not opened: what would go there is kept in memory;
- the Dask cluster runs in this process, under another address.
"""

import io
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from documented import HELP, Step, blocks, steps
from documented_stock import TRACKS_S, Stock
from limits import HANG_S
from typer.testing import CliRunner

import slam_graph as sg
from slam_graph.backend import POSE_SELECTIONS
from slam_graph.cli.main import app
from slam_graph.datasets import dataset_registry
from slam_graph.datasets.formats import eqvio
from slam_graph.datasets.formats.eqvio import wheel_tracks
from slam_graph.errors import SlamGraphError
from slam_graph.experiment import executors, tasks
from slam_graph.frontend import DETECTORS
from slam_graph.plugins import Registry
from slam_graph.visualization import RerunRecording
from slam_graph.visualization.rerun_stream import RerunStream
from slam_graph.visualization.style import Picture

IMAGES_S = 0.2
COMPARED_S = 1.5
BRIEFLY_S = 0.5
MAPPED_S = 4.0
SEEDS = 2

SKIPPED = {
    r"apt-get ": "Debian's package manager, as root",
    r"pip install ": "downloads; tests/test_packaging.py installs the package",
    r"jupyter ": "opens a browser; tests/test_notebooks.py executes the notebooks",
    r"kalibr_": "Kalibr, which needs ROS 1",
    r"ros2 ": "ROS 2 with the driver of a camera",
    r"dask ": "runs until it is stopped; the cluster of the test takes its place",
    r"make demo": "tests/test_documented_commands.py compares what it prints",
    r"make (bench|gate)": "minutes to hours; tests/test_benchmarks.py",
    r"make tables": "tests/test_benchmark_baseline.py",
}
"""Commands that are not executed here, and why or where."""

EXITS = {
    r"run path/to/2011_09_26/": 3,  # the images of this made-up drive are noise
    r"run walk.mp4 .*phone.yaml": 3,  # its unknown mounting is found in turns longer than this
}
"""Commands whose made-up recording does not start (3): they read it, and say what they lack."""


STANDS_FOR = {
    "DATA": "path/to/MH_01_easy",
    "FILE": "my_algorithm.yaml",
    "OUTPUT": "converted",
    "FOLDER": "recorded",
    "OUT": "simulated",
    "STAMP": "2.5",
    "TRUTH": "walk.tum",
    "ESTIMATE": "walk.tum",
    "WHAT": "graph.g2o",
    "my.yaml": "my_algorithm.yaml",
    "flight": "monday",
    "flight/": "flight.bag",
    "6.5": "2.5",
}
"""What a command within a sentence or a table is executed with, by the word that it has there."""


def in_place(step: Step) -> Step:
    """A command within a sentence with files of the stock in place of its words in capitals."""
    words = [STANDS_FOR.get(word, word) for word in step.text.split()]
    if "backend.initialization.mode=static" in words:  # that of the stock moves at its start
        words[words.index(STANDS_FOR["DATA"])] = "demo"
    return Step(step.place, " ".join(words))


def can_take_screenshots() -> bool:
    """Whether the viewer of Rerun finds a driver of Vulkan here."""
    folders = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))
    return any(True for folder in folders for _ in folder.glob("*.json"))


def is_skipped(step: Step) -> bool:
    return not step.is_python and any(re.match(pattern, step.text) for pattern in SKIPPED)


@dataclass
class Session:
    """The folder of a page, and the names that its blocks of Python have defined.

    Attributes:
        folder: where everything happens.
        names: of Python.
        scheduler: address of a Dask cluster that takes the place of the documented one.
    """

    folder: Path
    names: dict[str, Any] = field(default_factory=dict)
    scheduler: str = ""

    def fault(self, step: Step) -> str:
        """What went wrong with a step; empty if nothing."""
        if "screenshot" in step.text and not can_take_screenshots():
            return ""  # as tests/test_rerun_viewers.py, which looks at the pictures
        if step.is_python:
            return self._python(step)
        words = shlex.split(step.text)
        if words[0] == "slam-graph":
            return self._slam_graph(step, words[1:])
        if words[0] == "rosbags-convert":
            program = Path(sys.executable).with_name(words[0])
            done = subprocess.run(
                [program, *words[1:]], capture_output=True, text=True, timeout=HANG_S
            )
            return done.stderr if done.returncode else ""
        return "neither ours nor in the list of what is skipped"

    def _python(self, step: Step) -> str:
        try:
            with redirect_stdout(io.StringIO()):
                exec(compile(_short_python(step.text), step.place, "exec"), self.names)
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        results = [value for value in self.names.values() if isinstance(value, sg.RunResult)]
        return "; ".join(result.message for result in results if result.status != "ok")

    def _slam_graph(self, step: Step, words: list[str]) -> str:
        words, to = _redirected(words)
        if "--scheduler" in words:
            words[words.index("--scheduler") + 1] = self.scheduler
        done = CliRunner().invoke(app, shortened(words))
        if to:
            Path(to).write_text(done.stdout, encoding="utf-8")
        error = done.exception
        printed = f"error: {error}" if isinstance(error, SlamGraphError) else done.output
        code = error.exit_code if isinstance(error, SlamGraphError) else done.exit_code
        if step.printed:
            shown = "\n".join(step.printed).strip()
            return "" if printed.strip() == shown else f"prints\n{printed}"
        expected = next((EXITS[p] for p in EXITS if re.match(p, " ".join(words))), 0)
        return "" if code == expected else f"exit code {code}: {printed or repr(error)}"


def shortened(words: list[str]) -> list[str]:
    """A command whose simulation or comparison is short, with few seeds and early faults."""
    made = [re.sub(r"\bat_s=[\d.]+", "at_s=1.5", word) for word in words]
    if "--seeds" in made:
        at = made.index("--seeds") + 1
        made[at] = str(min(int(made[at]), SEEDS))
    longest = _longest_s(words)
    if longest is not None:
        if "--duration" in made:
            at = made.index("--duration") + 1
            made[at : at + 1] = [str(min(float(made[at]), longest))]
        else:
            made += ["--duration", str(longest)]
    return made


def _longest_s(words: list[str]) -> float | None:
    """The longest duration of a command; None if its recording is short."""
    if words[0] == "simulate":
        if "tracks.descriptors=true" in words:
            return MAPPED_S
        return IMAGES_S if "images" in words else TRACKS_S
    if "compare" in words[:2]:
        cheap = words[0] == "compare" and not any("sim:" in word for word in words)
        return COMPARED_S if cheap else BRIEFLY_S
    return None


def _short_python(text: str) -> str:
    """A block of Python in which durations are short; repetitions with seeds are a comparison."""
    longest = BRIEFLY_S if "seeds=" in text else TRACKS_S
    return re.sub(
        r"\bduration_s=(\d+)", lambda found: f"duration_s={min(float(found[1]), longest)}", text
    )


def _redirected(words: list[str]) -> tuple[list[str], str]:
    """A command without `> FILE`, and the file."""
    return (words[:-2], words[-1]) if ">" in words[-2:-1] else (words, "")


def do_tasks_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tasks of `batch` and `compare` in this process, which has imported everything, in turn."""
    one_at_a_time = threading.Lock()

    def do(text: str, wanted: object = None) -> str | None:
        try:
            with one_at_a_time:
                tasks._ANY_TASK.validate_json(text).do()
        except Exception as error:
            return str(error)
        return None

    monkeypatch.setattr(executors, "_TaskProcess", lambda text: text)
    monkeypatch.setattr(executors, "_wait", do)


def replace_what_is_slow(monkeypatch: pytest.MonkeyPatch, demo: Path) -> None:
    """A short `demo`, no windows, and tasks in this process."""

    def to_memory(stream: Any) -> None:
        stream._raw.memory_recording()

    empty = bytes(cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1])
    monkeypatch.setattr(Picture, "png", lambda picture: empty)
    for module in (dataset_registry, eqvio):
        monkeypatch.setattr(module, "wheel_tracks", lambda: demo)
    do_tasks_here(monkeypatch)
    monkeypatch.setattr(RerunStream, "_spawn", to_memory)
    monkeypatch.setattr(RerunRecording, "open", staticmethod(lambda recording: None))


def check_page(page: str, stock: Stock, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Do all steps of a page in a new folder; fails with a line for each that does not work.

    Args:
        page: path from the top of the checkout, or `HELP`.
        stock: what the page takes for granted.
        folder: empty.
        monkeypatch: undoes at the end what is replaced.
    """
    files = [] if page == HELP else [content for _, _, content in blocks(page, "yaml")]
    check_steps(steps(page), stock, folder, monkeypatch, files, stock.names(page))


def check_steps(
    all_steps: list[Step],
    stock: Stock,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    files: Sequence[str] = (),
    names: Mapping[str, object] | None = None,
) -> None:
    """Do steps; arguments as for `check_page`.

    Args:
        all_steps: in their order; those that are listed above are left out.
        stock: what they take for granted.
        folder: empty.
        monkeypatch: undoes at the end what is replaced.
        files: texts that name what is needed too.
        names: that are defined in Python.
    """
    todo = [step for step in all_steps if not is_skipped(step)]
    shown = [step.text for step in todo]
    stock.fill(folder, "\n".join([*shown, *files]))
    replace_what_is_slow(monkeypatch, stock("demo.csv") / wheel_tracks().name)
    forget_registered(monkeypatch, POSE_SELECTIONS, DETECTORS)
    monkeypatch.chdir(folder)
    session = Session(folder, {"__name__": "page", **(names or {})})
    with dask_cluster(any("--scheduler" in text for text in shown)) as session.scheduler:
        faults = [(step, session.fault(step)) for step in todo]
    report = [f"{step.place}: {step.text}\n    {fault}" for step, fault in faults if fault]
    assert not report, "\n".join(["", *report])


@contextmanager
def dask_cluster(wanted: bool) -> Iterator[str]:
    """The address of a cluster of one worker in this process; empty if none is wanted."""
    if not wanted:
        yield ""
        return
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
    ) as cluster:
        yield cluster.scheduler_address


def forget_registered(monkeypatch: pytest.MonkeyPatch, *registries: Registry[Any]) -> None:
    """What blocks of Python register is gone at the end of the test."""
    for registry in registries:
        list(registry.working())  # imports the package's own parts, which stay
        monkeypatch.setattr(registry, "_parts", dict(registry._parts))
