# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Registries of named parts, and installed packages that add to them."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Annotated

import numpy as np
import pytest
from images import CAMERA, painted, shift, view

from slam_graph.errors import ConfigError
from slam_graph.plugins import Choice, Registry
from slam_graph.settings.base import Settings
from slam_graph.settings.tree import ConfigTree

Shape = Callable[[float], float]
GROUP = "slam_graph.test_shapes"
TIMEOUT_S = 600


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
        tree.validated(Drawing)


def test_the_names_that_are_known_without_an_import_are_those_registered() -> None:
    code = (
        "import sys\n"
        "from slam_graph.frontend.frontend_config import DESCRIPTORS, DETECTORS, FRONTENDS\n"
        "for registry in (DETECTORS, DESCRIPTORS, FRONTENDS):\n"
        "    before = list(registry)\n"
        "    assert 'cv2' not in sys.modules or registry is not DETECTORS\n"
        "    assert [registry[name] for name in before]\n"
        "    assert list(registry) == before, registry.kind\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=TIMEOUT_S
    )
    assert done.returncode == 0, done.stderr


def test_threads_that_need_a_part_at_once_all_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second one waits while the first one imports the home."""
    (tmp_path / "slow_shapes.py").write_text(
        "import time\nfrom registry_of_shapes import REGISTRY\ntime.sleep(0.2)\n"
        "@REGISTRY.register('disc')\ndef disc(side): return side\n"
    )
    registry: Registry[Shape] = Registry(GROUP, "shape", "slow_shapes", ("disc",))
    module = ModuleType("registry_of_shapes")
    monkeypatch.setattr(module, "REGISTRY", registry, raising=False)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.syspath_prepend(tmp_path)
    with ThreadPoolExecutor(4) as pool:
        parts = list(pool.map(registry.__getitem__, ["disc"] * 4))
    assert len(set(parts)) == 1


def test_an_import_that_failed_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "failing_shapes.py"
    home.write_text("raise OSError('too many open files')\n")
    registry: Registry[Shape] = Registry(GROUP, "shape", "failing_shapes", ("disc",))
    module = ModuleType("registry_of_failing_shapes")
    monkeypatch.setattr(module, "REGISTRY", registry, raising=False)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(OSError, match="too many open files"):
        registry["disc"]
    home.write_text(
        "from registry_of_failing_shapes import REGISTRY\n"
        "@REGISTRY.register('disc')\ndef disc(side): return side\n"
    )
    assert registry["disc"](2.0) == 2.0


# --- a package that is installed ------------------------------------------------------------------

EXAMPLE = Path(__file__).parent / "plugin_example"
ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment variables with which Python finds the example, installed into a fresh folder."""
    pytest.importorskip("hatchling")
    target = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    command += ["--disable-pip-version-check", "--no-build-isolation", "--target", str(target)]
    subprocess.run([*command, str(EXAMPLE)], check=True, timeout=TIMEOUT_S)
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(target), str(ROOT)])}


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in the format of the example: a texture that moves before a camera at rest."""
    texture, stamps = painted(), np.arange(0, 300_000_000, 5_000_000)
    path = tmp_path_factory.mktemp("flight") / "flight.npz"
    np.savez(
        path,
        images=np.array([view(texture, shift(2.0 * k, 1.0 * k)) for k in range(6)]),
        image_stamps_ns=np.arange(6) * 50_000_000,
        imu_stamps_ns=stamps,
        gyro=np.zeros((len(stamps), 3)),
        accel=np.tile([0.0, 0.0, 9.81], (len(stamps), 1)),
        intrinsics=np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]),
        body_T_camera=np.eye(4),
    )
    return path


def slam_graph(
    environment: dict[str, str], folder: Path, *arguments: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "slam_graph.cli.main", *arguments],
        env=environment,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )


def test_a_plugin_is_used_from_yaml_and_command_line(
    environment: dict[str, str], flight: Path, tmp_path: Path
) -> None:
    """Its data set, found by its content, its descriptor and its detector."""
    (tmp_path / "own.yaml").write_text("frontend:\n  method: patch\n  min_distance_px: 8\n")
    options = ("--config", "own.yaml", "--set", "frontend.detector=laplacian", "--json")
    done = slam_graph(environment, tmp_path, "frontend", str(flight), *options)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["tracks"]["frames"] == 6
    assert report["tracks"]["features"] > 30
    assert "lost_match" in report["counts"]  # patches are matched, not tracked


def test_a_plugin_brings_a_format_and_a_front_end(
    environment: dict[str, str], flight: Path, tmp_path: Path
) -> None:
    options = ("--format", "npz", "--set", "frontend.method=every_other", "--record", "tracks")
    done = slam_graph(environment, tmp_path, "frontend", str(flight), *options)
    assert done.returncode == 0, done.stderr
    rows = np.fromfile(tmp_path / "tracks" / "features.bin", [("id", "<i8"), ("rest", "<f8", (4,))])
    assert len(rows) > 100
    assert np.all(rows["id"] % 2 == 0)


@pytest.mark.slow
def test_a_plugin_brings_a_pose_selection(environment: dict[str, str], tmp_path: Path) -> None:
    options = ("--duration", "12", "--set", "algorithm.cost.past_poses=second_newest_leaves")
    done = slam_graph(environment, tmp_path, "run", "demo", "--output", "out", *options)
    assert done.returncode == 0, done.stderr
    (used,) = tmp_path.glob("out/*/latest/config.yaml")
    assert "past_poses: second_newest_leaves" in used.read_text()


def test_a_plugin_that_cannot_be_loaded_is_named_where_it_is_used(
    environment: dict[str, str], flight: Path, tmp_path: Path
) -> None:
    """Everything else goes on, as the other tests show."""
    used = ("frontend", str(flight), "--set", "frontend.detector=unfinished")
    done = slam_graph(environment, tmp_path, *used)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "detector 'unfinished' of slam-graph-example 0.1: cannot load" in line
    assert "No module named 'a_library_that_nobody_has'" in line


def test_the_schema_lists_the_parts_of_plugins(environment: dict[str, str], tmp_path: Path) -> None:
    done = slam_graph(environment, tmp_path, "config", "schema")
    settings = json.loads(done.stdout)["$defs"]["FrontendConfig"]["properties"]
    assert {"auto", "shi_tomasi", "laplacian"} <= set(settings["detector"]["enum"])
    assert {"klt", "orb", "patch", "every_other"} <= set(settings["method"]["enum"])
