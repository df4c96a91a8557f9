# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Every algorithm that the engine accepts with given choices for its policies."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from slam_graph.backend.policies import AlgorithmConfig

Options = Mapping[str, Mapping[str, Any]]
"""What one choice may be: settings of an algorithm by their path, by the name of the option."""


def values_of(path: str, values: Iterable[Any]) -> Options:
    """Options that set a single setting, as `cost.features`; they are named like their values."""
    return {str(value): {path: value} for value in values}


def combinations(*choices: Options) -> Iterator[AlgorithmConfig]:
    """The product of choices, without the combinations that are refused.

    Args:
        choices: the last one changes fastest; a name of an algorithm is that of its options.
    """
    for options in itertools.product(*(choice.items() for choice in choices)):
        table: dict[str, Any] = {"name": "-".join(name for name, _ in options)}
        for _, settings in options:
            for path, value in settings.items():
                section, key = path.split(".")
                table.setdefault(section, {})[key] = value
        try:
            yield AlgorithmConfig.model_validate(table)
        except ValidationError:
            continue
