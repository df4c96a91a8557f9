# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Configuration of a run: typed, closed and complete, so that a result can name all its settings.

Later sources replace earlier ones: defaults, algorithm, YAML file, options, overrides.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from slam_graph.backend import AlgorithmConfig, BackendConfig, FinalBaConfig, ObjectsConfig
from slam_graph.errors import ConfigError, closest
from slam_graph.frontend import FrontendConfig
from slam_graph.loop_closure import LoopClosureConfig
from slam_graph.maps import LocalizationConfig, MapConfig
from slam_graph.settings import ConfigTree, Settings, expert

__all__ = [
    "RunConfig",
    "load_config",
]

_DEFAULT_ALGORITHM = "msckf"

_CAMERA_WORDS = {"mono": 1, "stereo": 2, "all": None}


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
        return ConfigTree.read(Path(name))
    if name not in algorithm_names():
        raise ConfigError(f"unknown algorithm '{name}'; {closest(name, algorithm_names())}")
    return ConfigTree.read(config_folder() / "algorithms" / f"{name}.yaml")


def _named_algorithm(value: Any) -> Any:
    """Read the table of an algorithm that is given by its name."""
    return algorithm_tree(value).validated(AlgorithmConfig) if isinstance(value, str) else value


def _counted_cameras(value: Any) -> Any:
    """Read `mono`, `stereo` and `all` as numbers of cameras."""
    return _CAMERA_WORDS.get(value, value) if isinstance(value, str) else value


class LimitsConfig(Settings):
    """Beyond these limits an estimate counts as lost."""

    recovery: bool = expert(default=True)
    """Whether a run whose estimate is lost starts again, as a new segment of the trajectory. It is
    given up when three segments in a row were shorter than five seconds. Without it a run ends
    where its estimate is lost."""

    refuse_wrong_setup: bool = expert(default=True)
    """Whether a run is ended whose calibration or units are certainly wrong, as a diagnosis finds.
    One that waits for its first state, or for another one before a segment has lasted for five
    seconds, is diagnosed after 5 s of the recording, again after 10, 20, … s, and at once after a
    loss. One whose estimate has lasted is diagnosed 24 s after its start, from 6 s on where images
    contradict the IMU or the algorithm cannot say so, as without an IMU (after 12 s as well where
    the first diagnosis did not rule that out), at once where its start had to be corrected, and
    while it waits after a loss, and is ended only if calibration or units are so wrong that the
    estimate is worth nothing. Without it, or without `backend.initialization.check_calibration`,
    the cause is looked for at the end."""

    max_speed: float = expert(default=100.0, gt=0)
    """Largest plausible speed, m/s."""
    max_position_sigma_m: float = expert(default=100.0, gt=0)
    """Largest standard deviation of the position along any axis."""
    max_orientation_sigma_rad: float = expert(default=2.0, gt=0)
    """Largest standard deviation of the orientation about any axis: an angle of which nothing is
    known has 1.8."""
    max_gyro_bias: float = expert(default=0.5, gt=0)
    """Largest plausible gyroscope bias, rad/s (data sheets of cheap sensors allow 0.35)."""
    max_accel_bias: float = expert(default=3.0, gt=0)
    """Largest plausible accelerometer bias, m/s² (data sheets of cheap sensors allow 1.5)."""
    max_rejected_share: float = expert(default=0.6, gt=0, le=1)
    """Largest share of the tested features that the χ² gate may reject over `disagreement_s`."""
    disagreement_s: float = expert(default=3.0, gt=0)
    """Length of the interval over which that share is taken; only time with tested features
    counts."""


class RunConfig(Settings):
    """All settings of a run."""

    algorithm: Annotated[
        AlgorithmConfig,
        BeforeValidator(_named_algorithm, json_schema_input_type=str | AlgorithmConfig),
    ] = Field(default_factory=lambda: _named_algorithm(_DEFAULT_ALGORITHM))
    """Name of an algorithm, path of its YAML file, or its table of policies."""
    cameras: Annotated[
        int | None, BeforeValidator(_counted_cameras, json_schema_input_type=int | str | None)
    ] = Field(default=None, ge=1)
    """How many cameras to use: mono, stereo, a number, or null for all of the recording. Fewer are
    faster; without a second camera the scale comes from the IMU alone."""
    start_s: float = Field(default=0.0, ge=0)
    """Where to start, in seconds after the first frame; skips what cannot be used, such as hands in
    front of the camera."""
    duration_s: float | None = Field(default=None, gt=0)
    """How many seconds to run; null runs to the end. Set it for a quick try."""
    seed: int = Field(default=0, ge=0)
    """Seed of all random numbers. The same seed gives the same result; change it to see how much of
    a result is chance."""
    min_coverage: float = expert(default=0.5, ge=0, le=1)
    """Smallest share of the time asked for that the estimate must cover for a run to succeed."""
    overlap: bool = False
    """Whether reading and front end work in a process of their own, one frame ahead of the back
    end. The results are the same, to the byte. Turn it on for images where more than one core is
    free; it takes some 45 MB. Nothing changes on feature tracks; on one core, and where processes
    cannot be forked (macOS, Windows), both take turns, with a warning."""
    frontend: FrontendConfig = FrontendConfig()
    """From images to features."""
    backend: BackendConfig = BackendConfig()
    """From features and IMU to states."""
    final_ba: FinalBaConfig = FinalBaConfig()
    """The bundle adjustment of the whole recording at the end of a run."""
    loop_closure: LoopClosureConfig = LoopClosureConfig()
    """Recognising places at the end of a run and correcting the drift between visits."""
    map: MapConfig = MapConfig()
    """Whether the map is saved at the end."""
    localization: LocalizationConfig = LocalizationConfig()
    """How the run is located in a map that was saved before."""
    objects: ObjectsConfig = ObjectsConfig()
    """Moving objects: whether and how they are estimated."""
    limits: LimitsConfig = LimitsConfig()
    """When an estimate is lost, and whether the run then starts again."""

    @property
    def object_policies(self) -> AlgorithmConfig:
        """Policies of the estimators of moving objects.

        Raises:
            ConfigError: if `objects.algorithm` is none.
        """
        return load_config(self.objects.algorithm or config_folder() / "objects.yaml").algorithm

    @property
    def used_frontend(self) -> FrontendConfig:
        """Settings of the front end; what moves is kept where objects are estimated."""
        moving = self.frontend.keep_moving or self.objects.enabled
        return self.frontend.model_copy(update={"keep_moving": moving})

    def _facts(self) -> dict[str, object]:
        """The policies of the algorithm, and what differs from the defaults."""
        table = self.algorithm.model_dump(mode="json")
        policies = {
            f"algorithm.{section}": ", ".join(
                f"{name} {value}"
                for name, value in values.items()
                if not _is_expert(getattr(self.algorithm, section), name)
            )
            for section, values in table.items()
            if isinstance(values, dict)
        }
        changed = {
            name: value
            for name, value in self._changed().items()
            if not name.startswith("algorithm")
        }
        first: dict[str, object] = {"algorithm": f"{table['name']} ({table['engine']})"}
        return first | policies | (changed or {"other settings": "their defaults"})

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

    def with_overrides(
        self, overrides: str | Iterable[str] | Mapping[str, Any] = (), **options: Any
    ) -> Self:
        """The same settings with some changed, checked again.

            config.with_overrides({"backend.noise.pixel_sigma": 1.5}, seed=3)

        Args:
            overrides: as for `load_config`.
            options: as for `load_config`.

        Raises:
            ConfigError: if a change does not fit the schema.
        """
        tree = ConfigTree(self.model_dump(exclude_unset=True))
        return _changed(tree, overrides, options).validated(type(self))


def _is_expert(table: Settings, name: str) -> bool:
    """Whether a setting is of the second tier and has its default."""
    info = type(table).model_fields[name]
    return isinstance(info.json_schema_extra, dict) and getattr(table, name) == info.default


def load_config(
    file: Path | str | None = None,
    overrides: str | Iterable[str] | Mapping[str, Any] = (),
    **options: Any,
) -> RunConfig:
    """The settings of a run.

        load_config("msckf", {"backend.noise.pixel_sigma": 1.5}, cameras="mono", seed=3)

    Args:
        file: YAML file that replaces defaults; or the name of an algorithm (`msckf`) or a YAML file
            of one, as for the option `algorithm`.
        overrides: changes in their order, each by its dotted key: a mapping, or texts `a.b=value`
            as for `--set`. They come last.
        options: top-level settings by name, which replace those of the file; None changes nothing.

    Raises:
        ConfigError: one line that names the file and line, the option or the override at fault.
    """
    tree = ConfigTree()
    if file is not None:
        tree = _algorithm_or_settings(file)
    return _changed(tree, overrides, options).validated(RunConfig)


def _algorithm_or_settings(file: Path | str) -> ConfigTree:
    """The settings of a file; or those that choose the algorithm that it names or holds."""
    name = str(file)
    if Path(name).suffix == "" and not Path(name).exists():
        if name in algorithm_names():
            return ConfigTree({"algorithm": name})
        raise ConfigError(
            f"'{name}' is neither a YAML file nor an algorithm; {closest(name, algorithm_names())}"
        )
    tree = ConfigTree.read(Path(file))
    if "algorithm" not in tree.values and tree.values.keys() & AlgorithmConfig.model_fields.keys():
        return ConfigTree({"algorithm": name})
    return tree


def _changed(
    tree: ConfigTree,
    overrides: str | Iterable[str] | Mapping[str, Any],
    options: Mapping[str, Any],
) -> ConfigTree:
    """The tree with options and overrides merged into it, and the algorithm's table expanded."""
    tree.values.setdefault("algorithm", _DEFAULT_ALGORITHM)
    given = {name: _plain(value) for name, value in options.items() if value is not None}
    tree.merge(ConfigTree(given, {(name,): f"option {name}" for name in given}))
    changes = ConfigTree.overrides(overrides)
    for change in changes:  # the algorithm's name first: other overrides may change its table
        if isinstance(change.values.get("algorithm"), str):
            tree.merge(change)
    _expand_algorithm(tree)
    for change in changes:
        if not isinstance(change.values.get("algorithm"), str):
            tree.merge(change)
    return tree


def _plain(value: Any) -> Any:
    """An option as a YAML file would have it."""
    if isinstance(value, BaseModel):
        return value.model_dump(exclude_unset=True)
    return str(value) if isinstance(value, Path) else value


def _expand_algorithm(tree: ConfigTree) -> None:
    """Replace the name of an algorithm by its table, so that overrides can change the table."""
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
