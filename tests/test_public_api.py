# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The public names: imported late, documented, and as easy to use as the documents say."""

import inspect
import re
import subprocess
import sys
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import pytest
from groups import slow

import slam_graph as sg
from slam_graph.config import algorithm_names
from slam_graph.errors import ConfigError

ROOT = Path(__file__).parent.parent
HEAVY = ("gtsam", "numpy", "cv2", "scipy", "pydantic", "rerun", "matplotlib")

NAMES = sorted(set(sg.__all__) - {"__version__"})
FUNCTIONS = [name for name in NAMES if isinstance(getattr(sg, name), FunctionType)]
CLASSES = [name for name in NAMES if isinstance(getattr(sg, name), type)]


def test_importing_the_package_imports_nothing_heavy() -> None:
    code = f"import sys, slam_graph; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_a_function_or_a_class_with_a_docstring() -> None:
    assert sorted(FUNCTIONS + CLASSES) == NAMES
    assert all((getattr(sg, name).__doc__ or "").strip() for name in NAMES)


def test_every_parameter_of_a_public_function_is_documented() -> None:
    undocumented = []
    for name in FUNCTIONS:
        function = getattr(sg, name)
        explained = re.findall(r"^ +\**([\w, ]+?)(?: \(.*\))?:", function.__doc__ or "", re.M)
        known = {word.strip() for words in explained for word in words.split(",")}
        parameters = inspect.signature(function).parameters
        undocumented += [
            f"{name}: {parameter}" for parameter in parameters if parameter not in known
        ]
    assert not undocumented


def test_public_functions_take_paths_as_text_too() -> None:
    strict = [
        f"{name}: {parameter.name}: {parameter.annotation}"
        for name in FUNCTIONS
        for parameter in inspect.signature(getattr(sg, name)).parameters.values()
        if "Path" in str(parameter.annotation) and "str" not in str(parameter.annotation)
    ]
    assert not strict


def test_a_config_is_changed_by_dotted_keys() -> None:
    config = sg.load_config("msckf", overrides={"backend.noise.pixel_sigma": 1.5}, seed=3)
    assert (config.algorithm.name, config.backend.noise.pixel_sigma, config.seed) == (
        "msckf",
        1.5,
        3,
    )
    other = config.with_overrides({"backend.noise.pixel_sigma": 2.0}, algorithm="okvis")
    assert (other.algorithm.name, other.backend.noise.pixel_sigma, other.seed) == ("okvis", 2.0, 3)
    assert other == sg.load_config("okvis", ["backend.noise.pixel_sigma=2.0"], seed=3)
    assert config.with_overrides() == config
    assert config.with_overrides("seed=4").seed == 4


@pytest.mark.parametrize("name", algorithm_names())
def test_any_algorithm_can_be_changed_to_any_other(name: str) -> None:
    assert sg.load_config(name) == sg.load_config(algorithm=name)
    assert sg.load_config("ekf").with_overrides(algorithm=name) == sg.load_config(name)
    assert sg.load_config(name).with_overrides(algorithm="ekf") == sg.load_config("ekf")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("mscfk",), "neither a YAML file nor an algorithm; did you mean 'msckf'"),
        ((None, {"backend.noize.pixel_sigma": 1}), "unknown key 'backend.noize'; did you mean"),
        ((None, {"backend..x": 1}), "expected a key"),
        ((None, {"seed": -1}), "override seed: seed: "),
    ],
)
def test_mistakes_in_settings_get_a_hint(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        sg.load_config(*arguments)


def test_a_file_of_an_algorithm_is_a_configuration_too(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("name: mine\ncost:\n  max_past_poses: 5\n")
    assert sg.load_config(path) == sg.load_config(algorithm=path)
    assert sg.load_config(str(path)).algorithm.name == "mine"


@pytest.mark.parametrize("page", ["configuration.md", slow("results.md")])
def test_the_python_of_the_documents_runs(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.+?)^```", text, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(block, names)
    result = names["result"] if page == "configuration.md" else names["saved"]
    assert result.status == "ok"


@pytest.fixture(scope="module")
def result() -> sg.RunResult:
    found = sg.run("demo", algorithm="swf", duration_s=7.0, overrides={"min_coverage": 0.1})
    found.check()
    return found


def test_a_recording_is_run_by_its_name(result: sg.RunResult) -> None:
    assert result.config == sg.load_config("swf", {"min_coverage": 0.1}, duration_s=7.0)
    again = sg.run(sg.open_dataset("demo"), result.config)
    np.testing.assert_array_equal(again.trajectory.positions, result.trajectory.positions)


def test_representations_are_short(result: sg.RunResult, tmp_path: Path) -> None:
    result.save(tmp_path)
    found = sg.load_result(tmp_path)
    for shown in (result, found, result.trajectory, found.trajectory, result.history):
        assert len(repr(shown)) < 120
        assert "array" not in repr(shown)
    assert repr(result).replace("RunResult", "SavedRun") == repr(found)


def test_a_trajectory_becomes_columns(result: sg.RunResult) -> None:
    columns = result.trajectory.as_dict()
    assert len(columns) == 1 + 3 + 4 + 3 + 3 + 3
    assert all(column.shape == (len(result.trajectory),) for column in columns.values())
    np.testing.assert_array_equal(columns["position_z_m"], result.trajectory.positions[:, 2])
    np.testing.assert_array_equal(columns["quaternion_w"], result.trajectory.quaternions[:, 3])
    pandas = pytest.importorskip("pandas")
    assert pandas.DataFrame(columns).shape == (len(result.trajectory), 17)
