# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Registries of named parts, such as detectors, which programs and installed plugins can extend.

A `Registry` maps names to the implementations of one kind of part. They are registered in one of
three ways:

- by this package, with a decorator in one module, `home`, which is imported when it is needed;
- by a program, with the same decorator, `@DETECTORS.register("mine")`;
- by an installed package, with a Python entry point in the group of the registry. The name is known
  without importing the package, which is imported when the name is used.

A plugin that cannot be imported raises an error only where its name is used.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from threading import RLock
from typing import Any, Generic, TypeVar

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from slam_graph.errors import ConfigError, closest

__all__ = ["Choice", "Registry"]

_IMPORTING = RLock()
"""Held while a home is imported: other threads must not take its parts for unknown meanwhile."""

PartT = TypeVar("PartT")
RegisteredT = TypeVar("RegisteredT")


class UnknownNameError(ConfigError, KeyError):
    """No part has this name."""

    __str__ = Exception.__str__  # that of KeyError puts the message in quotes


class Registry(Mapping[str, PartT], Generic[PartT]):
    """Parts of one kind by name.

    It is a mapping whose names are known without importing plugins: first the package's own, then
    those of programs, then those of plugins. An unknown name raises `UnknownNameError`.

    Args:
        group: group of entry points, such as `slam_graph.detectors`.
        kind: what a part is, for messages, such as "detector".
        home: module that registers the package's own parts when it is imported.
        names: of these parts, so that they are known without importing `home`.
        accepts: whether an object can be such a part; by default, whether it can be called.
    """

    def __init__(
        self,
        group: str,
        kind: str,
        home: str | None = None,
        names: tuple[str, ...] = (),
        accepts: Callable[[object], bool] = callable,
    ) -> None:
        self.group = group
        self.kind = kind
        self._home = home
        self._names = names
        self._accepts = accepts
        self._parts: dict[str, PartT] = {}
        self._complete = home is None
        self._plugins: dict[str, list[EntryPoint]] | None = None

    def register(self, name: str) -> Callable[[RegisteredT], RegisteredT]:
        """A decorator that registers what it decorates, and returns it unchanged.

        Raises:
            ConfigError: if another part has this name, or this is no such part.
        """

        def registered(part: RegisteredT) -> RegisteredT:
            built_in = getattr(part, "__module__", "").partition(".")[0] == __package__
            # What comes with the package may be imported before the others of its kind.
            known = self._parts if built_in else self._own()
            if known.get(name, part) is not part:
                raise ConfigError(
                    f"{self.kind} '{name}' is registered already; choose another name"
                )
            self._parts[name] = self._checked(part, f"{self.kind} '{name}'")
            return part

        return registered

    @contextmanager
    def registered(self, name: str, part: PartT) -> Iterator[None]:
        """Register a part for the length of a block, as tests and notebooks want it."""
        self.register(name)(part)
        try:
            yield
        finally:
            del self._parts[name]

    def __getitem__(self, name: str) -> PartT:
        """The part with a name.

        Raises:
            UnknownNameError: if there is none; lists the names that there are.
            ConfigError: if it is a plugin's that cannot be imported, or several plugins offer it.
        """
        if name not in self._own():
            if name not in self._offered():
                raise UnknownNameError(self.unknown(name))
            self._parts[name] = self._load(self._offered()[name])
        return self._parts[name]

    def __contains__(self, name: object) -> bool:
        return name in self._names or name in self._own() or name in self._offered()

    def __iter__(self) -> Iterator[str]:
        own = dict.fromkeys([*self._names, *(self._parts if self._names else self._own())])
        yield from own  # entry points are read only if the caller goes on past these names
        yield from [name for name in self._offered() if name not in own]

    def __len__(self) -> int:
        return len(list(iter(self)))

    def working(self) -> Iterator[tuple[str, PartT]]:
        """Names and parts, without plugins that cannot be loaded."""
        for name in self:
            try:
                yield name, self[name]
            except ConfigError:
                continue

    def faults(self) -> list[str]:
        """A line for each plugin that cannot be loaded."""
        lines = []
        for name in self:
            try:
                self[name]
            except ConfigError as error:
                lines.append(str(error))
        return lines

    def unknown(self, name: str, *others: str) -> str:
        """The message for a name that is not known.

        Args:
            name: what was asked for.
            others: further names that would have been right.
        """
        known = [*others, *self]
        hint = closest(name, known)
        every = "" if hint.startswith("known") else f" (known: {', '.join(known)})"
        return f"unknown {self.kind} '{name}'; {hint}{every}"

    def _own(self) -> dict[str, PartT]:
        """What was registered with a decorator, once the package's own parts are there."""
        if self._complete:  # names are looked up in every frame: no lock then
            return self._parts
        with _IMPORTING:
            if self._home is not None:
                home, self._home = self._home, None  # none while it is imported: it registers here
                try:
                    importlib.import_module(home)
                except BaseException:
                    self._home = home
                    raise
                self._complete = True
        return self._parts

    def _offered(self) -> dict[str, list[EntryPoint]]:
        """Entry points by name, read once; nothing is imported."""
        if self._plugins is None:
            self._plugins = {}
            for entry in _all_entry_points(tuple(sys.path)).select(group=self.group):
                same = self._plugins.setdefault(entry.name, [])
                if entry not in same:  # a package may be found twice on the path
                    same.append(entry)
        return self._plugins

    def _load(self, entries: list[EntryPoint]) -> PartT:
        """What an entry point refers to."""
        entry = entries[0]
        if len(entries) > 1:
            packages = " and ".join(sorted({_package(offer) for offer in entries}))
            raise ConfigError(f"{self.kind} '{entry.name}' is offered by {packages}; remove one")
        what = f"{self.kind} '{entry.name}' of {_package(entry)}"
        try:
            part = entry.load()
        except Exception as error:  # a plugin may fail in any way
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise ConfigError(f"{what}: cannot load {entry.value}: {reason}") from error
        return self._checked(part, what)

    def _checked(self, part: Any, what: str) -> PartT:
        if not self._accepts(part):
            raise ConfigError(f"{what}: expected a {self.kind}, got {type(part).__name__}")
        checked: PartT = part
        return checked


@lru_cache(1)
def _all_entry_points(path: tuple[str, ...]) -> Any:
    """What all packages on the path offer: a search looks at every one, whatever the group.

    The path is the key of the cache: packages that are installed into it later are not seen.
    Its class depends on the version of Python; `select` finds those of a group in any.
    """
    return entry_points()


def _package(entry: EntryPoint) -> str:
    """Name and version of the package that declares an entry point."""
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown package"


class Choice:
    """Annotation of a setting that names a part: `detector: Annotated[str, Choice(DETECTORS)]`.

    The name must be known when the setting is read; the JSON schema lists the names.

    Args:
        registries: a name in any of them is right; the first one words the error.
        others: further names that are right, such as "auto".
    """

    def __init__(self, *registries: Registry[Any], others: tuple[str, ...] = ()) -> None:
        self._registries = registries
        self._others = others

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """How pydantic checks it."""
        return core_schema.no_info_after_validator_function(self._known, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """How a JSON schema describes it."""
        return {**handler(schema), "enum": self.names()}

    def names(self) -> list[str]:
        """Every name that is right."""
        return list(dict.fromkeys([*self._others, *(n for r in self._registries for n in r)]))

    def _known(self, name: str) -> str:
        if name in self._others or any(name in registry for registry in self._registries):
            return name
        others = [other for other in self.names() if other not in self._registries[0]]
        raise ValueError(self._registries[0].unknown(name, *others))
