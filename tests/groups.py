# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of parametrised tests that `make slow` runs, and `make test` does not."""

from collections.abc import Iterable
from typing import Any

import pytest


def slow(*values: object) -> Any:
    """One case, given by its values, that is slow."""
    return pytest.param(*values, marks=pytest.mark.slow)


def slow_but(quick: Iterable[object], cases: Iterable[object]) -> list[Any]:
    """Cases of one value each, of which all but some are slow; fails if these are no cases."""
    brief, known = list(quick), list(cases)
    unknown = [case for case in brief if case not in known]
    assert brief, "no case is quick"
    assert not unknown, f"no cases: {unknown}"
    return [case if case in brief else slow(case) for case in known]
