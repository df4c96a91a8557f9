# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fills in the reference: commands from the program, names from the packages' `__all__`.

A page says by a marker, `<!-- generated: NAME -->`, where its part is to stand.
"""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

PACKAGE = Path(__file__).resolve().parent.parent.parent / "slam_graph"

MARKER = re.compile(r"^<!-- generated: ([a-z ]+) -->$", re.MULTILINE)

TAG = re.compile(r"```.*?```|`[^`]*`|(?P<tag><)", re.DOTALL)
"""What looks like a tag of HTML outside of code."""

EXAMPLES = re.compile(r"^\[bold\](.+)\[/bold\]\n\n((?:  \[cyan\].+\[/cyan\]\n)+)", re.MULTILINE)
"""Examples as they are marked up for a terminal: title and lines."""


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put the generated parts where a page has their markers."""
    return MARKER.sub(lambda found: PARTS[found[1]](), markdown)


def commands() -> str:
    """All commands of `slam-graph` with their arguments and options, as its help has them."""
    typer = [sys.executable, "-m", "typer", "slam_graph.cli.main"]
    arguments = ["utils", "docs", "--name", "slam-graph"]
    done = subprocess.run(
        [*typer, *arguments], cwd=PACKAGE.parent, capture_output=True, text=True, check=True
    )
    _, _, body = done.stdout.partition("\n")  # the page has a title of its own
    body = EXAMPLES.sub(_block, _whole_summaries(body))
    return TAG.sub(lambda found: found[0].replace("<", "&lt;") if found["tag"] else found[0], body)


def _whole_summaries(body: str) -> str:
    """The lists of commands with the whole first sentences, which Typer cuts short."""
    first = dict(re.findall(r"^##+ `slam-graph (.+)`\n\n(.+(?:\n.+)*)", body, re.MULTILINE))
    lines, group = [], ""
    for line in body.splitlines():
        if heading := re.match(r"##+ `slam-graph (.+)`", line):
            group = f"{heading[1]} "
        if entry := re.match(r"\* `([a-z]+)`: .*\.\.\.$", line):
            line = f"* `{entry[1]}`: {first[group + entry[1]].replace(chr(10), ' ')}"
        lines.append(line)
    return "\n".join(lines)


def _block(found: re.Match[str]) -> str:
    """Examples as a block of commands."""
    lines = re.sub(r"^  \[cyan\](.+)\[/cyan\]$", r"\1", found[2], flags=re.MULTILINE)
    return f"**{found[1]}**:\n\n```sh\n{lines}```\n"


def main_names() -> str:
    """The names of `slam_graph` itself."""
    return "\n\n".join(_entries("slam_graph"))


def package_names() -> str:
    """The names of each package that are not in `slam_graph` itself."""
    main = set(_exported("slam_graph"))
    sections = []
    for package in sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py")):
        names = [name for name in _exported(f"slam_graph.{package}") if name not in main]
        if names:
            entries = "\n\n".join(_entries(f"slam_graph.{package}", names))
            sections.append(f"## slam_graph.{package}\n\n{entries}")
    return "\n\n".join(sections)


PARTS = {"commands": commands, "main names": main_names, "package names": package_names}


def _exported(package: str) -> list[str]:
    return list(getattr(importlib.import_module(package), "__all__", ()))


def _entries(package: str, names: list[str] | None = None) -> Iterator[str]:
    """An instruction of mkdocstrings for each public name."""
    for name in names or _exported(package):
        if not name.startswith("_"):
            yield f"::: {package}.{name}"
