# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Dependencies point downwards only, and printing and drawing stay where they belong."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import slam_graph

PACKAGE = Path(slam_graph.__file__).parent

LAYERS = (
    {"errors", "diagnostics", "version", "arrays"},
    {"plugins"},
    {"settings", "geometry"},
    {"sensors"},
    {"datasets", "frontend", "backend"},
    {"pose_graph", "bundle_adjustment", "smoothing", "simulation"},
    {"loop_closure"},
    {"maps"},
    {"evaluation", "visualization", "config"},
    {"results"},
    {"pipeline"},
    {"experiment"},
    {"cli"},
)
"""Each layer may import the layers before it; the parts of one layer do not know each other."""

APART = {"simulation": {"frontend", "backend"}}
"""Parts that do not know each other although they are not of one layer: a simulation must not
share the code that it is to test."""

RANKS = {part: rank for rank, layer in enumerate(LAYERS) for part in layer}

SOURCES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(path: Path) -> Iterator[tuple[int, str]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            yield node.lineno, node.module or ""


def name(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_imports_point_downwards(path: Path) -> None:
    own = part_of(path)
    assert own in RANKS, f"{own} has no layer: add it to LAYERS"
    for line, module in imports(path):
        if not module.startswith("slam_graph."):
            continue
        other = module.split(".")[1]
        allowed = other == own or RANKS[other] < RANKS[own]
        allowed = allowed and other not in APART.get(own, ())
        assert allowed, f"{path}:{line}: {own} must not import {module}"


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_only_the_visualization_draws(path: Path) -> None:
    if part_of(path) == "visualization":
        return
    for line, module in imports(path):
        root = module.split(".")[0]
        assert root not in {"rerun", "matplotlib"}, f"{path}:{line}: {module} outside visualization"


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_only_the_command_line_prints_or_exits(path: Path) -> None:
    if part_of(path) == "cli":
        return
    for line, module in imports(path):
        assert module.split(".")[0] != "typer", f"{path}:{line}: typer outside cli"
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Name):
            assert node.id not in {"print", "exit", "quit", "SystemExit"}, f"{path}:{node.lineno}"
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            called = f"{node.value.id}.{node.attr}"
            forbidden = {"sys.exit", "sys.stdout", "sys.stderr", "os._exit"}
            assert called not in forbidden, f"{path}:{node.lineno}: {called} outside cli"


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_evo_is_never_imported(path: Path) -> None:
    assert all(module.split(".")[0] != "evo" for _, module in imports(path))
