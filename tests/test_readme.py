# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What README and pages show is true: Python runs, commands exist, the demo prints its lines."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

from limits import HANG_S
from typer.testing import CliRunner

from slam_graph.cli.main import app

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [README, *(page.read_text("utf-8") for page in sorted((ROOT / "docs").rglob("*.md")))]

GROUPS = ("data", "config", "frontend", "map")
"""Commands of `slam-graph` that have commands of their own."""


def blocks(language: str, page: str = README) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


def shell_lines() -> list[str]:
    """The commands of all pages, once each."""
    scripts = [block.replace("\\\n", " ") for page in PAGES for block in blocks("sh", page)]
    shown = [line for script in scripts for line in script.splitlines() if line]
    shown += [line for page in PAGES for line in re.findall(r"`(slam-graph [a-z][^`…]*)`", page)]
    typed = [block for page in PAGES for block in blocks("console", page)]
    ours = re.findall(r"^\$ ((?:slam-graph|make) .*)$", "\n".join(typed), re.MULTILINE)
    return sorted({*shown, *ours})


def first_words(text: str) -> list[str]:
    """The label of each line of the report of a run."""
    return [line.split("  ")[0] for line in text.splitlines() if line[:1].isalpha()]


def test_python_example_runs_in_ten_lines(tmp_path: Path) -> None:
    (example,) = blocks("python")
    assert len([line for line in example.splitlines() if line.strip()]) == 10
    done = subprocess.run(
        [sys.executable, "-c", example],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) < 0.0052, "msckf and swf are this many metres apart"
    assert (tmp_path / "results" / "msckf" / "trajectory.tum").is_file()


def fault_of(line: str) -> str:
    """What is wrong with a command that is shown; empty if nothing."""
    program, *words = shlex.split(line)
    if program == "make":
        done = subprocess.run(["make", "-n", *words], cwd=ROOT, capture_output=True, text=True)
        return done.stderr if done.returncode else ""
    if program == "dask":  # of another package
        return ""
    if program != "slam-graph":
        return "neither make nor slam-graph"
    command = words[: 2 if words[0] in GROUPS else 1]
    shown = CliRunner().invoke(app, [*command, "--help"])
    if shown.exit_code != 0:
        return f"no command {command}"
    options = [word for word in words if word.startswith("-")]
    unknown = [word for word in options if not re.search(rf"(^|[\s,]){word}\b", shown.stdout)]
    return f"no option {unknown}" if unknown else ""


def test_commands_exist() -> None:
    faults = {line: fault_of(line) for line in shell_lines()}
    assert len(faults) > 20
    assert not {line: fault for line, fault in faults.items() if fault}


def test_targets_that_are_named_exist() -> None:
    targets = set(re.findall(r"`make ([a-z]+)", README + (ROOT / "CONTRIBUTING.md").read_text()))
    assert {"bench", "check"} <= targets
    for target in targets:
        done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def test_demo_prints_what_is_shown(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "quickstart.md").read_text(encoding="utf-8")
    shown = blocks("console", page)[0].splitlines()
    done = subprocess.run(
        [sys.executable, "-m", "slam_graph.cli.main", "run", "demo", "--no-progress"],
        cwd=tmp_path,
        env=os.environ,
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stderr
    printed = done.stdout.splitlines()
    assert shown[0] == "$ make demo"
    assert first_words("\n".join(shown[1:-2])) == first_words("\n".join(printed[:-2]))
    assert shown[-1] == printed[-1], "the list of files"
    assert shown[4] == printed[3], "how much was read"
