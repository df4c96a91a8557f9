# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What README and pages show is true: lists of what is not executed, and what commands print."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from documented import GROUPS, HELP, PARTS, ROOT, blocks, inline_commands, pages, pages_of, steps
from documented_runs import EXITS, SKIPPED, is_skipped
from limits import HANG_S
from typer.testing import CliRunner

from slam_graph.cli.main import app

STEPS = {page: steps(page) for page in pages()}
TYPED = [step for page in STEPS for step in STEPS[page]]


def test_every_page_is_done_by_one_file_of_tests() -> None:
    done = [page for part in (*PARTS, "methods") for page in pages_of(part)]
    assert sorted(done) == sorted(page for page in STEPS if STEPS[page])
    assert {page for part in PARTS.values() for page in part} <= set(done), "pages that are listed"
    assert len(TYPED) > 150


@pytest.mark.parametrize("pattern", [*SKIPPED, *EXITS])
def test_every_exception_is_of_something(pattern: str) -> None:
    """An exception that nothing needs any more goes."""
    assert any(
        re.match(pattern, step.text.removeprefix("slam-graph "))
        for step in TYPED
        if not step.is_python
    )


def test_what_is_ours_is_never_skipped() -> None:
    ours = [step for step in TYPED if is_skipped(step) and not step.text.startswith("make ")]
    assert not [step.text for step in ours if re.match(r"slam-graph|python|rosbags", step.text)]


def test_targets_that_are_named_exist() -> None:
    texts = [
        (ROOT / page).read_text("utf-8") for page in [*pages(), "CONTRIBUTING.md"] if page != HELP
    ]
    targets = set(re.findall(r"(?:`|^\$ |^)make ([a-z]+)(?=[`\s])", "\n".join(texts), re.MULTILINE))
    assert {"bench", "check", "demo", "docs", "gate", "tables", "test"} <= targets
    for target in targets:
        done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def fault_of(line: str) -> str:
    """What is wrong with the names of a command within a sentence; empty if nothing."""
    words = line.split()[1:]
    command = words[: 2 if words[0] in GROUPS else 1]
    shown = CliRunner().invoke(app, [*command, "--help"])
    if shown.exit_code != 0:
        return f"no command {command}"
    options = [word for word in words if word.startswith("-")]
    unknown = [word for word in options if not re.search(rf"(^|[\s,]){word}\b", shown.stdout)]
    return f"no option {unknown}" if unknown else ""


def test_names_of_commands_and_options_exist() -> None:
    """Also of those that are named only, which `documented_runs.py` cannot execute."""
    faults = {line: fault_of(line) for line in inline_commands()}
    assert len(faults) > 20
    assert not {line: fault for line, fault in faults.items() if fault}


@pytest.mark.slow
def test_the_example_of_the_readme_has_ten_lines_and_its_algorithms_agree(tmp_path: Path) -> None:
    """On the whole `demo`, in a process of its own."""
    ((_, _, example),) = blocks("README.md", "python")
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


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What a run of the whole `demo` prints."""
    return printed_by("run", "demo", "--no-progress", cwd=tmp_path_factory.mktemp("demo"))


def printed_by(*words: str, cwd: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-m", "slam_graph.cli.main", *words],
        cwd=cwd,
        env=os.environ,
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def first_words(lines: list[str]) -> list[str]:
    """The label of each line of the report of a run."""
    return [line.split("  ")[0] for line in lines if line[:1].isalpha()]


@pytest.mark.slow
def test_demo_prints_what_is_shown(demo: list[str]) -> None:
    shown = next(blocks("docs/quickstart.md", "console"))[2].splitlines()
    assert shown[0] == "$ make demo"
    assert first_words(shown[1:-2]) == first_words(demo[:-2])
    assert shown[-1] == demo[-1], "the list of files"
    assert shown[4] == demo[3], "how much was read"


@pytest.mark.slow
def test_a_truth_adds_the_tables_that_are_shown(tmp_path: Path) -> None:
    """Their rows and columns; the numbers are of the real recording."""
    printed_by("simulate", "flight", "--duration", "5", "--no-progress", cwd=tmp_path)
    printed = printed_by("run", "flight", "--no-progress", cwd=tmp_path)
    _, (_, _, shown) = blocks("docs/quickstart.md", "console")
    tables = shown.splitlines()
    assert set(first_words(tables)) <= set(first_words(printed))
    heads = [line.split() for line in tables if re.match(r"(alignment|smoothed|NEES) ", line)]
    assert len(heads) == 4  # the last are NEES and NEES smoothed
    assert all(head in [line.split() for line in printed] for head in heads)
