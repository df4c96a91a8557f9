# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Keys that settings once had: none is a key now, and what replaces them is where it is said."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

import slam_graph
from slam_graph.bundle_adjustment.bal_policy import BalPolicy
from slam_graph.config import RunConfig
from slam_graph.pose_graph.pose_graph_policy import PoseGraphPolicy
from slam_graph.settings.base import Settings

PACKAGE = Path(slam_graph.__file__).parent


def tables(model: type[BaseModel]) -> Iterator[type[Settings]]:
    """A table of settings and all tables in it."""
    if issubclass(model, Settings):
        yield model
    for info in model.model_fields.values():
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            yield from tables(info.annotation)


TABLES = dict.fromkeys(
    table for policy in (RunConfig, PoseGraphPolicy, BalPolicy) for table in tables(policy)
)


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.__name__)
def test_old_keys_name_what_replaces_them(table: type[Settings]) -> None:
    assert not table.moved.keys() & table.model_fields.keys()
    for key, text in table.moved.items():
        found = re.fullmatch(r"is a constant now: (\w+) in (\S+\.py)", text)
        if found:
            name, path = found.groups()
            source = (PACKAGE / path).read_text(encoding="utf-8")
            assert re.search(rf"^{name}\b.*=", source, re.MULTILINE), f"{key}: {text}"
