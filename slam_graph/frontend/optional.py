# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Libraries that only some methods need: imported when asked for, with advice where absent."""

from __future__ import annotations

import importlib
from typing import Any

from slam_graph.errors import ConfigError

INSTALL = "pip install 'slam-graph[descriptors]'"


def require(module: str, purpose: str) -> Any:
    """Import a module of an optional library.

    Args:
        module: its full name.
        purpose: what needs it, for the message.

    Raises:
        ConfigError: if it is not installed; names the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.split(".")[0]
        raise ConfigError(f"{purpose}: needs {library}, install it: {INSTALL}") from error
