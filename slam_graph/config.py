# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Configuration of a run: typed, closed and complete, so that a result can name all its settings.

Defaults are laid under a YAML file, and the file under `key=value` overrides.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BaseModel, BeforeValidator, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.errors import ConfigError
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.loop_closure.loop_config import LoopClosureConfig
from slam_graph.maps.map_config import LocalizationConfig, MapConfig
from slam_graph.settings.base import Settings
from slam_graph.settings.tree import ConfigTree, closest, override, read_tree, validate
from slam_graph.smoothing.smoothing_config import FinalBaConfig

DEFAULT_ALGORITHM = "msckf"

CAMERA_WORDS = {"mono": 1, "stereo": 2, "all": None}


def config_folder() -> Path:
    """The folder `configs`: inside the installed package, or at the top of a source checkout."""
    package = Path(__file__).resolve().parent
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / "algorithms").is_dir():
            return folder
    raise ConfigError(f"no configs/algorithms beside or in {package}; reinstall slam-graph")


def algorithm_names() -> list[str]:
    """Names of the algorithms that come with the package."""
    return sorted(path.stem for path in (config_folder() / "algorithms").glob("*.yaml"))


def algorithm_tree(name: str) -> ConfigTree:
    """The policy table of an algorithm by its name, or from a YAML file by its path.

    Raises:
        ConfigError: if there is no such algorithm or file.
    """
    if Path(name).suffix in (".yaml", ".yml"):
        return read_tree(Path(name))
    if name not in algorithm_names():
        raise ConfigError(f"unknown algorithm '{name}'; {closest(name, algorithm_names())}")
    return read_tree(config_folder() / "algorithms" / f"{name}.yaml")


def is_algorithm_file(path: Path) -> bool:
    """Whether a YAML file holds the table of one algorithm rather than the settings of a run.

    Raises:
        ConfigError: if it cannot be read.
    """
    keys = read_tree(path).values.keys()
    return bool(keys & AlgorithmConfig.model_fields.keys()) and "algorithm" not in keys


def _named_algorithm(value: Any) -> Any:
    """Read the table of an algorithm that is given by its name."""
    return validate(AlgorithmConfig, algorithm_tree(value)) if isinstance(value, str) else value


def _counted_cameras(value: Any) -> Any:
    """Read `mono`, `stereo` and `all` as numbers of cameras."""
    return CAMERA_WORDS.get(value, value) if isinstance(value, str) else value


class LimitsConfig(Settings):
    """Beyond what an estimate counts as diverged."""

    max_speed: float = Field(default=100.0, gt=0)
    """Largest sane speed, m/s."""
    max_position_sigma_m: float = Field(default=100.0, gt=0)
    """Largest standard deviation of the position on any axis."""
    max_gyro_bias: float = Field(default=0.5, gt=0)
    """Largest sane gyroscope bias, rad/s (0.35 is what a data sheet allows the cheapest ones)."""
    max_accel_bias: float = Field(default=3.0, gt=0)
    """Largest sane accelerometer bias, m/s² (1.5 is what a data sheet allows the cheapest ones)."""
    max_rejected_share: float = Field(default=0.6, gt=0, le=1)
    """Largest sane share of the features that the gate rejects …"""
    disagreement_s: float = Field(default=3.0, gt=0)
    """… over so many seconds in which images were tested."""


class RunConfig(Settings):
    """All settings of a run."""

    algorithm: Annotated[
        AlgorithmConfig,
        BeforeValidator(_named_algorithm, json_schema_input_type=str | AlgorithmConfig),
    ] = Field(default_factory=lambda: _named_algorithm(DEFAULT_ALGORITHM))
    """Name of an algorithm, path of its YAML file, or its table of policies."""
    cameras: Annotated[
        int | None, BeforeValidator(_counted_cameras, json_schema_input_type=int | str | None)
    ] = Field(default=None, ge=1)
    """How many cameras to use: mono, stereo, a number; all that the recording has if not said."""
    start_s: float = Field(default=0.0, ge=0)
    """Where to start, in seconds after the first frame."""
    duration_s: float | None = Field(default=None, gt=0)
    """How many seconds to run; to the end if not said."""
    seed: int = Field(default=0, ge=0)
    """Seed of all random numbers."""
    min_coverage: float = Field(default=0.5, ge=0, le=1)
    """Smallest part of the time asked for that the estimate must cover for a run to succeed."""
    overlap: bool = True
    """Whether the front end tracks the next frame in a thread while the back end works on this one;
    the results are the same."""
    frontend: FrontendConfig = FrontendConfig()
    """From images to features."""
    backend: BackendConfig = BackendConfig()
    """From features and IMU to states."""
    final_ba: FinalBaConfig = FinalBaConfig()
    """The bundle adjustment of the whole recording at the end of a run."""
    loop_closure: LoopClosureConfig = LoopClosureConfig()
    """What takes the drift out at the end, where places are seen again."""
    map: MapConfig = MapConfig()
    """Whether the map is saved at the end."""
    localization: LocalizationConfig = LocalizationConfig()
    """How the run is located in a map that was saved before."""
    limits: LimitsConfig = LimitsConfig()
    """When a run is given up as diverged."""

    @field_validator("backend")
    @classmethod
    def _engine_can_calibrate(cls, backend: BackendConfig, info: ValidationInfo) -> BackendConfig:
        """Refuse to estimate a calibration with an engine that cannot."""
        engine = getattr(info.data.get("algorithm"), "engine", "square_root")
        if engine != "square_root" and backend.calibration.anything:
            reason = (
                f"has parameters to calibrate, but engine '{engine}' takes the calibration as it "
                "is; remove 'calibration', or use msckf, swf, okvis, ekf or iekf"
            )
            raise PydanticCustomError("unused", "{reason}", {"reason": reason})
        return backend


def load_config(
    file: Path | str | None = None, overrides: Iterable[str] = (), **options: Any
) -> RunConfig:
    """The settings of a run.

    Args:
        file: YAML file laid over the defaults.
        overrides: `a.b=value` laid over file and options, in their order.
        options: top-level settings by name, laid over the file; None leaves a setting as it is.

    Raises:
        ConfigError: one line that names the file and line, the option or the override at fault.
    """
    tree = ConfigTree({"algorithm": DEFAULT_ALGORITHM})
    if file is not None:
        tree.merge(read_tree(Path(file)))
    said = {
        name: str(value) if isinstance(value, Path) else value
        for name, value in options.items()
        if value is not None
    }
    tree.merge(ConfigTree(said, {(name,): f"option {name}" for name in said}))
    changes = [override(text) for text in overrides]
    for change in changes:  # which algorithm comes first: other overrides may reach into it
        if isinstance(change.values.get("algorithm"), str):
            tree.merge(change)
    _expand_algorithm(tree)
    for change in changes:
        if not isinstance(change.values.get("algorithm"), str):
            tree.merge(change)
    return validate(RunConfig, tree)


def dump_yaml(config: BaseModel) -> str:
    """The settings as YAML that `load_config` reads back, with what each means as a comment."""
    return "\n".join(_yaml_lines(config, config.model_dump(mode="json"), "")) + "\n"


def _expand_algorithm(tree: ConfigTree) -> None:
    """Replace the name of an algorithm by its table, so that overrides can reach into it."""
    name = tree.values["algorithm"]
    if not isinstance(name, str):
        return
    try:
        table = algorithm_tree(name)
    except ConfigError as error:
        where = tree.where.get(("algorithm",))
        raise ConfigError(f"{where}: {error}" if where else str(error)) from error
    tree.values["algorithm"] = table.values
    tree.where |= {("algorithm", *path): place for path, place in table.where.items()}


def _yaml_lines(config: BaseModel, plain: dict[str, Any], indent: str) -> Iterator[str]:
    """The lines of those settings of a table that are in its dump `plain`."""
    for name, info in type(config).model_fields.items():
        if name not in plain:
            continue
        if info.description:
            yield f"{indent}# {' '.join(info.description.split())}"
        value = getattr(config, name)
        if isinstance(value, BaseModel):
            yield f"{indent}{name}:"
            yield from _yaml_lines(value, plain[name], indent + "  ")
        else:
            text = yaml.safe_dump(plain[name], default_flow_style=True, width=10_000)
            yield f"{indent}{name}: {text.removesuffix('...' + chr(10)).strip()}"
