# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the pages on recordings tell one to type works as written; see `documented_runs.py`."""

from pathlib import Path

import pytest
from documented import pages_of
from documented_runs import check_page
from documented_stock import Stock


@pytest.mark.slow
@pytest.mark.parametrize("page", pages_of("recordings"))
def test_every_step_works(
    page: str, stock: Stock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_page(page, stock, tmp_path, monkeypatch)
