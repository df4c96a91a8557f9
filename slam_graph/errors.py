# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The errors that slam_graph raises: one tree, each branch with an exit code of the command line.

Every message is one line that says what is wrong, where (with file and line, if there are any), and
what to do about it.
"""

from __future__ import annotations

from typing import ClassVar

__all__ = ["ConfigError", "DataError", "EstimationError", "SlamGraphError"]


class SlamGraphError(Exception):
    """Root of all errors raised on purpose by this package."""

    exit_code: ClassVar[int] = 1


class DataError(SlamGraphError):
    """A recording, a calibration or a trajectory file is missing, unreadable or inconsistent."""

    exit_code: ClassVar[int] = 1


class ConfigError(SlamGraphError):
    """A configuration or an option does not fit the schema."""

    exit_code: ClassVar[int] = 2


class EstimationError(SlamGraphError):
    """The run started but never initialised, diverged, or covered less than was asked."""

    exit_code: ClassVar[int] = 3
