# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Typed settings, and YAML trees that remember file and line."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "ConfigTree",
    "Settings",
    "expert",
]

if TYPE_CHECKING:
    from slam_graph.settings.base import Settings, expert
    from slam_graph.settings.tree import ConfigTree
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "base": ("Settings", "expert"),
            "tree": ("ConfigTree",),
        },
    )
