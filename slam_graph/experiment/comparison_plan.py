# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The tasks of a comparison: record every source with every seed, run every algorithm on that."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from slam_graph.backend import FinalBaConfig
from slam_graph.config import RunConfig
from slam_graph.display import Displayed
from slam_graph.errors import ConfigError
from slam_graph.experiment.executors import Executor
from slam_graph.experiment.tasks import RecordTask, RunTask, Source, Task
from slam_graph.files import Files

WITHOUT_FEJ = "_no_fej"
"""Suffix of the name of an algorithm without first-estimates Jacobians."""

Progress = Callable[[str, str | None, int, int], None]
"""Called after each task: its name, why it failed or None, tasks done, tasks to do."""


@dataclass(repr=False)
class Comparison(Displayed):
    """The tasks of a comparison and their outcome.

    Attributes:
        folder: of all files.
        runs: of all algorithms, on all data, for all seeds, in the order of the table.
        failures: why a task could not be done, by its name; a run that diverged is not a failure.
        skipped: number of tasks that had been done before.
        rows: of the table, one for each algorithm and data set; empty before the report is written.
        table: the same as text, under a row of titles, with the data before each row.
        files: of the report.
    """

    folder: Path
    runs: list[RunTask]
    failures: dict[str, str] = field(default_factory=dict)
    skipped: int = 0
    rows: list[dict[str, Any]] = field(default_factory=list)
    table: list[tuple[str, ...]] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)

    def __repr__(self) -> str:
        names = dict.fromkeys(task.algorithm for task in self.runs)
        data = dict.fromkeys(task.data for task in self.runs)
        failed = f", {len(self.failures)} tasks failed" if self.failures else ""
        return f"Comparison({', '.join(names)} on {', '.join(data)}{failed}: {self.folder})"

    def _facts(self) -> dict[str, object]:
        errors = {f"{row['algorithm']} on {row['data']}": _short(row) for row in self.rows}
        return {**errors, "failed": len(self.failures) or None, "report": self.folder}


def _short(row: dict[str, Any]) -> str:
    """Errors, consistency and cost of one algorithm, as far as they are known."""
    values = (
        ("ATE {:.4f} m", row["ate_m"][row["alignment"]]),
        ("{:.3f}°", row["orientation_deg"][row["alignment"]]),
        ("NEES {:.2f}", row["nees"]["pose"]),
        ("{:.1f} ms a frame", row["ms_per_frame"]),
    )
    return ", ".join(text.format(value) for text, value in values if value is not None)


def load_configs(
    algorithms: Sequence[str], load: Callable[[str], RunConfig]
) -> dict[str, RunConfig]:
    """The settings of a run with each algorithm, by the `name` in the algorithm's file.

    Args:
        algorithms: names, or paths of YAML files.
        load: gives the settings for one of these.

    Raises:
        ConfigError: if two have the same name, or there is none.
    """
    configs: dict[str, RunConfig] = {}
    for algorithm in algorithms:
        config = load(algorithm)
        name = config.algorithm.name
        if name in configs:
            raise ConfigError(
                f"algorithms: '{name}' is given twice; change the name in one of the files"
            )
        configs[name] = config
    if not configs:
        raise ConfigError("algorithms: none is given")
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
            variant = config.with_overrides(
                {
                    "algorithm.name": f"{name}{WITHOUT_FEJ}",
                    "algorithm.marginalization.first_estimates": False,
                }
            )
            both[variant.algorithm.name] = variant
    return both


def run_tasks(
    sources: Sequence[Source],
    configs: Mapping[str, RunConfig],
    seeds: int | Sequence[int],
    folder: str | Path,
    executor: Executor,
    progress: Progress,
) -> Comparison:
    """Do the tasks that have not been done yet. An interruption loses only those in progress.

    Args:
        sources: recordings and simulations.
        configs: settings by algorithm, which differ in the algorithm only.
        seeds: their number, for 0, 1, …, or the seeds themselves. Where a seed changes nothing only
            the first is used.
        folder: of tracks and results.
        executor: does the tasks.
        progress: called after each task.
    """
    folder = Path(folder).resolve()
    Files.make_folder(folder)
    recordings, runs = plan(sources, configs, seeds, folder)
    for used in {recorded.root for recorded in recordings} | {task.result.parent for task in runs}:
        Files.remove_remains(used)
    comparison = Comparison(folder, runs)
    _do(comparison, recordings, executor, progress)
    _do(comparison, [task for task in runs if task.tracks.is_dir()], executor, progress)
    return comparison


def plan(
    sources: Sequence[Source],
    configs: Mapping[str, RunConfig],
    seeds: int | Sequence[int],
    folder: Path,
) -> tuple[list[RecordTask], list[RunTask]]:
    """All tasks: one recording for each source and seed, and on it a run of every algorithm."""
    recordings: list[RecordTask] = []
    runs: list[RunTask] = []
    common = next(iter(configs.values()))
    numbers = list(range(seeds)) if isinstance(seeds, int) else list(seeds)
    replay = {"start_s": 0.0, "duration_s": None, "cameras": None}  # the tracks are cut already
    causal = FinalBaConfig(enabled=False)  # it would make the results of all algorithms alike
    for source in sources:
        for seed in numbers if source.random else numbers[:1]:
            record = RecordTask(source=source, seed=seed, config=common, root=folder / "tracks")
            recordings.append(record)
            runs += [
                RunTask(
                    data=source.name,
                    algorithm=name,
                    seed=seed,
                    config=_adapted(config, source).model_copy(
                        update={**replay, "seed": seed, "final_ba": causal}
                    ),
                    tracks=record.folder,
                    result=folder / "runs" / f"{source.name}_seed{seed}" / f"{name}.json",
                )
                for name, config in configs.items()
            ]
    return recordings, runs


def _adapted(config: RunConfig, source: Source) -> RunConfig:
    """The settings for a source; a start state with a drawn error keeps its covariance.

    With `fix_gauge` position and yaw of the start would be taken as exact, and every NEES would be
    too large by their error.
    """
    if source.simulation is None or not source.simulation.known_start.error:
        return config
    return config.with_overrides({"backend.initialization.fix_gauge": False})


def _do(
    comparison: Comparison, tasks: Sequence[Task], executor: Executor, progress: Progress
) -> None:
    """Do the tasks that are not done yet."""
    missing = [task for task in tasks if not task.is_done()]
    comparison.skipped += len(tasks) - len(missing)
    if not missing:
        return
    with closing(executor.do(missing)) as outcomes:
        for count, (task, failure) in enumerate(outcomes, start=1):
            if failure is not None:
                comparison.failures[task.name] = failure
            progress(task.name, failure, count, len(missing))
