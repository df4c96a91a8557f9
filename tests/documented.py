# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Reads what pages and help tell a user to type: commands, Python, and what they print."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from slam_graph.cli.help_texts import EXAMPLES

ROOT = Path(__file__).parent.parent
HELP = "help"
"""Stands for the examples in the help of all commands, as if they were one page."""

PARTS = {
    "start": ["README.md", "docs/quickstart.md", "docs/index.md", "docs/api.md", HELP],
    "recordings": ["docs/own_data.md", "docs/datasets.md", "docs/batch.md", "docs/simulation.md"],
}
"""Pages by the file of tests that does their steps; `methods` does all others."""

GROUPS = ("data", "config", "frontend", "map")
"""Commands of `slam-graph` that have commands of their own."""
_ALONE = ("config dump", "config schema")
"""Commands that do something without a word more."""

_FENCE = re.compile(r"^( *)```(\w+)\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
_SHELL, _PYTHON = ("sh", "bash", "console"), ("py", "python")
_INLINE = re.compile(r"`(slam-graph [a-z][^`…]*)`")


@dataclass(frozen=True)
class Step:
    """Something to type.

    Attributes:
        place: the page and line, for messages.
        text: a command of a shell on one line, or a block of Python.
        is_python: which of them.
        printed: what the page says that it prints, line by line; empty if it says nothing.
    """

    place: str
    text: str
    is_python: bool = False
    printed: list[str] = field(default_factory=list)

    @property
    def program(self) -> str:
        """The first word."""
        return "python" if self.is_python else shlex.split(self.text)[0]


def page_text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def pages() -> list[str]:
    """README, the pages below `docs/` in the order of their names, and the help."""
    docs = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md"))
    return ["README.md", *docs, HELP]


def pages_of(part: str) -> list[str]:
    """The pages of a file of tests, of those that show something to type."""
    shown = [page for page in pages() if steps(page)]
    if part in PARTS:
        return [page for page in shown if page in PARTS[part]]
    return [page for page in shown if not any(page in of_part for of_part in PARTS.values())]


def blocks(page: str, *languages: str) -> Iterator[tuple[int, str, str]]:
    """Line, language and content of each block of a page."""
    text = page_text(page)
    for found in _FENCE.finditer(text):
        indent, language, content = found.groups()
        if language in languages:
            plain = re.sub(rf"^{indent}", "", content, flags=re.MULTILINE)
            yield text[: found.start()].count("\n") + 2, language, plain


def steps(page: str) -> list[Step]:
    """All that a page tells one to type, in its order."""
    if page == HELP:
        return [Step(f"help of '{name}'", line) for name in EXAMPLES for line in EXAMPLES[name]]
    found: list[Step] = []
    for line, language, content in blocks(page, *_SHELL, *_PYTHON):
        place = f"{page}:{line}"
        if language in _PYTHON:
            found.append(Step(place, content, is_python=True))
        elif language == "console":
            found += _typed(place, content)
        else:
            lines = content.replace("\\\n", " ").splitlines()
            found += [Step(place, line) for line in lines if line.strip()]
    return found


def _typed(place: str, content: str) -> list[Step]:
    """Commands behind `$` and what they print; a block without `$` only prints."""
    found: list[Step] = []
    for line in content.replace("\\\n", " ").splitlines():
        if line.startswith("$ "):
            found.append(Step(place, line.removeprefix("$ ")))
        elif found:
            found[-1].printed.append(line)
    return found


def inline_commands() -> list[str]:
    """The commands within sentences and tables of all pages, once each."""
    texts = [page_text(page) for page in pages() if page != HELP]
    return sorted({command for text in texts for command in _INLINE.findall(text)})


def name_of(command: str) -> list[str]:
    """The name of a command of `slam-graph`, in one or two words."""
    words = command.split()[1:]
    grouped = words[0] in GROUPS and len(words) > 1 and words[1].islower()
    return words[: 2 if grouped else 1]


def inline_steps() -> list[Step]:
    """The commands within sentences and tables that can be typed: not those that are named only."""
    found = []
    for command in inline_commands():
        name = name_of(command)
        if command.split()[1:] != name or " ".join(name) in _ALONE:
            places = [page for page in pages() if page != HELP and command in page_text(page)]
            found.append(Step(places[0], " ".join(command.split())))
    return found
