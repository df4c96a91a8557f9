# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The one reader of YAML files, untrusted ones among them.

It is PyYAML's safe loader with bounds: on the depth of the nesting (its composer is recursive), on
what aliases repeat (ten lines of aliases of aliases make 10⁹ values), and on the digits of whole
numbers. Whatever is wrong with a file is a `YamlTextError`: one line, and where it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

_MAX_DEPTH = 64
"""Deepest nesting of tables and lists: settings have five levels."""
_MAX_REPEATED = 10_000
"""Most values that the aliases of a file may repeat; it also bounds how deep they nest."""
_MAX_INTEGER = 100
"""Most characters of a whole number: stamps have 19."""
_MAX_SHOWN = 60
"""Characters of a text of the file in a message."""


class YamlTextError(ValueError):
    """What is wrong with the text of a file.

    Attributes:
        line: where it is, from 1; None where that is not known.
        reason: in one line.
    """

    def __init__(self, line: int | None, reason: str) -> None:
        super().__init__(reason)
        self.line = line
        self.reason = reason

    def where(self, path: str | Path) -> str:
        """The place in a file, for messages."""
        return str(path) if self.line is None else f"{path}:{self.line}"


def parse_node(text: str) -> yaml.Node | None:
    """The nodes of a text, which know their lines; None if it holds no value.

    Raises:
        YamlTextError: if it is not YAML, or beyond the bounds of this reader.
    """
    return _read(text)[0]


def parse_value(text: str) -> tuple[Any, yaml.Node | None]:
    """The value of a text in types of Python, and its nodes; twice None if it holds no value.

    Raises:
        YamlTextError: if it is not YAML, a value is not of the type that it seems to have, or it is
            beyond the bounds of this reader.
    """
    node, loader = _read(text)
    if loader is None or node is None:
        return None, None
    try:
        return loader.construct_document(node), node
    except yaml.YAMLError as error:
        raise _fault(error) from None
    finally:
        loader.dispose()


def _read(text: str) -> tuple[yaml.Node | None, _BoundedLoader | None]:
    try:
        loader = _BoundedLoader(text)
        return loader.get_single_node(), loader
    except yaml.YAMLError as error:
        raise _fault(error) from None
    except (
        ValueError,
        OverflowError,
    ) as error:  # an escape that is no character, a version that is no number
        raise YamlTextError(None, " ".join(str(error).split())) from None


def _fault(error: yaml.YAMLError) -> YamlTextError:
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        reason = str(error.problem or error.context)
        if reason == "second occurrence":  # of an anchor
            reason = str(error.context).partition(";")[0]
        return YamlTextError(mark.line + 1 if mark else None, " ".join(reason.split())[:200])
    return YamlTextError(None, " ".join(str(error).split())[:200])


class _BoundedLoader(yaml.SafeLoader):
    """PyYAML's safe loader with the bounds of this module."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._count = 0  # values so far, those that aliases repeat included
        self._repeated = 0
        self._sizes: dict[str, int] = {}  # of what is anchored, with all that is in it

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """The next value, within the bounds."""
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent):
            self._repeat(event)
            return super().compose_node(parent, index)
        if self._depth >= _MAX_DEPTH:
            raise yaml.MarkedYAMLError(
                problem=f"nested deeper than {_MAX_DEPTH} levels", problem_mark=event.start_mark
            )
        before = self._count
        self._depth += 1
        self._count += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        if event.anchor is not None:
            self._sizes[event.anchor] = self._count - before
        return node

    def _repeat(self, event: Any) -> None:
        """Count what an alias repeats."""
        if event.anchor in self.anchors and event.anchor not in self._sizes:
            raise yaml.MarkedYAMLError(
                problem=f"'{event.anchor[:_MAX_SHOWN]}' contains itself",
                problem_mark=event.start_mark,
            )
        size = self._sizes.get(event.anchor, 0)  # the composer refuses unknown ones
        self._count += size
        self._repeated += size
        if self._repeated > _MAX_REPEATED:
            raise yaml.MarkedYAMLError(
                problem=f"aliases repeat more than {_MAX_REPEATED} values",
                problem_mark=event.start_mark,
            )

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """The value of a node; PyYAML lets any exception of the conversion pass."""
        try:
            if node.tag == "tag:yaml.org,2002:int" and len(str(node.value)) > _MAX_INTEGER:
                raise ValueError
            return super().construct_object(node, deep)
        except (ValueError, LookupError, AttributeError, TypeError, ArithmeticError):
            kind = str(node.tag).rpartition(":")[2]
            shown = str(node.value)[:_MAX_SHOWN] if isinstance(node, yaml.ScalarNode) else "this"
            raise yaml.constructor.ConstructorError(
                None, None, f"'{shown}' is not of type {kind}", node.start_mark
            ) from None
