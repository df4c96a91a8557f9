# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The sources of the package, each parsed once for the tests of imports."""

import ast
from functools import cache
from pathlib import Path

Import = ast.Import | ast.ImportFrom


def tree(path: Path) -> ast.Module:
    """A file, parsed; it is not kept, as all of them take much memory."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports_of(path: Path) -> tuple[Import, ...]:
    """All imports in a file."""
    return tuple(node for node in ast.walk(tree(path)) if isinstance(node, Import))
