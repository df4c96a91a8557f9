# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Registries of named parts, and installed packages that add to them."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import pytest

from slam_graph.errors import ConfigError
from slam_graph.plugins import Choice, Registry
from slam_graph.settings.base import Settings
from slam_graph.settings.tree import ConfigTree, validate

Shape = Callable[[float], float]
GROUP = "slam_graph.test_shapes"


def shapes() -> Registry[Shape]:
    registry: Registry[Shape] = Registry(GROUP, "shape")

    @registry.register("square")
    def square(side: float) -> float:
        return side * side

    return registry


def install(folder: Path, package: str, entry_points: str, source: str) -> None:
    """Put a package into a folder as pip would leave it there."""
    (folder / f"{package}.py").write_text(source)
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{entry_points}\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_a_decorator_registers_and_returns_what_it_decorates() -> None:
    registry = shapes()
    circle = registry.register("circle")(lambda radius: 3.14 * radius**2)
    assert registry["circle"] is circle
    assert list(registry) == ["square", "circle"]
    assert registry.get("cube") is None


def test_a_name_is_given_once() -> None:
    registry = shapes()
    registry.register("square")(registry["square"])  # a module that is imported twice
    with pytest.raises(ConfigError, match="shape 'square' is registered already"):
        registry.register("square")(abs)


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"^unknown shape 'sqare'; did you mean 'square'\?"):
        shapes()["sqare"]
    with pytest.raises(ConfigError, match=r"^unknown shape 'zzz'; known: square$"):
        shapes()["zzz"]


def test_an_installed_package_adds_to_a_registry_when_its_name_is_used(site: Path) -> None:
    install(site, "some_shapes", "cube = some_shapes:cube", "cube = lambda side: side**3")
    registry = shapes()
    assert list(registry) == ["square", "cube"]
    assert "cube" in registry
    assert "some_shapes" not in sys.modules
    assert registry["cube"](2.0) == 8.0


def test_a_broken_plugin_is_an_error_only_for_who_uses_it(site: Path) -> None:
    install(site, "bad_shapes", "cone = bad_shapes:cone", "import no_such_module")
    registry = shapes()
    assert registry["square"](2.0) == 4.0
    assert list(registry) == ["square", "cone"]
    assert [name for name, _ in registry.working()] == ["square"]
    reason = "shape 'cone' of bad_shapes 1.0: cannot load bad_shapes:cone: ModuleNotFoundError: "
    with pytest.raises(ConfigError, match=f"^{reason}.*'no_such_module'$"):
        registry["cone"]
    assert len(registry.faults()) == 1


def test_what_a_plugin_offers_must_be_of_the_right_kind(site: Path) -> None:
    install(site, "odd_shapes", "ring = odd_shapes:ring", "ring = 3")
    with pytest.raises(ConfigError, match=r"'ring' of odd_shapes 1\.0: expected a shape, got int"):
        shapes()["ring"]


def test_two_packages_may_not_offer_one_name(site: Path) -> None:
    install(site, "shapes_a", "ball = shapes_a:ball", "ball = abs")
    install(site, "shapes_b", "ball = shapes_b:ball", "ball = abs")
    with pytest.raises(ConfigError, match=r"offered by shapes_a 1\.0 and shapes_b 1\.0"):
        shapes()["ball"]


def test_a_setting_names_a_part(site: Path) -> None:
    install(site, "more_shapes", "disc = more_shapes:disc", "disc = abs")

    class Drawing(Settings):
        shape: Annotated[str, Choice(shapes(), others=("auto",))] = "auto"
        """What is drawn."""

    assert Drawing(shape="disc").shape == "disc"
    (names,) = [Drawing.model_json_schema()["properties"]["shape"]["enum"]]
    assert names == ["auto", "square", "disc"]
    tree = ConfigTree({"shape": "dics"}, {("shape",): "draw.yaml:3"})
    with pytest.raises(ConfigError, match=r"^draw.yaml:3: shape: unknown shape 'dics'; .*'disc'\?"):
        validate(Drawing, tree)
