# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of matplotlib are made, but not rendered, where nobody looks at them.

To render the picture of a run takes a second, ten times what the rest of its files take, and five
are in each report. Tests that look at pictures, or draw what is damaged, use `rendered`.
"""

import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

STYLE = "slam_graph.visualization.style"
"""The module of pictures, which imports matplotlib."""


def blank(*_: object) -> Any:
    """What stands for the pixels of a picture: a single one, white."""
    from PIL import Image

    return Image.new("RGB", (1, 1), "white")


class _WhenImported(MetaPathFinder):
    """Finds the module of pictures, and changes it once it is there."""

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> Any:
        if name != STYLE:
            return None
        spec = PathFinder.find_spec(name, path, target)
        assert isinstance(spec, ModuleSpec)
        loader: Any = spec.loader
        execute = loader.exec_module

        def exec_module(module: Any) -> None:
            execute(module)
            _change(module)

        loader.exec_module = exec_module
        return spec


def _change(module: Any) -> None:
    module.rendered = module.Picture._drawn
    module.Picture._drawn = blank


def render_nothing() -> None:
    """From now on pictures of this process have one pixel; nothing is imported for it."""
    if STYLE in sys.modules:
        _change(sys.modules[STYLE])
    else:
        sys.meta_path.insert(0, _WhenImported())
