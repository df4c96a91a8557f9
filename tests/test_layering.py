# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Dependencies point downwards only, and printing and drawing stay where they belong."""

import ast
from collections.abc import Iterator
from pathlib import Path

from sources import imports_of, tree

import slam_graph

PACKAGE = Path(slam_graph.__file__).parent

LAYERS = (
    {"errors", "diagnostics", "version", "arrays", "lazy", "interrupts"},
    {"files", "image_files", "kernels", "plugins", "display"},
    {"settings", "geometry"},
    {"sensors"},
    {"datasets", "frontend"},
    {"backend"},
    {"pose_graph", "bundle_adjustment", "simulation", "diagnosis"},
    {"loop_closure"},
    {"maps", "evaluation"},
    {"visualization", "config"},
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

PRINTS_OR_LEAVES = {
    *("print", "exit", "quit", "SystemExit"),
    *("sys.exit", "sys.stdout", "sys.stderr", "os._exit"),
}

SOURCES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Line and module of each import; a relative one begins with dots."""
    for node in imports_of(path):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        else:
            yield node.lineno, "." * node.level + (node.module or "")
            if node.module == "slam_graph":
                yield from ((node.lineno, f"slam_graph.{alias.name}") for alias in node.names)


def importers(*roots: str, home: str = "") -> list[str]:
    """Where a package is imported outside the part that may do so."""
    return [
        f"{path}:{line}: {module}"
        for path in SOURCES
        if part_of(path) != home
        for line, module in imports(path)
        if module.split(".")[0] in roots
    ]


def allowed(own: str, other: str) -> bool:
    if own == other:
        return True
    return RANKS[other] < RANKS[own] and other not in APART.get(own, ())


def printed_or_left(path: Path) -> Iterator[str]:
    """Where a module writes to the terminal or ends the process."""
    for node in ast.walk(tree(path)):
        name = ""
        if isinstance(node, ast.Name):
            name = node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            name = f"{node.value.id}.{node.attr}"
        if name in PRINTS_OR_LEAVES:
            yield f"{path}:{node.lineno}: {name}"


def test_every_part_has_a_layer() -> None:
    assert {part_of(path) for path in SOURCES} - RANKS.keys() == set(), "add them to LAYERS"


def test_imports_point_downwards() -> None:
    offenders = [
        f"{path}:{line}: {part_of(path)} must not import {module}"
        for path in SOURCES
        for line, module in imports(path)
        if module.startswith("slam_graph.") and not allowed(part_of(path), module.split(".")[1])
    ]
    assert not offenders


def test_causal_estimation_knows_nothing_of_the_recording_as_a_whole() -> None:
    """Within the back end, only `smoothing/` reads recordings, and the rest does not use it."""
    backend = PACKAGE / "backend"
    causal = [
        path
        for path in backend.rglob("*.py")
        if backend / "smoothing" not in path.parents and path != backend / "__init__.py"
    ]
    assert causal
    offenders = [
        f"{path}:{line}: {module}"
        for path in causal
        for line, module in imports(path)
        if module.startswith(("slam_graph.datasets", "slam_graph.backend.smoothing"))
    ]
    assert not offenders


def test_no_import_is_relative() -> None:
    assert not importers("")


def test_only_the_visualization_draws() -> None:
    assert not importers("rerun", "matplotlib", home="visualization")


def test_only_the_command_line_prints_or_exits() -> None:
    sources = [path for path in SOURCES if part_of(path) != "cli"]
    assert not [place for path in sources for place in printed_or_left(path)]
    assert not importers("typer", home="cli")


def test_evo_is_never_imported() -> None:
    """It is under the GPL; the tests ask it in a process of its own."""
    assert not importers("evo")
