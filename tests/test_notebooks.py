# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Every notebook runs from top to bottom, and is kept with the outputs that a reader sees."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from groups import slow
from limits import HANG_S

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
BRIEFLY = {
    'sg.run("demo", algorithm="msckf")': 'sg.run("demo", algorithm="msckf", duration_s=14)',
    "in data.packets():": "in data.packets(end_ns=data.info().start_ns + 7_000_000_000):",
}
"""`make test` executes the first notebook alone, on parts of its recording."""
LARGEST_BYTES = 250_000
PICTURE = re.compile(r'"image/png"|data:image/png;base64')
MACHINE = re.compile(r"/(home|root|tmp|work|usr|opt|Users)/|site-packages|[A-Z]:\\\\")
LINK = re.compile(r"\]\(([^)#]+)(?:#([^)]+))?\)")

Cell = dict[str, Any]


def name(path: Path) -> str:
    return path.name


def cells_of(path: Path, kind: str) -> list[Cell]:
    cells: list[Cell] = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == kind]


def text_of(cell: Cell) -> str:
    return "".join(cell["source"])


def shows_something(cell: Cell) -> bool:
    """Whether a cell prints, or its last line is an expression that is not muted."""
    source = text_of(cell).rstrip()
    last = source.splitlines()[-1]
    expression = re.fullmatch(r"[\w.\[\]:]+(\(.*\))?", last) is not None
    return re.search(r"^\s*print\(", source, re.MULTILINE) is not None or expression


def test_there_are_twelve_notebooks() -> None:
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{k:02d}" for k in range(1, 13)]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=name)
def test_outputs_are_stored_and_light(path: Path) -> None:
    assert path.stat().st_size <= LARGEST_BYTES
    shown = [cell for cell in cells_of(path, "code") if shows_something(cell)]
    assert [text_of(cell) for cell in shown if not cell["outputs"]] == []
    outputs = [out for cell in cells_of(path, "code") for out in cell["outputs"]]
    assert not [out for out in outputs if out.get("name") == "stderr"], "a cell warned"
    stored = [json.dumps(out) for out in outputs]
    assert sum(bool(PICTURE.search(out)) for out in stored) >= 2


@pytest.mark.parametrize("path", NOTEBOOKS, ids=name)
def test_a_notebook_names_nothing_of_a_machine(path: Path) -> None:
    for cell in (*cells_of(path, "code"), *cells_of(path, "markdown")):
        pictures = re.compile(r'base64,[^"\\]*|"image/png": "[^"]*"')
        assert not MACHINE.search(pictures.sub("", json.dumps(cell)))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=name)
def test_links_and_names_of_files_are_of_something(path: Path) -> None:
    text = "\n".join(map(text_of, cells_of(path, "markdown")))
    for target, _ in LINK.findall(text):
        assert target.startswith("http") or (path.parent / target).is_file(), target
    for file in re.findall(r"`((?:slam_graph|tests|docs|configs)/[\w/]+\.\w+)`", text):
        assert (ROOT / file).is_file(), file


@pytest.mark.parametrize(
    ("path", "briefly"),
    [(NOTEBOOKS[0], True), *(slow(path, False) for path in NOTEBOOKS)],
    ids=["first", *map(name, NOTEBOOKS)],
)
def test_notebook_runs(path: Path, briefly: bool, tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    text = path.read_text(encoding="utf-8")
    for whole, part in BRIEFLY.items() if briefly else ():
        whole, part = (json.dumps(code)[1:-1] for code in (whole, part))
        assert text.count(whole) == 1, whole
        text = text.replace(whole, part)
    notebook = nbformat.reads(text, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=HANG_S, resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()  # raises at the first cell that fails
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", [])]
    assert not [out for out in outputs if out.get("name") == "stderr"], "a cell warned"
    assert sum(bool(PICTURE.search(json.dumps(out))) for out in outputs) >= 2
