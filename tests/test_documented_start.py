# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What README, the first pages and the help tell one to type works as written.

See `documented_runs.py`.
"""

from pathlib import Path

import pytest
from documented import pages_of
from documented_runs import check_page
from documented_stock import Stock
from groups import slow_but


@pytest.mark.parametrize(
    "page", slow_but({"docs/quickstart.md", "docs/index.md", "docs/api.md"}, pages_of("start"))
)
def test_every_step_works(
    page: str, stock: Stock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_page(page, stock, tmp_path, monkeypatch)
