# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How objects show themselves in Jupyter: as a table of facts with a small picture."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from importlib import import_module
from typing import Any, Literal

from slam_graph.errors import SlamGraphError

__all__ = ["Displayed"]

_PICTURES = "slam_graph.visualization"
"""The package that draws. It is loaded when a picture is asked for: a trajectory is defined long
before what can be drawn of it, and matplotlib is slow to import."""

_Module = Literal["notebook_figures", "pose_graph_picture", "bundle_picture", "inline_viewer"]

_DPI = 72
_CELL = "text-align:left;vertical-align:top;padding:1px 10px 1px 0"


class Displayed:
    """Base of what shows itself in Jupyter. A class says its facts, and may draw a picture."""

    __slots__ = ()

    def _facts(self) -> Mapping[str, object]:
        """The rows of the table: a name and a value each; values of None are left out."""
        raise NotImplementedError

    def _sketch(self) -> Any:
        """A small picture (matplotlib figure with `light_png`), or None."""
        return None

    def _repr_html_(self) -> str:
        rows = "".join(
            f'<tr><td style="{_CELL};opacity:.65">{escape(name)}</td>'
            f'<td style="{_CELL}">{escape(str(value))}</td></tr>'
            for name, value in self._facts().items()
            if value is not None
        )
        try:
            sketch = self._sketch()
        except SlamGraphError:  # a file is missing: the table says what there is
            sketch = None
        picture = ""
        if sketch is not None:
            data = b64encode(sketch.light_png(_DPI)).decode("ascii")
            picture = f'<img alt="" style="max-width:100%" src="data:image/png;base64,{data}">'
        title = escape(type(self).__name__)
        return f"<div><b>{title}</b><table>{rows}</table>{picture}</div>"

    @staticmethod
    def _drawn_by(module: _Module) -> Any:
        """A module of `slam_graph/visualization/`, for its functions that draw."""
        return import_module(f"{_PICTURES}.{module}")
