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
from groups import slow_but

STEPS = inline_steps()
LONG = ("slam-graph run", "slam-graph frontend")
BRIEF = [s for s in STEPS if not s.text.startswith(LONG) or s.text == "slam-graph run DATA"]
"""Those that `make test` runs: a run is much alike with other options."""


@pytest.mark.parametrize("step", slow_but(BRIEF, STEPS), ids=[step.text for step in STEPS])
def test_it_works(
    step: Step, stock: Stock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_steps([in_place(step)], stock, tmp_path, monkeypatch)


def test_every_word_that_stands_for_something_is_used() -> None:
    assert len(STEPS) > 20
    assert set(STANDS_FOR) <= {word for step in STEPS for word in step.text.split()}
