# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A comparison: record every source under every seed, run every algorithm on that, report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from slam_graph.config import RunConfig
from slam_graph.errors import ConfigError
from slam_graph.experiment.executors import Executor
from slam_graph.experiment.sources import Source
from slam_graph.experiment.tasks import RecordTask, RunTask, Task
from slam_graph.smoothing.smoothing_config import FinalBaConfig

WITHOUT_FEJ = "_no_fej"
"""What the name of an algorithm without first-estimates Jacobians ends in."""

Told = Callable[[Task, str | None, int, int], None]
"""Is told of each task that has ended, why it failed if it did, and how many of how many have."""


@dataclass
class Comparison:
    """All tasks of a comparison, and what became of them.

    Attributes:
        folder: of all files.
        runs: of all algorithms, on all data, for all seeds, in the order of the tables.
        failures: why a task could not be done, by its name; a run that diverged is not one.
        skipped: how many tasks had been done before.
    """

    folder: Path
    runs: list[RunTask]
    failures: dict[str, str] = field(default_factory=dict)
    skipped: int = 0


def load_configs(
    algorithms: Sequence[str], load: Callable[[str], RunConfig]
) -> dict[str, RunConfig]:
    """The settings under each algorithm, by the name that the algorithm gives itself.

    Args:
        algorithms: names, or paths of YAML files.
        load: gives the settings for one of these.

    Raises:
        ConfigError: if two have the same name, or there are none.
    """
    configs: dict[str, RunConfig] = {}
    for algorithm in algorithms:
        config = load(algorithm)
        name = config.algorithm.name
        if name in configs:
            raise ConfigError(f"--algorithms: '{name}' is there twice; give one another name")
        configs[name] = config
    if not configs:
        raise ConfigError("--algorithms: none is named")
    return configs


def with_variants(configs: Mapping[str, RunConfig]) -> dict[str, RunConfig]:
    """The settings, each followed by the same without first-estimates Jacobians.

    GTSAM's smoothers have no such Jacobians, and so no variant.
    """
    both: dict[str, RunConfig] = {}
    for name, config in configs.items():
        both[name] = config
        algorithm = config.algorithm
        if algorithm.engine == "square_root" and algorithm.marginalization.first_estimates:
            policy = algorithm.marginalization.model_copy(update={"first_estimates": False})
            changed = {"name": f"{name}{WITHOUT_FEJ}", "marginalization": policy}
            variant = config.model_copy(update={"algorithm": algorithm.model_copy(update=changed)})
            both[variant.algorithm.name] = variant
    return both


def compare(
    sources: Sequence[Source],
    configs: Mapping[str, RunConfig],
    seeds: int,
    folder: Path,
    executor: Executor,
    told: Told,
) -> Comparison:
    """Do what has not been done yet. An interruption loses only the tasks that are under way.

    Args:
        sources: what to run on.
        configs: settings under each algorithm, which differ in nothing else.
        seeds: how many; 0, 1, … are taken. Where a seed changes nothing there is only one.
        folder: of tracks and results.
        executor: does the tasks.
        told: is told of the progress.
    """
    folder = folder.resolve()
    recordings, runs = plan(sources, configs, seeds, folder)
    comparison = Comparison(folder, runs)
    _do(comparison, recordings, executor, told)
    _do(comparison, [task for task in runs if task.tracks.is_dir()], executor, told)
    return comparison


def plan(
    sources: Sequence[Source], configs: Mapping[str, RunConfig], seeds: int, folder: Path
) -> tuple[list[RecordTask], list[RunTask]]:
    """All tasks: one recording for each source and seed, and on it a run of every algorithm."""
    recordings: list[RecordTask] = []
    runs: list[RunTask] = []
    common = next(iter(configs.values()))
    replay = {"start_s": 0.0, "duration_s": None, "cameras": None}  # the recording is cut already
    alike = FinalBaConfig(enabled=False)  # it would end all of them in much the same
    for source in sources:
        for seed in range(seeds if source.random else 1):
            record = RecordTask(source=source, seed=seed, config=common, root=folder / "tracks")
            recordings.append(record)
            runs += [
                RunTask(
                    data=source.name,
                    algorithm=name,
                    seed=seed,
                    config=_adapted(config, source).model_copy(
                        update={**replay, "seed": seed, "final_ba": alike}
                    ),
                    tracks=record.folder,
                    result=folder / "runs" / f"{source.name}_seed{seed}" / f"{name}.json",
                )
                for name, config in configs.items()
            ]
    return recordings, runs


def _adapted(config: RunConfig, source: Source) -> RunConfig:
    """The settings for a source: a start with an error of its covariance keeps that covariance.

    To take its position and yaw as the definition of the world would call the part of its error in
    these zero, and every NEES would be too large by it.
    """
    if source.simulation is None or not source.simulation.known_start.error:
        return config
    start = config.backend.initialization.model_copy(update={"fix_gauge": False})
    backend = config.backend.model_copy(update={"initialization": start})
    return config.model_copy(update={"backend": backend})


def _do(comparison: Comparison, tasks: Sequence[Task], executor: Executor, told: Told) -> None:
    """Do those tasks that are not done."""
    missing = [task for task in tasks if not task.is_done()]
    comparison.skipped += len(tasks) - len(missing)
    if not missing:
        return
    with closing(executor.do(missing)) as outcomes:
        for count, (task, failure) in enumerate(outcomes, start=1):
            if failure is not None:
                comparison.failures[task.name] = failure
            told(task, failure, count, len(missing))
