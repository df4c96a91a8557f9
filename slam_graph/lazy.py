# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Public names of a package that are imported when they are first used."""

from __future__ import annotations

from importlib import import_module
from sys import modules

TYPE_CHECKING = False  # `typing` takes too long for what is imported before all else

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any

__all__ = ["lazy_exports"]


def lazy_exports(
    package: str, homes: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package that imports nothing by itself (PEP 562).

    Args:
        package: `__name__` of the package, which lists the names in `__all__`.
        homes: its modules, each with the names that are exported from there.
    """
    home = {name: module for module, names in homes.items() for name in names}

    def get(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}", name=name)
        value = getattr(import_module(f"{package}.{home[name]}"), name)
        setattr(modules[package], name, value)
        return value

    def public_names() -> list[str]:
        return sorted(modules[package].__all__)

    return get, public_names
