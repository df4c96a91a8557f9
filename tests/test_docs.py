# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The documents: links lead somewhere, named files exist, the list of settings is current."""

import importlib.util
import re
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from test_questions import CODE, file_of, names

from slam_graph.cli.help_texts import EXAMPLES
from slam_graph.config import algorithm_names, load_config
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr
from slam_graph.datasets.dataset_registry import DATASETS, open_dataset
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_input import Status

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
THEORY = sorted((ROOT / "docs" / "theory").glob("*.md"))

LINK = re.compile(r"\]\(([^)#\s]+)(?:#([^)\s]+))?\)")
SOURCE = re.compile(r"`((?:[a-z_]+/)+[a-z_0-9]+\.(?:py|yaml|md|ipynb|png))`")

KIND = re.compile(
    r"(?:\.warn\(|warn_on_failure\([\w.]+,|diagnostics\.counts\[|Fault\(|kind = )\s*\"([a-z_]+)\""
)

MOST_PLAIN_SETTINGS = 45
"""Settings that a user can sensibly choose; all others are expert settings or constants."""


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def anchors(page: Path) -> set[str]:
    """The anchors that a forge makes of the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


def leads_nowhere(page: Path, target: str, anchor: str) -> bool:
    path = page.parent / target
    return not path.exists() or bool(anchor and anchor not in anchors(path))


def test_links_lead_somewhere() -> None:
    broken = [
        f"{name(page)}: {target}#{anchor}"
        for page in PAGES
        for target, anchor in LINK.findall(page.read_text(encoding="utf-8"))
        if not target.startswith(("https://", "http://")) and leads_nowhere(page, target, anchor)
    ]
    assert not broken


def test_sources_that_are_named_exist() -> None:
    """A path in backquotes is meant from the top of the checkout, or from the package."""
    missing = [
        f"{name(page)}: {path}"
        for page in PAGES
        for path in SOURCE.findall(page.read_text(encoding="utf-8"))
        if not (ROOT / path).is_file() and not (ROOT / "slam_graph" / path).is_file()
    ]
    assert not missing


def links_of(page: str) -> set[str]:
    return {target for target, _ in LINK.findall((ROOT / "docs" / page).read_text())}


def test_every_page_is_in_the_index_and_every_notebook_among_the_tutorials() -> None:
    docs = ROOT / "docs"
    pages = {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")} - {"index.md"}
    assert not (pages | {"../README.md", "../CONTRIBUTING.md"}) - links_of("index.md")
    notebooks = {f"../notebooks/{path.name}" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert not notebooks - links_of("tutorials.md")


def test_every_page_is_in_the_navigation_of_the_site() -> None:
    """Notebooks and the pages at the top of the checkout are added when the site is built."""
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    docs = ROOT / "docs"
    pages = sorted(path.relative_to(docs).as_posix() for path in docs.rglob("*.md"))
    assert sorted(re.findall(r"([\w/]+\.md)$", nav, re.MULTILINE)) == pages


@pytest.mark.parametrize("page", THEORY, ids=lambda page: page.stem)
def test_functions_that_hold_the_equations_exist(page: Path) -> None:
    named = CODE.findall(page.read_text(encoding="utf-8"))
    missing = [
        f"{path}:{function}"
        for path, function in named
        if (file := file_of(path)) is None or (function and function not in names(file))
    ]
    assert not missing
    assert len(named) >= (1 if page.stem == "index" else 6)


def test_every_group_of_entry_points_is_in_the_documents() -> None:
    sources = "".join(path.read_text() for path in (ROOT / "slam_graph").rglob("*.py"))
    groups = set(re.findall(r"Registry\(\s*\"(slam_graph\.[a-z_]+)\"", sources))
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert not {group for group in groups if f"| `{group}` |" not in page}


def generator() -> Any:
    """The script that writes the pages of settings, as a module."""
    script = ROOT / "docs" / "generate_configuration.py"
    spec = importlib.util.spec_from_file_location("generate_configuration", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_lists_of_settings_are_current() -> None:
    module = generator()
    for path, page in ((module.PAGE, module.page()), (module.EXPERT_PAGE, module.expert_page())):
        assert path.read_text(encoding="utf-8") == page, f"{path.name}: run `make docs`"


def test_the_settings_that_matter_exist_and_are_plain() -> None:
    module = generator()
    matter = [advice.setting for advice in module.TEN_THAT_MATTER]
    plain = {*module.plain_settings().values(), "algorithm"}  # which is a table, or its name
    assert len(matter) == len(set(matter)) == 10
    assert not set(matter) - plain


def test_plain_settings_are_few() -> None:
    plain = generator().plain_settings()
    assert len(plain) <= MOST_PLAIN_SETTINGS, f"{len(plain)} plain settings: {sorted(plain)}"


def test_every_kind_of_warning_is_explained() -> None:
    kinds = set()
    for path in (ROOT / "slam_graph").rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        kinds |= set(KIND.findall(source))
    assert {"imu_gap", "image_unreadable", "feature_rejected_by_gate", "map_failed"} <= kinds
    page = (ROOT / "docs" / "datasets.md").read_text(encoding="utf-8")
    explained = set(re.findall(r"^\| `([a-z_]+)` \|", page, re.MULTILINE))
    assert not kinds - explained


def test_every_status_and_its_exit_code_is_in_the_documents() -> None:
    page = (ROOT / "docs" / "exit_codes.md").read_text(encoding="utf-8")
    codes, statuses = page.split("## Statuses")
    assert re.findall(r"^\| `([a-z_]+)` \|", statuses, re.MULTILINE)
    for status in get_args(Status):
        assert f"\n| `{status}` |" in statuses
        assert codes.count(f"`{status}`") == 1


def test_every_format_is_in_the_documents() -> None:
    page = (ROOT / "docs" / "datasets.md").read_text(encoding="utf-8")
    table = page[page.index("## Formats") : page.index("###")]
    assert re.findall(r"^\| `([a-z_]+)` \|", table, re.MULTILINE) == list(DATASETS)


def test_the_algorithm_of_the_documents_runs(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "algorithms.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```yaml\n(.+?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 1
    path = tmp_path / "own.yaml"
    path.write_text(blocks[0], encoding="utf-8")
    config = load_config(algorithm=path, overrides=["duration_s=8"])
    assert config.algorithm not in [
        load_config(algorithm=name).algorithm for name in algorithm_names()
    ]
    result = run(open_dataset("demo"), config)
    result.check()
    assert len(result.history) > 100


def test_the_recipe_for_phones_makes_one_table(tmp_path: Path, monkeypatch: Any) -> None:
    """The script of the page, and the calibration that it shows."""
    page = (ROOT / "docs" / "own_data.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"^```python\n(.+?)^```", page, re.MULTILINE | re.DOTALL)
    (chain,) = re.findall(r"^```yaml\n(.+?)^```", page, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    stamps = np.arange(5)[:, None] * 5_000_000 + 123_456_789_000
    rates, forces = np.ones((5, 3)), np.arange(5)[:, None] + [0.0, 1.0, 2.0]
    np.savetxt("walk_gyro.csv", np.hstack([rates, stamps + 1_000_000]), "%.9f", ",")
    np.savetxt("walk_accel.csv", np.hstack([forces, stamps]), "%.9f", ",")
    exec(compile(script, "own_data.md", "exec"), {})
    table = np.loadtxt("walk.imu.csv", delimiter=",")
    assert np.array_equal(table[:, 0], stamps[:4, 0] + 1_000_000)  # the last has no force after it
    assert np.allclose(table[:, 1:4], 1.0)
    assert np.allclose(table[:, 4:], forces[:4] + 0.2)
    Path("phone.yaml").write_text(chain, encoding="utf-8")
    (camera,) = read_kalibr("phone.yaml").cameras
    assert not camera.rotation_known


def test_the_reference_of_commands_has_no_markup_of_the_terminal() -> None:
    """Examples are blocks of commands there."""
    pytest.importorskip("mkdocs")
    place = ROOT / "docs" / "hooks" / "generated_reference.py"
    spec = importlib.util.spec_from_file_location("generated_reference", place)
    assert spec is not None
    assert spec.loader is not None
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    text = hook.commands()
    assert text.count("**Examples**:\n\n```sh\nslam-graph ") == len(EXAMPLES)
    assert not re.search(r"\[/?(bold|cyan|dim|red|green|yellow)\]", text)
