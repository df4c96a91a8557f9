# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The picture in docs/architecture.md is true: it shows every package, and imports obey it."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from sources import Import, imports_of

import slam_graph

PACKAGE = Path(slam_graph.__file__).parent
PAGE = Path(__file__).parent.parent / "docs" / "architecture.md"

SOLVERS = ("pose_graph", "bundle_adjustment", "loop_closure", "maps")
"""Packages that return objects; their callers write and draw."""

CALLERS = {"results", "config", "visualization"}


def picture() -> dict[str, int]:
    """Row of each package, as the page has it."""
    rows = re.findall(
        r"^\| (\d+) \| `([a-z_]+)` \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE
    )
    packages = [package for _, package in rows]
    assert len(packages) == len(set(packages)), "a package is there twice"
    numbers = [int(number) for number, _ in rows]
    assert numbers == sorted(numbers), "rows out of order"
    return {package: int(number) for number, package in rows}


def imports() -> Iterator[tuple[str, str, str]]:
    """Importing package, imported package and place of each import between packages."""
    for path in sorted(PACKAGE.rglob("*.py")):
        importer = path.relative_to(PACKAGE).with_suffix("").parts[0]
        if importer == "__init__":
            continue  # it imports nothing before a name is used
        for node in imports_of(path):
            for module in _modules(node):
                root, _, inner = module.partition(".")
                imported = inner.split(".")[0]
                if root == "slam_graph" and imported and imported != importer:
                    place = f"{path.relative_to(PACKAGE)}:{node.lineno}: {module}"
                    yield importer, imported, place


def _modules(node: Import) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    inner = node.module or ""
    return (
        [f"slam_graph.{alias.name}" for alias in node.names] if inner == "slam_graph" else [inner]
    )


def test_every_package_is_in_the_picture() -> None:
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert set(picture()) == folders | modules


def test_imports_point_to_rows_above() -> None:
    row = picture()
    against = [place for a, b, place in imports() if row[b] >= row[a]]
    assert not against


def test_solvers_know_nothing_of_their_callers() -> None:
    wrong = [place for a, b, place in imports() if a in SOLVERS and b in CALLERS]
    assert not wrong
    text = " ".join(PAGE.read_text(encoding="utf-8").split())
    assert all(f"`{name}`" in text for name in (*SOLVERS, *CALLERS))


def test_the_simulation_is_independent_of_what_it_tests() -> None:
    wrong = [p for a, b, p in imports() if a == "simulation" and b in ("frontend", "backend")]
    assert not wrong


def test_files_are_short_and_have_names_of_their_own() -> None:
    """No file over 400 lines, and no two of the same name."""
    files = [path for path in PACKAGE.rglob("*.py") if path.name != "__init__.py"]
    lengths = {p.relative_to(PACKAGE): len(p.read_text().splitlines()) for p in files}
    assert not {str(path): lines for path, lines in lengths.items() if lines > 400}
    names = [path.name for path in files if path.parent.name != "cli"]  # named by their commands
    assert len(names) == len(set(names)), sorted(n for n in names if names.count(n) > 1)
