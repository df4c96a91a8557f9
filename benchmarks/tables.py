# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Write the tables of the documents from the baseline: `python -m benchmarks.tables [--check]`.

A table stands between `<!-- table: NAME -->` and `<!-- end -->`; `benchmarks.documents` and
`benchmarks.documents_speed` say what is in it.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks import documents_speed
from benchmarks.baseline import BASELINE_FILE, Baseline, read_baseline
from benchmarks.documents import TABLES as MEASURED
from benchmarks.documents import Figures
from slam_graph.errors import DataError, SlamGraphError
from slam_graph.files import Files

TABLES = MEASURED | documents_speed.TABLES
"""By the name in the marker of a document."""

ROOT = Path(__file__).resolve().parent.parent

MARKED = re.compile(
    r"(?P<begin><!-- table: (?P<name>\w+) -->\n)(?P<body>.*?)(?P<end><!-- end -->)", re.S
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write all tables, or say which are not as the baseline has them.

    Returns:
        0; 1 if a figure is missing, or with `--check` if a table is not up to date.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tables", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; 1 if a table is old")
    parser.add_argument("--baseline", type=Path, metavar="FILE", default=BASELINE_FILE)
    options = parser.parse_args(arguments)
    try:
        old = outdated(documents(), read_baseline(options.baseline))
    except SlamGraphError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for path, text in old.items():
        if not options.check:
            Files.write_text(path, [text])
        print(f"{path.relative_to(ROOT)}: {'out of date' if options.check else 'written'}")
    return 1 if options.check and old else 0


def documents() -> list[Path]:
    """The pages that may hold tables."""
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])


def outdated(pages: Sequence[Path], baseline: Baseline) -> dict[Path, str]:
    """The pages whose tables are not those of the baseline, with the text that they should have.

    Raises:
        DataError: if there is no such table, or the baseline lacks a figure of one.
    """
    texts = {page: page.read_text(encoding="utf-8") for page in pages}
    written = {page: with_tables(text, baseline) for page, text in texts.items()}
    return {page: text for page, text in written.items() if text != texts[page]}


def with_tables(text: str, baseline: Baseline) -> str:
    """A page with its tables written from the baseline.

    Raises:
        DataError: if there is no such table, or the baseline lacks a figure of one.
    """
    figures = Figures(baseline)

    def table(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in TABLES:
            raise DataError(f"no table is called '{name}'; known: {', '.join(TABLES)}")
        return found["begin"] + "".join(row + "\n" for row in TABLES[name](figures)) + found["end"]

    return MARKED.sub(table, text)


if __name__ == "__main__":
    raise SystemExit(main())
