# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Help, completion and progress: what the command line does for who does not know it yet."""

import os
import pty
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from limits import HANG_S
from typer.testing import CliRunner

from slam_graph.backend.smoothing.adjustment_progress import SegmentProgress
from slam_graph.cli.help_texts import EXAMPLES
from slam_graph.cli.main import app

COMMAND = [sys.executable, "-m", "slam_graph.cli.main"]
INFOS: list[Any] = [*app.registered_commands, *app.registered_groups]
NAMES = [str(info.name) for info in INFOS]


@pytest.mark.parametrize("name", ["", *NAMES])
def test_every_command_has_examples_in_its_help(name: str) -> None:
    shown = CliRunner().invoke(app, [*name.split(), "--help"], env={"COLUMNS": "120"}).stdout
    assert "Examples" in shown
    for line in EXAMPLES[name]:
        assert line in shown


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("run demo --duratoin 5", "--duration"),
        ("data info demo --jsn", "--json"),
        ("--versoin", "--version"),
        ("rnu demo", "run"),
    ],
)
def test_what_is_mistyped_is_answered_by_what_was_meant(words: str, meant: str) -> None:
    done = CliRunner().invoke(app, words.split())
    assert done.exit_code == 2
    assert re.search(rf"Did you mean '?{meant}'?\?", done.stderr)


@pytest.mark.parametrize(
    ("words", "answer"),
    [("slam-graph ba", "batch"), ("slam-graph run demo --durat", "--duration")],
)
def test_a_shell_can_complete(words: str, answer: str) -> None:
    environment = {
        **os.environ,
        "_SLAM_GRAPH_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    done = subprocess.run(COMMAND, env=environment, capture_output=True, text=True, timeout=HANG_S)
    assert done.stdout.split() == [answer]


def test_completion_is_installed(tmp_path: Path) -> None:
    environment = {**os.environ, "HOME": str(tmp_path), "SHELL": "/bin/bash"}
    environment["_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION"] = "1"  # that of the tests
    done = subprocess.run(
        [*COMMAND, "--install-completion", "bash"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stderr
    (script,) = (tmp_path / ".bash_completions").iterdir()
    assert "_SLAM_GRAPH_COMPLETE" in script.read_text()


def test_a_terminal_shows_bars_of_the_run_and_of_the_final_adjustment(tmp_path: Path) -> None:
    """In a terminal the run has a bar, and the final adjustment one that moves."""
    shown = in_terminal("run", "demo", "--duration", "7.5", "--output", str(tmp_path))
    assert shown.index("loading") < shown.index("frames")
    parts = [int(part) for part in re.findall(r"final BA[^\n]*?(\d+)%", shown)]
    assert len(set(parts)) > 2
    assert parts == sorted(parts)
    assert parts[-1] == 100
    assert re.search(r"final BA[^\n]*?\d\d:\d\d", shown), "the time that is left"


def in_terminal(*arguments: str) -> str:
    """What a command shows in a terminal, without its colours."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ.update(TERM="xterm-256color", COLUMNS="120", LINES="40")
        os.execv(COMMAND[0], [*COMMAND, *arguments])
    shown = b""
    while True:
        try:
            more = os.read(terminal, 65536)
        except OSError:  # how Linux says that the other side is closed
            break
        if not more:
            break
        shown += more
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0, shown
    return re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", shown.decode())


@pytest.mark.parametrize("fuses", [True, False])
def test_progress_of_an_adjustment_moves_and_never_ends_early(fuses: bool) -> None:
    told: list[int] = []
    progress = SegmentProgress(
        lambda done, *_: told.append(done), 100, 100, 200, steps=0, fuses=fuses
    )
    steps = 0
    for rounds in range(4 if fuses else 0):
        for _ in range(6):
            steps += 1
            progress.fusing(steps, rounds)
    for passes in range(4):
        for _ in range(10):
            steps += 1
            progress.solving(steps, passes)
    assert told == sorted(told)
    assert 100 < told[0] < 150
    assert 190 < told[-1] < 200
    assert len(set(told)) > 20
    progress.solving(1, 0)
    assert told[-1] == told[-2], "an adjustment that starts again is not set back"
