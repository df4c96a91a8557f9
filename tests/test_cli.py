# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The command line as users meet it: real processes, their output and their exit codes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from commands import slam_graph
from limits import HANG_S
from typer.testing import CliRunner

from slam_graph.cli.main import _with_one_command, app
from slam_graph.version import __version__

SLOW_IMPORTS = ("numpy", "gtsam", "cv2", "rerun", "matplotlib", "scipy", "yaml")

COMMANDS = (
    (),
    ("run",),
    ("ape",),
    ("rpe",),
    ("frontend",),
    ("frontend", "run"),
    ("frontend", "compare"),
    ("data",),
    ("data", "info"),
    ("data", "check"),
    ("config",),
    ("config", "dump"),
    ("config", "schema"),
    ("config", "check"),
)

TUM = "0.0 0 0 0 0 0 0 1\n1.0 1 0 0 0 0 0 1\n2.0 1 1 0 0 0 0 1\n3.0 1 1 1 0 0 0 1\n"


def answer(*arguments: str | Path) -> dict:
    """What a command says with `--json`, without the cost of a process of its own."""
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    assert done.exit_code == 0
    return json.loads(done.stdout)


def one_line(stderr: str) -> str:
    lines = stderr.splitlines()
    assert len(lines) == 1, stderr
    return lines[0]


def test_help_of_every_command_comes_without_slow_imports() -> None:
    script = f"""
import sys, contextlib, io
from slam_graph.cli.main import app
for command in {COMMANDS!r}:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        app([*command, "--help"], standalone_mode=False)
    assert "Usage: " in out.getvalue(), command
    loaded = [name for name in {SLOW_IMPORTS!r} if name in sys.modules]
    assert not loaded, (command, loaded)
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=HANG_S)


def test_importing_the_package_is_free_and_its_names_are_there() -> None:
    script = f"""
import sys, slam_graph
assert not [name for name in {SLOW_IMPORTS!r} if name in sys.modules]
for name in slam_graph.__all__:
    assert getattr(slam_graph, name) is not None
assert set(dir(slam_graph)) == set(slam_graph.__all__)
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=HANG_S)


def test_little_is_imported_before_signals_are_minded() -> None:
    script = "import sys, slam_graph.cli.launch; assert 'typing' not in sys.modules"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=HANG_S)


def test_options_are_made_for_the_command_that_is_asked_for() -> None:
    alone = _with_one_command("run")
    assert [command.name for command in alone.registered_commands] == ["run"]
    assert not alone.registered_groups
    assert all(_with_one_command(*first) is app for first in ([], ["--version"], ["rnu"]))


def test_version() -> None:
    done = slam_graph("--version")
    assert (done.returncode, done.stdout) == (0, f"slam-graph {__version__}\n")


@pytest.mark.parametrize(
    "arguments",
    [
        ("run",),
        ("run", "demo", "--nonsense"),
        ("run", "demo", "--rerun", "maybe"),
        ("nonsense",),
        ("ape", "a", "b", "-a", "--align", "yaw"),
        ("rpe", "a", "b", "-u", "x"),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments: tuple[str, ...]) -> None:
    done = slam_graph(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--set", "backend.noize.pixel_sigma=1"), "did you mean 'noise'?"),
        (("--set", "seed=minus"), "--set seed=minus: seed: "),
        (("--algorithm", "mscfk"), "did you mean 'msckf'?"),
        (("--cameras", "many"), "option cameras: cameras: "),
        (("--config", "missing.yaml"), "missing.yaml: cannot read configuration"),
        (("--duration", "-1"), "option duration_s: duration_s: "),
    ],
)
def test_a_fault_in_the_configuration_is_exit_code_2(
    tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    done = slam_graph("run", "demo", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert message in one_line(done.stderr)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "command", [("run",), ("data", "info"), ("data", "check"), ("ape", "missing")]
)
def test_missing_data_is_exit_code_1(tmp_path: Path, command: tuple[str, ...]) -> None:
    done = slam_graph(*command, "missing", cwd=tmp_path)
    assert done.returncode == 1
    assert one_line(done.stderr).startswith("error: missing")
    assert list(tmp_path.iterdir()) == []


def test_config_dump_is_a_configuration(tmp_path: Path) -> None:
    dumped = slam_graph("config", "dump", "--set", "seed=5", "--algorithm", "swf")
    assert dumped.returncode == 0
    (tmp_path / "all.yaml").write_text(dumped.stdout)
    again = slam_graph("config", "dump", "--config", tmp_path / "all.yaml")
    assert again.stdout == dumped.stdout
    checked = slam_graph("config", "check", tmp_path / "all.yaml")
    assert (checked.returncode, checked.stdout) == (0, f"{tmp_path}/all.yaml: ok\n")
    (tmp_path / "all.yaml").write_text(dumped.stdout.replace("pixel_sigma", "pixel_sigmo"))
    faulty = slam_graph("config", "check", tmp_path / "all.yaml")
    assert faulty.returncode == 2
    assert "unknown key 'backend.noise.pixel_sigmo'" in one_line(faulty.stderr)


def test_a_file_of_an_algorithm_is_checked_as_one(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("name: own\ncost:\n  max_past_poses: 7\n")
    assert slam_graph("config", "check", own).stdout.endswith("ok\n")
    own.write_text("name: own\ncost:\n  max_past_pose: 7\n")
    faulty = slam_graph("config", "check", own)
    assert faulty.returncode == 2
    line = one_line(faulty.stderr)
    assert f"{own}:3" in line
    assert "max_past_poses" in line


def test_config_schema_knows_every_setting() -> None:
    schema = json.loads(slam_graph("config", "schema").stdout)
    assert "algorithm" in schema["properties"]
    assert schema["additionalProperties"] is False
    assert all(setting.get("description") for setting in schema["properties"].values())


def test_ape_and_rpe_print_tables_and_json(tmp_path: Path) -> None:
    for name, text in (("truth", TUM), ("guess", TUM.replace("1.0 1 0 0", "1.0 1.5 0 0"))):
        (tmp_path / f"{name}.tum").write_text(text)
    files = (tmp_path / "truth.tum", tmp_path / "guess.tum")
    table = slam_graph("ape", *files)
    assert table.returncode == 0
    assert table.stdout.splitlines()[0].startswith("APE trans_part [m], alignment: none, 4 shared")
    assert "  max     0.500000" in table.stdout.splitlines()
    parsed = answer("ape", *files, "-r", "full")
    assert parsed["statistics"]["max"] == pytest.approx(0.5)
    assert (parsed["relation"], parsed["poses"]) == ("full", 4)
    steps = answer("rpe", *files, "-d", "2", "--all_pairs")
    assert (steps["errors"], steps["delta"]) == (2, 2.0)
    assert answer("ape", *files, "-a", "-s")["alignment"] == "sim3"
    assert answer("ape", *files, "-s")["alignment"] == "scale"
    assert answer("rpe", *files, "--align", "yaw")["alignment"] == "yaw"
    assert answer("ape", *files, "--t_max_diff", "0.01")["poses"] == 4


def test_a_malformed_trajectory_is_exit_code_1(tmp_path: Path) -> None:
    (tmp_path / "truth.tum").write_text(TUM)
    (tmp_path / "bad.tum").write_text(TUM + "4.0 1 x 1 0 0 0 1\n")
    done = slam_graph("ape", "truth.tum", "bad.tum", cwd=tmp_path)
    assert done.returncode == 1
    assert "bad.tum:5" in one_line(done.stderr)


def test_data_info_of_the_demo() -> None:
    info = answer("data", "info", "demo")
    assert info["frames"] == 601
    assert info["content"] == "tracks"
    assert "frames" in slam_graph("data", "info", "demo").stdout


def test_data_check_of_the_demo() -> None:
    assert answer("data", "check", "demo")["errors"] == 0
