# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The wheel that users install: what is in it, and that it works away from the sources."""

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from limits import HANG_S

ROOT = Path(__file__).parent.parent
OFFLINE = ("--no-deps", "--no-index", "--disable-pip-version-check", "--quiet")


def run(*command: str | Path, cwd: Path, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=cwd,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    options = (*OFFLINE, "--no-build-isolation", "--wheel-dir", folder)
    run("-m", "pip", "wheel", *options, ROOT, cwd=folder)
    (built,) = folder.glob("slam_graph-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """A folder with nothing but the wheel."""
    target = wheel.parent / "site"
    run("-m", "pip", "install", *OFFLINE, "--target", target, wheel, cwd=wheel.parent)
    return target


def files_below(folder: Path, pattern: str) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob(pattern)}


def test_wheel_holds_package_configurations_and_licence(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    sources = {f"slam_graph/{name}" for name in files_below(ROOT / "slam_graph", "*.py")}
    configs = {f"slam_graph/configs/{name}" for name in files_below(ROOT / "configs", "*.yaml")}
    assert sources | configs | {"slam_graph/py.typed"} <= names
    assert any(name.endswith("/licenses/LICENSE") for name in names)


def test_wheel_holds_nothing_else(wheel: Path) -> None:
    parts = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert "slam_graph" in parts
    assert all(re.fullmatch(r"slam_graph(-.*\.dist-info)?", part) for part in parts)


def test_installed_package_finds_its_configurations(installed: Path, tmp_path: Path) -> None:
    script = (
        "from slam_graph.config import algorithm_names, config_folder; "
        "print(config_folder(), *algorithm_names(), sep='\\n')"
    )
    folder, *names = run("-c", script, cwd=tmp_path, PYTHONPATH=str(installed)).splitlines()
    assert Path(folder) == installed / "slam_graph" / "configs"
    assert names == sorted(path.stem for path in (ROOT / "configs" / "algorithms").glob("*.yaml"))


def test_installed_command_runs(installed: Path, tmp_path: Path) -> None:
    command = installed / "bin" / "slam-graph"
    environment = {"PYTHONPATH": str(installed)}
    assert run(command, "--version", cwd=tmp_path, **environment).startswith("slam-graph ")
    dumped = run(command, "config", "dump", "--algorithm", "swf", cwd=tmp_path, **environment)
    assert "name: swf" in dumped
