# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Imports inside commands: announced in a terminal, and as cheap as they can be."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import Any

from slam_graph.interrupts import Interrupts

_POSTPONED = ("numpy.f2py", "numpy.ma", "numpy.polynomial", "numpy.testing")
"""Parts of NumPy that SciPy imports because it copies all names of NumPy. A run hardly ever uses
them, and they take some 100 ms."""

_POSTPONED_ROOTS = ("scipy.spatial",)
"""Packages of which a run begins with a part: `scipy.spatial.transform`. The rest, with the special
functions and sparse matrices that it imports, takes some 100 ms."""


@contextmanager
def loading(text: str = "loading") -> Iterator[None]:
    """Around imports: says in a terminal what is going on, until there is more to say.

    No garbage is collected meanwhile. Imports leave none, and each collection would look at all
    that was imported so far, which makes up a quarter of their time. Later ones do not look at it
    either.
    """
    announced = sys.stderr.isatty()
    if announced:
        sys.stderr.write(f"{text} …\r")
        sys.stderr.flush()
    gc.disable()
    try:
        with (
            Interrupts.completed() as begin
        ):  # Ctrl-C in the middle of an import is not always heard
            begin()
            _postpone_parts()
            yield
    finally:
        gc.freeze()
        gc.enable()
        if announced:
            sys.stderr.write("\x1b[2K")
            sys.stderr.flush()


class _Postponed(ModuleType):
    """A package that is executed when the first of its names or modules is used.

    Unlike that of `importlib.util.LazyLoader` it is not executed by `inspect`, which looks at the
    file of every module.
    """

    def __getattr__(self, name: str) -> Any:
        spec = self.__spec__
        if (name.startswith("__") and name != "__path__") or spec is None or spec.loader is None:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}", name=name)
        self.__class__ = ModuleType  # type: ignore[assignment]  # a plain module from now on
        self.__path__ = spec.submodule_search_locations or []
        spec.loader.exec_module(self)
        return getattr(self, name)


class _PostponedRoot(_Postponed):
    """A package whose modules are imported without it; it is executed when another name is used.

    Its modules may import one another, also those whose names begin with an underscore.
    """

    def __getattr__(self, name: str) -> Any:
        module = sys.modules.get(f"{self.__name__}.{name}")  # maybe in the middle of its import
        if module is not None:
            return module
        if name.startswith("_"):
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}", name=name)
        return super().__getattr__(name)


def _postpone_parts() -> None:
    """Import what a run hardly ever uses of NumPy and SciPy when the first of it is used."""
    for name in (*_POSTPONED, *_POSTPONED_ROOTS):
        package, _, part = name.partition(".")
        spec = None if name in sys.modules else find_spec(name)
        if spec is not None:
            module = sys.modules[name] = module_from_spec(spec)
            if name in _POSTPONED:
                del module.__path__  # `import numpy.ma.core` asks for it: that executes the package
            module.__class__ = _Postponed if name in _POSTPONED else _PostponedRoot
            setattr(sys.modules[package], part, module)
