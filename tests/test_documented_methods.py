# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What all other pages tell one to type works as written; see `documented_runs.py`."""

from pathlib import Path

import pytest
from documented import pages_of
from documented_runs import check_page
from documented_stock import Stock
from groups import slow_but

LONG = {
    *("docs/algorithms.md", "docs/loop_closure.md", "docs/engine.md"),
    *("docs/comparison.md", "docs/configuration.md", "docs/frontend.md", "docs/maps.md"),
    *("docs/moving_objects.md", "docs/results.md", "docs/visualization.md", "docs/without_imu.md"),
}
"""Pages that take more than three seconds; `make slow` does them."""
PAGES = pages_of("methods")


@pytest.mark.parametrize("page", slow_but(set(PAGES) - LONG, PAGES))
def test_every_step_works(
    page: str, stock: Stock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_page(page, stock, tmp_path, monkeypatch)
