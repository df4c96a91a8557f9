# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Configuration trees: nested settings from YAML files and overrides, with where each was set.

So a fault that is found later, when the tree is checked against the schema, names file and line.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError

from slam_graph.errors import ConfigError, SlamGraphError, closest
from slam_graph.settings.base import Settings
from slam_graph.settings.bounded_yaml import YamlTextError, parse_node, parse_value

KeyPath = tuple[str | int, ...]
_ModelT = TypeVar("_ModelT", bound=BaseModel)

_MAX_KEYS = 32
"""Most keys of an override: tables are nested five deep, and merging them is recursive."""
_MAX_SHOWN = 200
"""Most characters of a wrong value in a message."""


@dataclass
class ConfigTree:
    """Nested settings, and where each was set.

    Attributes:
        values: nested dictionaries as YAML gives them.
        where: for each path of keys the file and line (or the option) that set it.
    """

    values: dict[str, Any] = field(default_factory=dict)
    where: dict[KeyPath, str] = field(default_factory=dict)

    @staticmethod
    def read(path: Path) -> ConfigTree:
        """Read a YAML file whose top level is a table.

        Raises:
            ConfigError: if it is missing, not YAML, not a table, or has a key twice.
        """
        try:
            values, node = parse_value(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"{path}: cannot read configuration: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise ConfigError(f"{path}: configuration is not UTF-8 text") from error
        except YamlTextError as error:
            raise ConfigError(f"{error.where(path)}: not YAML: {error.reason}") from error
        values = {} if node is None else values
        if not isinstance(values, dict):
            raise ConfigError(
                f"{path}:1: expected a table of settings, got {type(values).__name__}"
            )
        where: dict[KeyPath, str] = {(): str(path)}
        if node is not None:
            _record_lines(node, path, (), where)
        return ConfigTree(values, where)

    @staticmethod
    def nodes(text: str, path: str | Path, error: type[SlamGraphError]) -> yaml.Node | None:
        """The nodes of the text of any YAML file, which know their lines; None without a value.

        Args:
            text: its content.
            path: of the file, for messages.
            error: what to raise if it is not YAML, or nested or repeated beyond all bounds.
        """
        try:
            return parse_node(text)
        except YamlTextError as fault:
            raise error(f"{fault.where(path)}: not valid YAML ({fault.reason})") from None

    @staticmethod
    def value(text: str) -> Any:
        """The value of an untrusted YAML text: bounded, and without tags.

        Raises:
            YamlTextError: if it is not YAML, or nested or repeated beyond all bounds.
        """
        return parse_value(text)[0]

    @staticmethod
    def override(text: str) -> ConfigTree:
        """The tree of one `a.b=value`; the value is read as YAML, which gives it its type.

        Raises:
            ConfigError: if there is no `=`, a key is empty, or the value is not YAML.
        """
        name, separator, value_text = text.partition("=")
        keys = name.strip().split(".")
        where = f"--set {text}"
        if not separator or not all(keys) or len(keys) > _MAX_KEYS:
            raise ConfigError(f"{where}: expected key=value, e.g. backend.noise.pixel_sigma=1.5")
        try:
            value, _ = parse_value(value_text)
        except YamlTextError as error:
            raise ConfigError(f"{where}: the value is not YAML; put it in quotes") from error
        return _branch(keys, value, where)

    @staticmethod
    def overrides(overrides: str | Iterable[str] | Mapping[str, Any]) -> list[ConfigTree]:
        """A tree for each override, in their order.

        Args:
            overrides: texts `a.b=value`, or a mapping from `a.b` to the value.

        Raises:
            ConfigError: if one is malformed.
        """
        if isinstance(overrides, str):
            return [ConfigTree.override(overrides)]
        if not isinstance(overrides, Mapping):
            return [ConfigTree.override(text) for text in overrides]
        trees = []
        for name, value in overrides.items():
            keys = name.split(".")
            if not all(keys):
                raise ConfigError(
                    f"override '{name}': expected a key, e.g. backend.noise.pixel_sigma"
                )
            trees.append(_branch(keys, value, f"override {name}"))
        return trees

    def merge(self, other: ConfigTree) -> None:
        """Lay another tree over this one: tables are merged, other values are replaced."""
        _merge(self.values, other.values)
        self.where.update(other.where)

    def locate(self, path: KeyPath) -> str:
        """Where the value at `path`, or the nearest table around it, was set."""
        for length in range(len(path), 0, -1):
            if path[:length] in self.where:
                return self.where[path[:length]]
        return self.where.get((), "configuration")

    def validated(self, model: type[_ModelT]) -> _ModelT:
        """The typed settings of this tree.

        Raises:
            ConfigError: naming the first fault, where it stands, and the closest known key if a key
                is unknown.
        """
        try:
            return model.model_validate(self.values)
        except ValidationError as error:
            faults = _relevant(model, error.errors(include_url=False))
            more = f" (and {len(faults) - 1} more faults)" if len(faults) > 1 else ""
            raise ConfigError(f"{_describe(model, self, faults[0])}{more}") from error


def _relevant(model: type[BaseModel], faults: Iterable[Any]) -> list[dict[str, Any]]:
    """The faults, each with its path in the file in place of that in the schema.

    Where a value may be of several types, the schema has faults for each. Those inside of the table
    that is there are more to the point than that it is of no other type.
    """
    found = []
    for fault in faults:
        path, wrong_type = _path_in_file(model, fault["loc"])
        found.append(({**fault, "loc": path}, wrong_type))
    return [fault for fault, wrong_type in found if not wrong_type] or [fault for fault, _ in found]


def _path_in_file(model: Any, location: KeyPath) -> tuple[KeyPath, bool]:
    """A path without the names of types by which the schema tells alternatives apart.

    Returns:
        The path, and whether the schema's ends with such a name.
    """
    path: list[str | int] = []
    named = False
    for part in location:
        alternatives = {getattr(kind, "__name__", ""): kind for kind in _alternatives(model)}
        named = len(alternatives) > 1 and part in alternatives
        if named:
            model = alternatives[str(part)]
        else:
            path.append(part)
            model = _inside(model, part)
    return tuple(path), named


def _alternatives(annotation: Any) -> list[Any]:
    """The types that a value may have, but for None."""
    if get_origin(annotation) is Annotated:
        return _alternatives(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return [kind for kind in get_args(annotation) if kind is not type(None)]
    return [annotation]


def _inside(annotation: Any, part: str | int) -> Any:
    """The type of a part of a table or list; None if it is not known."""
    for kind in _alternatives(annotation):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            if part in kind.model_fields:
                return kind.model_fields[str(part)].annotation
        elif get_args(kind):  # the items of a list, the values of a dictionary
            return get_args(kind)[-1]
    return None


def _describe(model: type[BaseModel], tree: ConfigTree, fault: Mapping[str, Any]) -> str:
    """One line about one fault that the schema found."""
    path: KeyPath = fault["loc"]
    where, dotted = tree.locate(path), ".".join(str(part) for part in path)
    if fault["type"] == "extra_forbidden":
        table, key = _table(model, path[:-1]), str(path[-1])
        if table is not None and key in table.moved:
            return f"{where}: '{dotted}' {table.moved[key]}"
        known = table.model_fields if table is not None else []
        return f"{where}: unknown key '{dotted}'; {closest(key, known)}"
    if fault["type"] == "missing":
        return f"{where}: key '{dotted}' is missing"
    if fault["type"] == "unused":
        return f"{where}: '{dotted}' {fault['msg']}"
    message = str(fault["msg"]).removeprefix("Value error, ")
    message = f"{message[:1].lower()}{message[1:]}"
    got = repr(fault["input"])
    got = got if len(got) <= _MAX_SHOWN else f"{got[:_MAX_SHOWN]}…"
    # A whole table says nothing; and what the message says already is not said again.
    if not isinstance(fault["input"], dict | BaseModel) and got not in message:
        message = f"{message}, got {got}"
    return f"{where}: {dotted}: {message}"


def _table(model: type[BaseModel], path: KeyPath) -> type[Settings] | None:
    """The type of the table at `path`; None where there is no table."""
    kind: Any = model
    for part in path:
        kind = _inside(kind, part)
    tables = [one for one in _alternatives(kind) if isinstance(one, type)]
    return next((table for table in tables if issubclass(table, Settings)), None)


def _branch(keys: list[str], value: Any, where: str) -> ConfigTree:
    """The tree in which nothing but the value at the path `keys` is set."""
    for key in reversed(keys):
        value = {key: value}
    paths: dict[KeyPath, str] = {tuple(keys[:n]): where for n in range(1, len(keys) + 1)}
    return ConfigTree(value, paths)


def _merge(base: dict[str, Any], top: Mapping[str, Any]) -> None:
    """Lay `top` over `base` in place."""
    for key, value in top.items():
        if isinstance(value, dict):
            below = base.get(key)
            base[key] = dict(below) if isinstance(below, dict) else {}
            _merge(base[key], value)
        else:
            base[key] = value


def _record_lines(node: yaml.Node, file: Path, path: KeyPath, where: dict[KeyPath, str]) -> None:
    """Note the line of every key and item below a node; a key that is there twice is refused."""
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key_node, value_node in node.value:
            key, line = str(key_node.value), key_node.start_mark.line + 1
            if key in seen:
                raise ConfigError(f"{file}:{line}: key '{key}' is there twice")
            seen.add(key)
            where[(*path, key)] = f"{file}:{line}"
            _record_lines(value_node, file, (*path, key), where)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            where[(*path, index)] = f"{file}:{item.start_mark.line + 1}"
            _record_lines(item, file, (*path, index), where)
