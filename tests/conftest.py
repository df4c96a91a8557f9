# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests: where the recordings are; kernels that are compiled."""

import gc
import logging
import os
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING

import gtsam
import pytest
import typer.main
import typer.testing

import slam_graph.kernels

if TYPE_CHECKING:
    from documented_stock import Stock


def pytest_configure() -> None:
    """The command line is put together once, instead of by each command that a test gives."""
    typer.main.get_command = typer.testing._get_command = cache(typer.main.get_command)


def pytest_sessionstart(session: pytest.Session) -> None:
    """All kernels in the cache: no command says that it compiles them, no two workers do it."""
    if not hasattr(session.config, "workerinput"):  # before there are workers
        for module in iter_modules(slam_graph.kernels.__path__):
            import_module(f"slam_graph.kernels.{module.name}")


LONGEST = (
    "damaged_files", "experiment", "verdict", "recovery", "batch", "diagnosis", "map_runs",
    "notebooks", "estimator_end_to_end", "position_fixes", "clock_monitor", "signals", "rerun",
    "take_off", "repeats", "final_ba", "one_camera", "rolling_shutter", "damaged_results",
)  # fmt: skip
"""Files of tests that take longest in the quick group; they run first, so that no core ends with
one."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first; otherwise the order stays. Xdist deals out files in this order."""
    first = {f"test_{name}.py": place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: first.get(item.path.name, len(first)))


def pytest_collection_finish() -> None:
    """No search for cycles among what was imported and collected: it stays to the end."""
    gc.freeze()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recordings; without it the test is skipped, or fails if data is required."""
    folder = os.environ.get("SLAM_GRAPH_DATA")
    if folder and Path(folder).is_dir():
        return Path(folder).resolve()
    message = f"recordings not found: SLAM_GRAPH_DATA={folder!r} is not a folder"
    if os.environ.get("SLAM_GRAPH_REQUIRE_DATA") == "1":
        pytest.fail(message)
    pytest.skip(message)


@pytest.fixture(scope="session")
def gtsam_data() -> Path:
    """The data folder of the GTSAM wheel, always there."""
    return Path(gtsam.__file__).parent / "Data"


@pytest.fixture(scope="session")
def stock(tmp_path_factory: pytest.TempPathFactory) -> "Stock":
    """Short recordings under the names that the documents use."""
    from documented_stock import Stock

    folder = os.environ.get("SLAM_GRAPH_DATA")
    real = Path(folder).resolve() if folder and Path(folder).is_dir() else None
    return Stock(tmp_path_factory.mktemp("stock"), real)


@pytest.fixture
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """What is dropped and counted is not written down for each of many files."""
    caplog.set_level(logging.CRITICAL, logger="slam_graph")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all examples of a file of tests are written, one over the other."""
    return tmp_path_factory.mktemp("examples")
