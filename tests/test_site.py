# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The documentation site builds without a warning, is whole, and fetches nothing when viewed."""

import os
import re
import subprocess
import sys
from html import unescape
from pathlib import Path

import pytest
from limits import HANG_S

import slam_graph
from slam_graph.cli.main import app

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
WITH_EQUATIONS = sorted(
    page for page in DOCS.rglob("*.md") if "\n$$\n" in page.read_text(encoding="utf-8")
)

FETCHED = re.compile(
    r"<(?:script|img|iframe|source|video)\b[^>]*\bsrc=\"?(?:https?:)?//"
    r"|<link\b(?![^>]*\brel=\"?(?:canonical|alternate))[^>]*\bhref=\"?(?:https?:)?//"
    r"|@import|url\([\"']?(?:https?:)?//"
)
"""What a browser loads from elsewhere when a page is opened. Links are not."""


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for package in ("material", "mkdocstrings", "math_core", "mermaidx", "nbconvert"):
        pytest.importorskip(package)
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def without_code(html: str) -> str:
    return re.sub(r"<(pre|code)\b.*?</\1>", "", html, flags=re.DOTALL)


def test_every_page_and_notebook_is_in_the_site(site: Path) -> None:
    pages = {path.relative_to(DOCS).with_suffix(".html") for path in DOCS.rglob("*.md")}
    pages |= {
        Path("tutorials") / path.with_suffix(".html").name
        for path in (ROOT / "notebooks").glob("*.ipynb")
    }
    assert not [page for page in sorted(pages) if not (site / page).is_file()]


def test_nothing_is_fetched(site: Path) -> None:
    loaded = {
        str(path.relative_to(site)): found
        for pattern in ("*.html", "*.css")
        for path in site.rglob(pattern)
        if (found := FETCHED.findall(text(path)))
    }
    assert not loaded


@pytest.mark.parametrize("page", WITH_EQUATIONS, ids=lambda page: page.stem)
def test_equations_are_rendered(site: Path, page: Path) -> None:
    source = re.sub(r"```.*?```|`[^`]*`", "", text(page), flags=re.DOTALL)
    display = len(re.findall(r"^\$\$$", source, re.MULTILINE)) // 2
    html = text(site / page.relative_to(DOCS).with_suffix(".html"))
    assert html.count('<div class="equation">') == display
    assert html.count("<math") >= display + (source.count("$") - 4 * display) // 2
    assert not re.search(r"\$\$|\\\(|\\\[|\\[a-z]+\{", without_code(html))


def test_diagrams_and_notes_are_rendered(site: Path) -> None:
    sources = {path: text(path) for path in DOCS.glob("*.md")}
    drawn = [path for path, source in sources.items() if "```mermaid" in source]
    assert len(drawn) >= 4
    for path in drawn:
        html = text(site / f"{path.stem}.html")
        assert '<div class="diagram"><svg' in html
        assert 'class="mermaid"' not in html
    assert 'class="admonition' in text(site / "theory" / "state.html")
    assert not [page for page in site.rglob("*.html") if "<p>!!!" in text(page)]


def test_the_reference_has_all_commands_and_public_names(site: Path) -> None:
    commands = unescape(text(site / "cli.html"))
    for command in app.registered_commands:
        assert f"<code>slam-graph {command.name}</code>" in commands
    names = text(site / "api.html")
    for name in slam_graph.__all__:
        assert name.startswith("_") or f'id="slam_graph.{name}"' in names, name


def test_links_to_files_of_the_checkout_lead_into_the_site(site: Path) -> None:
    page = text(site / "theory" / "algorithms.html")
    assert 'href="../source/configs/algorithms/ekf.yaml"' in page
    assert (site / "source" / "configs" / "algorithms" / "ekf.yaml").is_file()
    assert 'href="readme.html#limits"' in text(site / "troubleshooting.html")
