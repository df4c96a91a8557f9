# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How a module is run by another process of this Python, with what this process imports."""

from __future__ import annotations

import os
import sys
from pathlib import Path

__all__ = ["command_of", "inherited_imports"]


def command_of(module: str, *arguments: str) -> list[str] | None:
    """The command that runs a module; None within an application, which it would start again."""
    is_python = Path(sys.executable or "").name.startswith("python")
    if not is_python or hasattr(sys, "frozen"):
        return None
    return [sys.executable, "-P", "-m", module, *arguments]


def inherited_imports() -> dict[str, str]:
    """The environment of this process, with its search path of modules."""
    paths = os.pathsep.join(str(path) or os.getcwd() for path in sys.path)
    return {**os.environ, "PYTHONPATH": paths}
