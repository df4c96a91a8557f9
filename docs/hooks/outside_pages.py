# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Brings into the site what lies outside docs/: top-level pages, notebooks, files that are linked.

Pages link to the files of the checkout, so that they can also be read on a forge. Here these links
become links within the site.
"""

from __future__ import annotations

import os.path
import re
from functools import cache
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from nbconvert import MarkdownExporter

ROOT = Path(__file__).resolve().parent.parent.parent

LINK = re.compile(r"(\]\()([^)#\s:]+)((?:#[^)\s]*)?\))")
HEADING = re.compile(r"^# (.+)$", re.MULTILINE)

TOP_LEVEL = {"README.md": "readme.md", "CONTRIBUTING.md": "contributing.md"} | {
    "CHANGELOG.md": "changelog.md"
}
"""Pages at the top of the checkout, and what they are called in the site."""


def on_config(config: MkDocsConfig) -> None:
    """Append the notebooks to the tutorials."""
    (tutorials,) = [entry["Tutorials"] for entry in config.nav or [] if "Tutorials" in entry]
    tutorials += [{_title(path): _page_of(path)} for path in _notebooks()]
    (extending,) = [entry["Extending"] for entry in config.nav or [] if "Extending" in entry]
    extending += [{"Contributing": "contributing.md"}, {"Changelog": "changelog.md"}]


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages and files outside docs/ that pages link to."""
    for name, uri in TOP_LEVEL.items():
        _add(files, config, uri, (ROOT / name).read_text(encoding="utf-8"))
    for path in _notebooks():
        _add_notebook(files, config, path)
    for file in list(files.documentation_pages()):
        for target in _targets(file):
            if target.is_file() and not target.is_relative_to(ROOT / "docs"):
                uri = _uri(target)
                if files.get_file_from_path(uri) is None:
                    files.append(File.generated(config, uri, abs_src_path=str(target)))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links to files of the checkout lead to where they are in the site."""
    here = Path(page.file.src_uri).parent

    def link(found: re.Match[str]) -> str:
        target = _target(page.file, found[2])
        if found[2].startswith("/") or not target.is_file():
            return found[0]
        uri = _uri(target)
        if files.get_file_from_path(uri) is None:
            return found[0]
        return found[1] + Path(os.path.relpath(uri, here)).as_posix() + found[3]

    return LINK.sub(link, markdown)


def _notebooks() -> list[Path]:
    return sorted((ROOT / "notebooks").glob("*.ipynb"))


def _page_of(notebook: Path) -> str:
    return f"tutorials/{notebook.stem}.md"


def _title(notebook: Path) -> str:
    """The first heading of a notebook, with its number."""
    number = notebook.stem.split("_")[0].lstrip("0")
    found = HEADING.search(_converted(notebook)[0])
    return f"{number}. {found[1]}" if found else notebook.stem


def _add_notebook(files: Files, config: MkDocsConfig, path: Path) -> None:
    """Add a notebook as a page, with the pictures that are stored in it, and as a file."""
    body, pictures = _converted(path)
    _add(files, config, _page_of(path), _with_download(body, path.name))
    for name, content in pictures.items():
        files.append(File.generated(config, f"tutorials/{name}", content=content))
    files.append(File.generated(config, f"tutorials/{path.name}", abs_src_path=str(path)))


@cache
def _converted(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and the pictures that are stored in it, by name."""
    resources = {"output_files_dir": f"{path.stem}_files", "unique_key": "output"}
    exporter: Any = MarkdownExporter()  # type: ignore[no-untyped-call]
    body, found = exporter.from_filename(str(path), resources=resources)
    return body, found["outputs"]


def _with_download(body: str, name: str) -> str:
    """A page with a link to the notebook under its title."""
    note = f"*This page is the notebook [{name}]({name}).*"
    return HEADING.sub(lambda found: f"{found[0]}\n\n{note}", body, count=1)


def _add(files: Files, config: MkDocsConfig, uri: str, content: str) -> None:
    files.append(File.generated(config, uri, content=content))


def _targets(file: File) -> set[Path]:
    return {_target(file, found[2]) for found in LINK.finditer(file.content_string)}


def _target(file: File, link: str) -> Path:
    """The file of the checkout that a link leads to, from where the page lies in the checkout."""
    if file.src_uri in TOP_LEVEL.values():
        folder = ROOT
    elif file.src_uri.startswith("tutorials/"):
        folder = ROOT / "notebooks"
    else:
        folder = (ROOT / "docs" / file.src_uri).parent
    return Path(os.path.normpath(folder / link))


def _uri(target: Path) -> str:
    """Where a file of the checkout is in the site."""
    path = target.relative_to(ROOT).as_posix()
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if path.startswith("notebooks/"):
        return f"tutorials/{target.name}"
    return TOP_LEVEL.get(path, f"source/{path}")
