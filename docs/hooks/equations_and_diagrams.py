# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Turns LaTeX into MathML and Mermaid into SVG when the site is built.

So a page needs no script for either, from here or from elsewhere.
"""

from __future__ import annotations

import html
import re
from functools import cache

import mermaidx  # type: ignore[import-untyped]
from math_core import LatexError, LatexToMathML
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

CONVERTER = LatexToMathML(fancy_error=False)

INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
DISPLAY = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)
DIAGRAM = re.compile(r'<pre class="mermaid"><code>(.*?)</code></pre>', re.DOTALL)
STYLE = (
    "%%{init: {'theme': 'neutral', "
    "'flowchart': {'nodeSpacing': 18, 'rankSpacing': 22, 'padding': 8}}}%%\n"
)
"""Close together, so that the text of a wide diagram is not scaled down too far."""

SCALE = 0.8
"""Least size of a diagram; one that is wider than its page can be scrolled."""


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Render the equations and diagrams of a page."""
    place = page.file.src_uri
    content = DISPLAY.sub(
        lambda found: f'<div class="equation">{equation(found[1], True, place)}</div>', content
    )
    content = INLINE.sub(lambda found: equation(found[1], False, place), content)
    return DIAGRAM.sub(
        lambda found: f'<div class="diagram">{diagram(html.unescape(found[1]))}</div>', content
    )


def equation(latex: str, display: bool, place: str) -> str:
    """The MathML of an equation.

    Raises:
        PluginError: if its LaTeX is not understood.
    """
    try:
        return CONVERTER.convert_with_local_state(html.unescape(latex), displaystyle=display)
    except LatexError as error:
        raise PluginError(f"{place}: {error}") from error


@cache
def diagram(source: str) -> str:
    """The SVG of a Mermaid diagram, at a size at which its text can be read."""
    svg = str(mermaidx.render(STYLE + source).svg())
    box = re.search(r'viewBox="\S+ \S+ (\S+) ', svg)
    width = SCALE * float(box[1]) if box else 1000.0
    return svg.replace('style="', f'style="min-width: {width:.0f}px; ', 1)
