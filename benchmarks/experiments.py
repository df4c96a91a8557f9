# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Comparisons as benchmarks make them: in parallel processes, and going on where they were left.

Results are kept under `results/benchmarks`, in a folder whose name holds a hash of the sources, so
that a comparison that was interrupted goes on, and one of other code begins anew.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import slam_graph
from benchmarks.suite import Outcome
from slam_graph.config import RunConfig, load_config
from slam_graph.experiment.comparison_plan import Comparison, load_configs, run_tasks
from slam_graph.experiment.comparison_results import Table, read_result
from slam_graph.experiment.executors import LocalProcesses
from slam_graph.experiment.settings_hash import HASH_LENGTH
from slam_graph.experiment.tasks import RunTask, Source

RESULTS = Path("results/benchmarks")


def folder_of(benchmark: str) -> Path:
    """Where the results of a benchmark of this very code are."""
    sources = hashlib.sha256()
    package = Path(slam_graph.__file__).parent
    algorithms = package.parent / "configs" / "algorithms"
    for file in sorted([*package.rglob("*.py"), *package.rglob("*.yaml"), *algorithms.glob("*")]):
        sources.update(file.read_bytes())
    return RESULTS / f"{benchmark}_{sources.hexdigest()[:HASH_LENGTH]}"


def configs_of(
    algorithms: Sequence[str], cameras: int, duration_s: float | None = None
) -> dict[str, RunConfig]:
    """The settings under each algorithm."""
    return load_configs(
        algorithms, lambda name: load_config(algorithm=name, cameras=cameras, duration_s=duration_s)
    )


def compared(
    folder: Path,
    sources: Sequence[Source],
    configs: dict[str, RunConfig],
    seeds: int | Sequence[int] = 1,
    workers: int | None = None,
) -> Comparison:
    """Do what has not been done yet, and tell of it on stderr.

    Args:
        folder: of tracks and results.
        sources: what to run on.
        configs: settings under each algorithm.
        seeds: how many, or which.
        workers: processes at a time; as many as there are cores if not said.
    """
    return run_tasks(sources, configs, seeds, folder, LocalProcesses(workers), _tell)


def results_of(comparison: Comparison, data: str, algorithm: str) -> list[tuple[RunTask, Table]]:
    """The runs of an algorithm that ended well, with the content of their JSON files."""
    mine = (t for t in comparison.runs if (t.data, t.algorithm) == (data, algorithm))
    found = ((task, read_result(task.result)) for task in mine)
    return [(t, r) for t, r in found if r is not None and r["metrics"]["status"] == "ok"]


def note_failures(outcome: Outcome, comparison: Comparison) -> None:
    """Note what could not be done, and which runs did not end well."""
    outcome.notes += [f"{name}: {reason}" for name, reason in comparison.failures.items()]
    outcome.notes += list(_bad_endings(comparison.runs))


def _bad_endings(tasks: Iterable[RunTask]) -> Iterable[str]:
    for task in tasks:
        result = read_result(task.result)
        if result is not None and result["metrics"]["status"] != "ok":
            metrics = result["metrics"]
            yield f"{task.name}: {metrics['status']}: {metrics['message']}"


def _tell(task: str, failure: str | None, count: int, total: int) -> None:
    ending = "" if failure is None else f": failed: {failure}"
    print(f"  {count}/{total} {task}{ending}", file=sys.stderr, flush=True)
