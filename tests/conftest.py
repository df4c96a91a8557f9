# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests: where the recordings are."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

import gtsam
import pytest

if TYPE_CHECKING:
    from documented_stock import Stock


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
