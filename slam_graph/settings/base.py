# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The base class of all settings: typed, frozen, and closed to unknown keys.

There are two tiers. A plain `Field` is a setting that a user can sensibly choose; its docstring
says when to change it and what then happens. `expert` marks the others: they are for development,
are listed on a page of their own, and may be removed. A value that nobody has a reason to change is
not a setting but a constant beside its use.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator, Mapping
from functools import cache, partial
from inspect import cleandoc, getsource
from itertools import pairwise
from sys import modules
from typing import Any, ClassVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler, field_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from slam_graph.display import Displayed

expert = partial(Field, json_schema_extra={"expert": True})
"""A pydantic field of the second tier; it works like any other."""

_UNIT = 1e-2
"""A quaternion's length differs from one by less."""


class Settings(Displayed, BaseModel):
    """Base of all settings.

    Attributes:
        moved: for each key that this table no longer has, the end of a sentence that begins with
            the key and says what to do instead, such as "is now frontend.max_features".
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    moved: ClassVar[Mapping[str, str]] = {}

    @field_validator("quaternion", check_fields=False)
    @classmethod
    def _is_a_rotation(
        cls, value: tuple[float, float, float, float]
    ) -> tuple[float, float, float, float]:
        """A rotation, x y z w, wherever a table has one."""
        length = math.hypot(*value)
        if not abs(length - 1.0) < _UNIT:
            raise ValueError(f"a rotation as x y z w has length 1; this one has {length:g}")
        return value

    @classmethod
    def meanings(cls) -> dict[str, str]:
        """What each setting means: the docstring below its field.

        They are read from the source when they are asked for. Pydantic can do so, too, but whenever
        a table is defined, which takes longer than all else that defines it.
        """
        tables = (table for table in reversed(cls.__mro__) if issubclass(table, Settings))
        return {name: text for table in tables for name, text in _docstrings(table).items()}

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        found = handler(schema)
        properties, meanings = handler.resolve_ref_schema(found)["properties"], cls.meanings()
        for name in properties.keys() & meanings.keys():
            properties[name].setdefault("description", meanings[name])
        return found

    def __repr__(self) -> str:
        changed = ", ".join(f"{name}={value}" for name, value in self._changed().items())
        return f"{type(self).__name__}({changed or 'defaults'})"

    __str__ = __repr__

    def _facts(self) -> dict[str, object]:
        changed = self._changed()
        return changed or {"": "all settings have their defaults"}

    def _changed(self) -> dict[str, object]:
        """The settings that differ from their defaults, by their dotted names.

        Of a table with a name, such as an algorithm, the name is there in any case.
        """
        found: dict[str, object] = {}
        for name, info in type(self).model_fields.items():
            value = getattr(self, name)
            default = info.get_default(call_default_factory=True, validated_data={})
            if isinstance(value, Settings) and type(value) is type(default):
                found |= value._unlike(default, name)
            elif value != default:
                found[name] = value
        return found

    def _unlike(self, other: Settings, prefix: str) -> dict[str, object]:
        """Where these settings differ from others of the same type; see `_changed`."""
        known = getattr(self, "name", None)
        found: dict[str, object] = {} if known is None else {prefix: known}
        if known is not None and known != getattr(other, "name", None):
            return found
        for name in type(self).model_fields:
            mine, theirs = getattr(self, name), getattr(other, name)
            if isinstance(mine, Settings) and type(mine) is type(theirs):
                found |= mine._unlike(theirs, f"{prefix}.{name}")
            elif mine != theirs:
                found[f"{prefix}.{name}"] = mine
        return found

    def as_yaml(self) -> str:
        """YAML that gives the same settings when it is read, each with its meaning as a comment."""
        return "\n".join(_yaml_lines(self, self.model_dump(mode="json"), "")) + "\n"


def _docstrings(table: type[Settings]) -> dict[str, str]:
    """The docstrings below the fields of a table, without those of its bases."""
    body = _classes(table.__module__).get(table.__name__, [])
    return {
        field.target.id: cleandoc(text.value.value)
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }


@cache
def _classes(module: str) -> dict[str, list[ast.stmt]]:
    """The statements of each class of a module; none if its source is not there."""
    try:
        tree = ast.parse(getsource(modules[module]))
    except (KeyError, OSError, TypeError):
        return {}
    return {node.name: node.body for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


def _yaml_lines(config: BaseModel, plain: dict[str, Any], indent: str) -> Iterator[str]:
    """The lines of those settings of a table that are in its dump `plain`."""
    meanings = type(config).meanings() if isinstance(config, Settings) else {}
    for name, info in type(config).model_fields.items():
        if name not in plain:
            continue
        meaning = info.description or meanings.get(name)
        if meaning:
            yield f"{indent}# {' '.join(meaning.split())}"
        value = getattr(config, name)
        if isinstance(value, BaseModel):
            yield f"{indent}{name}:"
            yield from _yaml_lines(value, plain[name], indent + "  ")
        else:
            text = yaml.safe_dump(plain[name], default_flow_style=True, width=10_000)
            yield f"{indent}{name}: {text.removesuffix('...' + chr(10)).strip()}"
