# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged files and properties: quick tests try half of the cases, slow ones all."""

from collections import Counter
from pathlib import Path

import damage
import pytest
from groups import slow
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

pytestmark = pytest.mark.skipif(bool(damage.CAMPAIGN), reason="a campaign has its own numbers")


TRIED: Counter[str] = Counter()


@examples(40)
@given(number=st.integers())
def test_a_property(request: pytest.FixtureRequest, number: int) -> None:
    assert isinstance(number, int)
    TRIED[request.node.callspec.id] += 1


@pytest.mark.parametrize(("share", "count"), [("half", 20), slow("full", 40)])
def test_the_slow_group_tries_all_examples(share: str, count: int) -> None:
    """Of the property above."""
    assert TRIED[share] == count


def test_both_halves_are_all_ways_in_which_a_file_is_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, seen = tmp_path / "file.txt", []
    file.write_text("1 2 3\n4 5 6\n" * 20)
    edits = damage.edits
    monkeypatch.setattr(damage, "edits", lambda number: seen.append(number) or edits(number))
    for half in (0, 1):
        monkeypatch.setattr(damage, "half", half)
        damage.tried(file, file.read_bytes)
    assert seen == list(range(200))
