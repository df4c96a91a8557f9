# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Each package exports few names, imports only what others export, and imports it late."""

import ast
import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from sources import imports_of, tree

import slam_graph

PACKAGE = Path(slam_graph.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))
PARTS = ["slam_graph"] + [
    f"slam_graph.{path.parent.name if path.name == '__init__.py' else path.stem}"
    for path in sorted([*PACKAGE.glob("*.py"), *PACKAGE.glob("*/__init__.py")])
    if path.parent != PACKAGE or path.name != "__init__.py"
]
"""The package, its packages, and the modules beside them."""

KERNELS = {
    path: f"slam_graph.kernels.{path.stem}" for path in sorted((PACKAGE / "kernels").glob("*.py"))
}
"""Imported one by one, so that what needs none does not import Numba."""

LAZY = [
    part
    for part in PARTS
    if "lazy_exports(" in Path(str(importlib.import_module(part).__file__)).read_text("utf-8")
    and part != "slam_graph.lazy"
]

MOST_PUBLIC_NAMES = 160

FOR_EXTENSIONS = {
    *("CAMERA_MODELS", "DATASETS", "DESCRIPTORS", "DETECTORS", "FEATURE_POLICIES", "FRONTENDS"),
    *("POSE_SELECTIONS", "CameraModel", "Descriptor", "Detector", "FeaturePolicy", "Format"),
    *("PoseSelection", "RigProjection"),
}
"""Names that parts written outside this package need (CONTRIBUTING.md, "Adding a part")."""


def public_names(part: str) -> list[str]:
    return list(getattr(importlib.import_module(part), "__all__", []))


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports_between_parts() -> Iterator[tuple[str, str, str]]:
    """Place, module and name of each import from another part of the package."""
    for path in SOURCES:
        for node in imports_of(path):
            if isinstance(node, ast.Import):
                found = [(alias.name, "") for alias in node.names]
            else:
                found = [(node.module or "", alias.name) for alias in node.names]
                if node.module == "slam_graph":
                    found = list(names_of_parts(path, {alias.name for alias in node.names}))
            for module, name in found:
                root, _, inner = module.partition(".")
                if root == "slam_graph" and inner.split(".")[0] != part_of(path):
                    yield f"{path.relative_to(PACKAGE)}:{node.lineno}", module, name


def names_of_parts(path: Path, parts: set[str]) -> Iterator[tuple[str, str]]:
    """Module and name of what a module uses of parts that it imports whole: `evaluation.ape`."""
    for node in ast.walk(tree(path)):
        match node:
            case ast.Attribute(value=ast.Name(id=part), attr=name) if part in parts:
                yield f"slam_graph.{part}", name


def test_parts_import_only_public_names_of_each_other() -> None:
    public = {part: set(public_names(part)) for part in [*PARTS, *KERNELS.values()]}
    wrong = [
        f"{place}: {name} of {module}"
        for place, module, name in imports_between_parts()
        if name not in public.get(module, set())
    ]
    assert not wrong


def test_only_parts_have_lists_of_public_names() -> None:
    """The modules in a package have none: the package says what is public."""
    tops = {*PACKAGE.glob("*.py"), *PACKAGE.glob("*/__init__.py"), *KERNELS}
    listing = [
        str(path.relative_to(PACKAGE))
        for path in SOURCES
        if path not in tops
        for node in tree(path).body
        if isinstance(node, ast.Assign) and "__all__" in ast.unparse(node.targets[0])
    ]
    assert not listing


def test_public_names_are_used() -> None:
    used = {(module, name) for _, module, name in imports_between_parts()}
    unused = [
        f"{part}: {name}"
        for part in PARTS[1:]
        for name in public_names(part)
        if (part, name) not in used and name not in FOR_EXTENSIONS
    ]
    assert not unused


def test_public_names_are_few() -> None:
    names = [f"{part}.{name}" for part in PARTS[1:] for name in public_names(part)]
    assert len(names) <= MOST_PUBLIC_NAMES, len(names)


@pytest.mark.parametrize("part", LAZY)
def test_late_imports_are_what_type_checkers_see(part: str) -> None:
    module = importlib.import_module(part)
    (block,) = (node for node in tree(Path(str(module.__file__))).body if isinstance(node, ast.If))
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    seen = {
        (node.module, alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    (call,) = (node for node in ast.walk(block) if isinstance(node, ast.Call))
    table = ast.literal_eval(call.args[1])
    late = {(f"{part}.{home}", name) for home, names in table.items() for name in names}
    assert late == seen
    names = sorted(name for _, name in seen)
    assert len(names) == len(set(names))
    assert set(names) == set(module.__all__) - {"__version__"}
    assert dir(module) == sorted(module.__all__)
    assert all(hasattr(module, name) for name in names)
    submodules = {path.stem for path in Path(str(module.__file__)).parent.iterdir()}
    assert not submodules & set(names), "the import of the module would hide the name"
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        module.no_such_name  # noqa: B018
