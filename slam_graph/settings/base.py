# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The base class of all settings: typed, frozen, and closed to unknown keys.

There are two tiers. A plain `Field` is a setting that a user can sensibly choose; its docstring
says when to change it and what then happens. `expert` marks the others: they are for development,
are listed on a page of their own, and may be removed. A value that nobody has a reason to change is
not a setting but a constant beside its use.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, ClassVar

import yaml
from pydantic import BaseModel, ConfigDict, Field

expert = partial(Field, json_schema_extra={"expert": True})
"""A pydantic field of the second tier; it works like any other."""


class Settings(BaseModel):
    """Base of all settings.

    Attributes:
        moved: for each key that this table no longer has, the end of a sentence that begins with
            the key and says what to do instead, such as "is now frontend.max_features".
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    moved: ClassVar[Mapping[str, str]] = {}

    def as_yaml(self) -> str:
        """YAML that gives the same settings when it is read, each with its meaning as a comment."""
        return "\n".join(_yaml_lines(self, self.model_dump(mode="json"), "")) + "\n"


def _yaml_lines(config: BaseModel, plain: dict[str, Any], indent: str) -> Iterator[str]:
    """The lines of those settings of a table that are in its dump `plain`."""
    for name, info in type(config).model_fields.items():
        if name not in plain:
            continue
        if info.description:
            yield f"{indent}# {' '.join(info.description.split())}"
        value = getattr(config, name)
        if isinstance(value, BaseModel):
            yield f"{indent}{name}:"
            yield from _yaml_lines(value, plain[name], indent + "  ")
        else:
            text = yaml.safe_dump(plain[name], default_flow_style=True, width=10_000)
            yield f"{indent}{name}: {text.removesuffix('...' + chr(10)).strip()}"
