# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""docs/questions.md answers with files, functions and settings that exist."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest
from groups import slow
from limits import HANG_S
from pydantic import BaseModel

from slam_graph.config import RunConfig

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "docs" / "questions.md").read_text(encoding="utf-8")

CODE = re.compile(r"`([\w/]+\.py)(?::([A-Za-z_][\w.]*))?`")
SETTING = re.compile(
    r"`(?:--set )?((?:algorithm|backend|frontend|limits|final_ba|loop_closure|map|localization)"
    r"(?:\.[a-z_]+)+)(?:=[\w.]+)?`"
)


@cache
def names(path: Path) -> frozenset[str]:
    """Names that a module defines, those of its classes with the class before them."""
    return frozenset(_names(ast.parse(path.read_text(encoding="utf-8")).body, ""))


def _names(body: Iterable[ast.stmt], prefix: str) -> Iterable[str]:
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield prefix + node.name
            if isinstance(node, ast.ClassDef):
                yield from _names(node.body, f"{prefix}{node.name}.")
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (prefix + target.id for target in targets if isinstance(target, ast.Name))


def file_of(path: str) -> Path | None:
    candidates = (ROOT / "slam_graph" / path, ROOT / path)
    return next((found for found in candidates if found.is_file()), None)


def test_files_and_functions_exist() -> None:
    answers = CODE.findall(TEXT)
    assert len(answers) > 40
    missing = []
    for path, name in answers:
        file = file_of(path)
        if file is None or (name and name not in names(file)):
            missing.append(f"{path}:{name}")
    assert not missing


def exists(setting: str) -> bool:
    table: type[BaseModel] | None = RunConfig
    for key in setting.split("."):
        if table is None or key not in table.model_fields:
            return False
        annotation = table.model_fields[key].annotation
        is_table = isinstance(annotation, type) and issubclass(annotation, BaseModel)
        table = annotation if is_table else None
    return True


def test_settings_exist() -> None:
    settings = set(SETTING.findall(TEXT))
    assert {"backend.noise.gravity", "backend.gating.confidence"} <= settings
    assert not sorted(setting for setting in settings if not exists(setting))


@pytest.mark.parametrize("page", ["questions.md", slow("extending.md")])
def test_the_pose_selection_of_the_page_runs(page: str) -> None:
    """In a process of its own, as a name that is registered stays."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.+?)^```", text, re.MULTILINE | re.DOTALL)
    (override,) = re.findall(r'overrides=\["(algorithm\.cost\.past_poses=\w+)"\]', text)
    use = f"""
import slam_graph as sg
config = sg.load_config(overrides=["{override}", "duration_s=8"])
result = sg.run(sg.open_dataset("demo"), config)
result.check()
print(len(result.history))
"""
    done = subprocess.run(
        [sys.executable, "-c", block + use], capture_output=True, text=True, timeout=HANG_S
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) > 100


def test_a_name_that_does_not_exist_is_noticed() -> None:
    file = file_of("backend/cost/gating.py")
    assert file is not None
    assert "threshold" in names(file)
    assert "Gate" in names(file)
    assert "no_such_function" not in names(file)
    assert not exists("backend.noise.no_such_setting")
    assert file_of("backend/no_such_file.py") is None
