# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`compare`: several algorithms on the same feature tracks, over seeds, with a report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from slam_graph.config import load_config
from slam_graph.experiment.comparison_plan import (
    Comparison,
    Progress,
    load_configs,
    run_tasks,
    with_variants,
)
from slam_graph.experiment.comparison_report import write_report
from slam_graph.experiment.executors import executor_for
from slam_graph.experiment.tasks import find_sources

_DEFAULT_ALGORITHMS = ("msckf", "swf", "okvis", "ekf", "iekf")


def compare(
    data: str | Path | Sequence[str | Path],
    algorithms: str | Sequence[str | Path] = _DEFAULT_ALGORITHMS,
    *,
    seeds: int | Sequence[int] = 1,
    output: str | Path = "results/comparison",
    config: str | Path | None = None,
    overrides: Iterable[str] = (),
    simulation: Iterable[str] = (),
    groundtruth: Mapping[str, str | Path] | None = None,
    sources: Mapping[str, str] | None = None,
    without_fej: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    tls: Mapping[str, str | Path] | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Comparison:
    """Run several algorithms on the same feature tracks, and write a report.

        comparison = compare("sim:figure8", "msckf,swf", seeds=5, duration_s=30)
        for row in comparison.rows:
            print(row["algorithm"], row["ate_m"]["se3"], row["nees"]["pose"])

    Tasks that were done by an earlier call with the same settings and `output` are not repeated.

    Args:
        data: one or more of: path of a recording, `demo`, `sim:figure8`, `sim:rooms`, `sim:random`,
            `sim:car`, or `sim:PATH` of a recorded flight with its IMU.
        algorithms: names or paths of YAML files; a text may hold several with commas between.
        seeds: their number, for 0, 1, …, or the seeds themselves.
        output: folder of tracks, results and report.
        config: YAML file of settings for all runs.
        overrides: `a.b=value` for all runs, as `--set` takes them.
        simulation: `a.b=value` for all simulations.
        groundtruth: paths of ground truth, by the path of the recording as in `data`.
        sources: where sensors of the recordings are that are not found by themselves: `gnss`,
            `poses`, `odometry`, topics of bags, as `open_dataset` takes them.
        without_fej: whether to run each algorithm also without first-estimates Jacobians, under the
            name NAME_no_fej.
        workers: processes at a time; the number of cores if None.
        scheduler: address of a Dask scheduler to run the tasks on instead of this machine.
        tls: PEM files for an encrypted connection to it: `ca_file`, `cert`, `key`.
        progress: called after each task with its name, why it failed or None, the number of tasks
            done, and that of all.
        settings: top-level settings of all runs, such as `duration_s` and `cameras`.

    Returns:
        The tasks with their outcome, the rows of the table and the files of the report. A task that
        could not be done is in `failures`; a run that diverged is a result.

    Raises:
        ConfigError: if a setting or a name is unknown, or a name is given twice.
        DataError: if a recording cannot be opened.
    """
    names = algorithms.split(",") if isinstance(algorithms, str) else map(str, algorithms)
    changes = list(overrides)
    configs = load_configs(
        [name for name in names if name],
        lambda name: load_config(config, changes, algorithm=name, **settings),
    )
    if without_fej:
        configs = with_variants(configs)
    inputs = [data] if isinstance(data, (str, Path)) else data
    duration_s, output = settings.get("duration_s"), Path(output)
    found = find_sources(inputs, duration_s, simulation, groundtruth, sources, output)
    executor = executor_for(workers, scheduler, tls)
    comparison = run_tasks(found, configs, seeds, output, executor, progress or _ignore)
    write_report(comparison)
    return comparison


def _ignore(task: str, failure: str | None, count: int, total: int) -> None:
    """No progress is shown."""
