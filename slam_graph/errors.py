# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The errors that slam_graph raises: one tree, each branch with an exit code of the command line.

Every message is one line that says what is wrong, where (with file and line, if there are any), and
what to do about it.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import ClassVar
from unicodedata import category

__all__ = ["ConfigError", "DataError", "EstimationError", "SlamGraphError", "closest"]


_LONGEST = 1500
"""Characters of a message that are shown."""


class SlamGraphError(Exception):
    """Root of all errors raised on purpose by this package; its text is one line of some length."""

    exit_code: ClassVar[int] = 1

    def __str__(self) -> str:
        # it may quote a file from anywhere: no other lines, and nothing that steers a terminal
        line = " ".join(super().__str__().splitlines())
        if not line.isprintable():
            shown = (c.isprintable() or category(c) == "Zs" for c in line)
            line = "".join(c if s else ascii(c)[1:-1] for c, s in zip(line, shown, strict=True))
        return line if len(line) <= _LONGEST else f"{line[:_LONGEST]} …"


class DataError(SlamGraphError):
    """A recording, a calibration or a trajectory file is missing, unreadable or inconsistent."""

    exit_code: ClassVar[int] = 1


class ConfigError(SlamGraphError):
    """A configuration or an option does not fit the schema."""

    exit_code: ClassVar[int] = 2


class EstimationError(SlamGraphError):
    """The run started but never initialised, diverged, or covered less than was asked."""

    exit_code: ClassVar[int] = 3


def closest(name: str, known: Iterable[str]) -> str:
    """A hint at the known name most like `name`, or the list of all if none is."""
    known = list(known)
    similar = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"did you mean '{similar[0]}'?" if similar else f"known: {', '.join(known)}"
