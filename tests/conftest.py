# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests: where the recordings are; kernels that are compiled."""

import gc
import logging
import os
from collections.abc import Iterator
from contextlib import nullcontext
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING

import damage
import gtsam
import pytest
import typer.main
import typer.testing
import unrendered
from groups import slow

import slam_graph.kernels

if TYPE_CHECKING:
    from documented_stock import Stock


def pytest_configure() -> None:
    """The command line is put together once, instead of by each command that a test gives.

    Pictures are not rendered, but where `rendered` is used.
    """
    typer.main.get_command = typer.testing._get_command = cache(typer.main.get_command)
    unrendered.render_nothing()


def pytest_sessionstart(session: pytest.Session) -> None:
    """All kernels in the cache: no command says that it compiles them, no two workers do it."""
    if not hasattr(session.config, "workerinput"):  # before there are workers
        for module in iter_modules(slam_graph.kernels.__path__):
            import_module(f"slam_graph.kernels.{module.name}")


LONGEST = (
    "diagnosis", "verdict", "recovery", "experiment", "damaged_files", "batch", "notebooks",
    "disk", "take_off", "clock_monitor", "map_runs", "one_camera", "cli_run", "repeats",
    "estimator_end_to_end", "final_ba", "position_fixes", "estimator_first_estimates",
    "datasets_contract", "window_graph", "simulation_images", "estimator_bad_input", "signals",
    "initialization_clock", "imu_consistent_path", "rerun", "without_imu", "rolling_shutter",
    "calibration_convergence", "imu_noise_estimation", "gauge_steps", "objects", "public_api",
    "epipolar_alignment", "second_compiler", "frontend_robustness", "track_drift", "known_poses",
    "smoothed_covariances", "fault_injection",
)  # fmt: skip
"""Files of tests that take longest in the quick group, by their CPU time; they run first, so that
no core ends with one."""


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


@pytest.fixture(scope="module")
def rendered() -> Iterator[None]:
    """Pictures are what a user sees, from here to the end of the file of tests."""
    from slam_graph.visualization import style

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style.Picture, "_drawn", vars(style)["rendered"])
        yield


@pytest.fixture(params=[0, slow(1)], ids=["first_half", "second_half"])
def half(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are damaged in half of all ways, the other half is slow."""
    monkeypatch.setattr(damage, "half", request.param)


@pytest.fixture(params=["half", slow("full")])
def share(request: pytest.FixtureRequest) -> Iterator[None]:
    """Properties are tried with half of their examples, in the slow group with all of them."""
    from properties import all_examples

    with all_examples(request.function) if request.param == "full" else nullcontext():
        yield


@pytest.fixture
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """What is dropped and counted is not written down for each of many files."""
    caplog.set_level(logging.CRITICAL, logger="slam_graph")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all examples of a file of tests are written, one over the other."""
    return tmp_path_factory.mktemp("examples")
