# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What `make test` leaves out is more of what it runs: every file of tests has quick ones."""

import ast
from pathlib import Path

import pytest
from groups import slow, slow_but

FILES = sorted(Path(__file__).parent.glob("test_*.py"))
MARK = "pytest.mark.slow"

SLOW_ALONE = {
    "test_documented_recordings": "test_documented_start and test_documented_methods do steps of "
    "pages, test_documented_commands looks at the names of commands and options of all",
    "test_long_flight": "minutes are its subject; `make gate` measures the same quantity",
    "test_relocalization": "places that join segments are in test_recovery, runs that are located "
    "in a map in test_map_runs, loops with a scale in test_loop_scale",
    "test_site": "`.ci/run` builds the site, with warnings as errors",
}
"""Files without a quick test, and where their subject is looked at quickly."""


def has_quick(source: str) -> bool:
    """Whether a file of tests has a test that is not marked as slow."""
    tree = ast.parse(source)
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark":
            marks = node.value.elts if isinstance(node.value, ast.List) else [node.value]
            if MARK in map(ast.unparse, marks):
                return False
    return any(
        isinstance(node, ast.FunctionDef)
        and node.name.startswith("test_")
        and MARK not in map(ast.unparse, node.decorator_list)
        for node in tree.body
    )


def test_every_file_has_a_quick_test() -> None:
    without = {path.stem for path in FILES if not has_quick(path.read_text(encoding="utf-8"))}
    assert without == set(SLOW_ALONE)


@pytest.mark.parametrize(
    ("source", "quick"),
    [
        ("def test_one(): ...", True),
        ("@pytest.mark.slow\ndef test_one(): ...", False),
        ("@pytest.mark.slow\ndef test_one(): ...\n@pytest.mark.data\ndef test_two(): ...", True),
        ("pytestmark = pytest.mark.slow\ndef test_one(): ...", False),
        ("pytestmark = [pytest.mark.data, pytest.mark.slow]\ndef test_one(): ...", False),
        ("def helper(): ...", False),
    ],
)
def test_marks_are_read(source: str, quick: bool) -> None:
    assert has_quick(source) == quick


def test_some_case_stays_quick() -> None:
    """Whoever renames a case, or takes the quick one away, is told."""
    assert slow_but("a", "ab") == ["a", slow("b")]
    for quick in ("", "c"):
        with pytest.raises(AssertionError):
            slow_but(quick, "ab")
