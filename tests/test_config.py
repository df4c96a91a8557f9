# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Configurations are typed, closed, complete, and faults are said with their place."""

from pathlib import Path

import pytest
import yaml

from slam_graph.config import RunConfig, algorithm_names, config_folder, load_config
from slam_graph.errors import ConfigError
from slam_graph.settings.tree import ConfigTree


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "my.yaml"
    path.write_text(text)
    return path


def test_defaults_are_complete_and_survive_a_round_trip(tmp_path: Path) -> None:
    config = load_config()
    assert config == RunConfig()
    assert load_config(write(tmp_path, config.as_yaml())) == config


def test_dump_explains_every_setting() -> None:
    text = load_config().as_yaml()
    assert "# Standard deviation of a feature observation, in pixels." in text
    assert yaml.safe_load(text)["backend"]["noise"]["pixel_sigma"] == 1.0


@pytest.mark.parametrize("name", algorithm_names())
def test_every_algorithm_survives_a_round_trip(tmp_path: Path, name: str) -> None:
    """What its engine does not use is not written, as it would be refused when it is read."""
    config = load_config(algorithm=name)
    text = config.as_yaml()
    assert load_config(write(tmp_path, text)) == config
    own = config.algorithm.engine == "square_root"
    assert ("cost" in yaml.safe_load(text)["algorithm"]) == own
    assert ("smoother" in yaml.safe_load(text)["algorithm"]) != own
    assert RunConfig.model_validate_json(config.model_dump_json()) == config


@pytest.mark.parametrize("name", algorithm_names())
def test_every_algorithm_that_ships_loads_under_its_name(name: str) -> None:
    assert load_config(algorithm=name).algorithm.name == name


def test_file_lies_over_defaults_options_over_file_and_overrides_over_all(tmp_path: Path) -> None:
    path = write(tmp_path, "seed: 1\nstart_s: 1.0\nbackend:\n  noise:\n    pixel_sigma: 2.0\n")
    config = load_config(path, ["seed=3"], start_s=2.0, seed=2)
    assert (config.seed, config.start_s) == (3, 2.0)
    assert config.backend.noise.pixel_sigma == 2.0
    assert config.backend.noise.gravity == load_config().backend.noise.gravity


def test_overrides_have_the_types_of_yaml() -> None:
    config = load_config(
        overrides=[
            "backend.noise.pixel_sigma=1.5e-1",
            "backend.zero_velocity.enabled=false",
            "frontend.grid=[4, 3]",
            "algorithm.cost.max_past_poses=12",
        ]
    )
    assert config.backend.noise.pixel_sigma == 0.15
    assert config.backend.zero_velocity.enabled is False
    assert config.frontend.grid == (4, 3)
    assert config.algorithm.cost.max_past_poses == 12


def test_an_override_of_the_algorithm_comes_before_those_that_reach_into_it() -> None:
    other = next(name for name in algorithm_names() if name != "msckf")
    config = load_config(overrides=["algorithm.cost.max_past_poses=12", f"algorithm={other}"])
    assert (config.algorithm.name, config.algorithm.cost.max_past_poses) == (other, 12)


def test_an_algorithm_may_be_a_table_or_a_file_of_ones_own(tmp_path: Path) -> None:
    table = "name: mine\ncost:\n  max_past_poses: 15\n"
    path = tmp_path / "mine.yaml"
    path.write_text(table)
    from_file = load_config(algorithm=str(path)).algorithm
    inline = "algorithm:\n" + "".join(f"  {line}\n" for line in table.splitlines())
    from_table = load_config(write(tmp_path, inline)).algorithm
    assert from_file == from_table
    assert (from_file.name, from_file.cost.max_past_poses) == ("mine", 15)


@pytest.mark.parametrize(("word", "count"), [("mono", 1), ("stereo", 2), ("3", 3), ("all", None)])
def test_cameras_are_counted_or_named(word: str, count: int | None) -> None:
    assert load_config(cameras=word).cameras == count


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed: 1\nbackend:\n  noize: {}\n", r"my.yaml:3: unknown key 'backend.noize'; .*'noise'"),
        ("sead: 1\n", r"my.yaml:1: unknown key 'sead'; did you mean 'seed'\?"),
        ("seed: 1\nbackend:\n  noise:\n    pixel_sigma: -1\n", r"my.yaml:4: backend.noise.pixel_s"),
        ("seed: many\n", r"my.yaml:1: seed: .*got 'many'"),
        ("seed: 1\nseed: 2\n", r"my.yaml:2: key 'seed' is there twice"),
        ("seed: [1\n", r"my.yaml:\d: not YAML"),
        ("- 1\n", r"my.yaml:1: expected a table"),
        ("algorithm: mscfk\n", r"my.yaml:1: unknown algorithm 'mscfk'; did you mean 'msckf'\?"),
        ("algorithm:\n  cost: {}\n", r"my.yaml:1: key 'algorithm.name' is missing"),
        (
            "algorithm:\n  name: a\n  engine: isam2\n  cost: {}\n",
            r"my.yaml:4: 'algorithm.cost' is not used by engine 'isam2', whose settings are in "
            r"smoother; remove it, or set algorithm.engine to square_root$",
        ),
        (
            "algorithm:\n  name: a\n  smoother: {lag_s: 2.0}\n",
            r"my.yaml:3: 'algorithm.smoother' is not used by engine 'square_root', whose settings "
            r"are in cost, gauss_newton, marginalization; remove it, or set algorithm.engine to",
        ),
        (
            "algorithm:\n  name: a\n  engine: isam2\n  smoother: {max_iterations: 2}\n",
            r"my.yaml:4: 'algorithm.smoother' has 'max_iterations', which engine 'isam2' does not",
        ),
        ("algorithm:\n  name: a\n  cots: {}\n", r"my.yaml:3: unknown key 'algorithm.cots'"),
    ],
)
def test_faults_name_file_and_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(write(tmp_path, text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed", "--set seed: expected key=value"),
        ("=1", "expected key=value"),
        ("a..b=1", "expected key=value"),
        ("seed=[", "--set seed=.: the value is not YAML"),
        ("sead=1", "--set sead=1: unknown key 'sead'; did you mean 'seed'"),
        ("seed.deep=1", "--set seed.deep=1: seed: "),
        (
            "algorithm.smoother.lag_s=2",
            "--set algorithm.smoother.lag_s=2: 'algorithm.smoother' is not",
        ),
        ("algorithm=nothing", "--set algorithm=nothing: unknown algorithm"),
    ],
)
def test_faults_name_the_override(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(overrides=[text])


@pytest.mark.parametrize("key", ["noise.imu_gap_scale", "initialization.motion_prior"])
def test_a_setting_that_became_a_constant_says_where_it_is(key: str) -> None:
    with pytest.raises(ConfigError, match=rf"'backend.{key}' is a constant now: \w+ in backend/"):
        load_config(overrides=[f"backend.{key}=1"])


def test_a_missing_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot read configuration"):
        load_config(tmp_path / "none.yaml")


def test_a_fault_in_the_file_of_an_algorithm_names_that_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("name: mine\ncost:\n  max_past_pose: 5\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml:3: .*did you mean 'max_past_poses'"):
        load_config(algorithm=str(path))


def test_an_empty_file_changes_nothing(tmp_path: Path) -> None:
    assert load_config(write(tmp_path, "# nothing\n")) == load_config()


def test_merging_leaves_the_parts_as_they_were() -> None:
    first, second = ConfigTree.override("a.b=1"), ConfigTree.override("a.c=2")
    first.merge(second)
    assert first.values == {"a": {"b": 1, "c": 2}}
    assert second.values == {"a": {"c": 2}}
    assert first.locate(("a", "c", "deeper")) == "--set a.c=2"


def test_configs_are_found() -> None:
    assert ConfigTree.read(config_folder() / "algorithms" / "msckf.yaml").values["name"] == "msckf"


def test_an_old_word_names_the_new_one() -> None:
    with pytest.raises(ConfigError, match="'window' is 'every_step' now"):
        load_config(overrides=["algorithm.cost.features=window"])
