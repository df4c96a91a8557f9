# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What `slam-graph optimize` does for every kind of problem: settings, timing, files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol, TypeVar

from pydantic import BaseModel

from slam_graph.cli.logs import remove_if_empty

_Policy = TypeVar("_Policy", bound=BaseModel)


class _Result(Protocol):
    """The result of an optimisation."""

    def save(self, folder: Path) -> list[Path]:
        """Write all files into a folder."""
        ...


def read_policy(
    kind: type[_Policy],
    file: Path | None,
    overrides: list[str],
    options: Mapping[tuple[str, str], Any],
) -> _Policy:
    """The settings: the file, then options, then overrides.

    Args:
        kind: of policy.
        file: YAML, if there is one.
        overrides: `key=value` each.
        options: values by table and name; None changes nothing.
    """
    from slam_graph.settings import ConfigTree, override, read_tree, validate

    tree = ConfigTree() if file is None else read_tree(file)
    for (table, name), value in options.items():
        if value is not None:
            where = f"option {name}"
            places: dict[tuple[str | int, ...], str] = {(table,): where, (table, name): where}
            tree.merge(ConfigTree({table: {name: value}}, places))
    for text in overrides:
        tree.merge(override(text))
    return validate(kind, tree)


def write_result(
    result: _Result, name: str, output: Path, log: list[str]
) -> tuple[Path, list[Path]]:
    """Write all files into a new folder, named after the problem."""
    from slam_graph.results import create_run_folder, link_latest, write_text

    folder = create_run_folder(output, name)
    try:
        files = [*result.save(folder), folder / "run.log"]
        write_text(files[-1], log)
        link_latest(folder)
    except BaseException:
        remove_if_empty(folder)
        raise
    return folder, files


@contextmanager
def timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    """Note how long a block takes."""
    start = perf_counter()
    yield
    seconds[part] = perf_counter() - start
