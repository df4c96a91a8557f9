# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Commands within sentences and tables of the pages work, on data in place of words in capitals.

See `documented_runs.py`. Commands that are named only, as in "results of `slam-graph run`", have
nothing to work on; `test_documented_commands.py` sees that these names exist.
"""

from pathlib import Path

import pytest
from documented import Step, inline_steps
from documented_runs import STANDS_FOR, check_steps, in_place
from documented_stock import Stock

STEPS = inline_steps()


@pytest.mark.slow
@pytest.mark.parametrize("step", STEPS, ids=[step.text for step in STEPS])
def test_it_works(
    step: Step, stock: Stock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_steps([in_place(step)], stock, tmp_path, monkeypatch)


def test_every_word_that_stands_for_something_is_used() -> None:
    assert len(STEPS) > 20
    assert set(STANDS_FOR) <= {word for step in STEPS for word in step.text.split()}
