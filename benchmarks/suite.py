# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a benchmark is, and where it finds recordings."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchmarks.metric import Metric, info
from slam_graph.errors import DataError

DATA_VARIABLE = "SLAM_GRAPH_DATA"

RECURSIVE = ("msckf", "swf", "okvis", "ekf", "iekf")
"""The algorithms of the engine."""

CORE = ("msckf", "swf", "okvis")
"""Those whose cost is bounded, which is what the quick benchmarks judge."""

PEERS = ("fixed_lag_isam2", "fixed_lag_batch", "isam2")
"""GTSAM's smoothers behind the same interface."""

UNBOUNDED = ("ekf", "iekf")
"""Algorithms of the engine that keep every feature."""

GROWING = (*UNBOUNDED, "isam2")
"""All whose cost of a step grows where features come back: there they run on a clip."""


@dataclass(slots=True)
class Outcome:
    """What a benchmark found.

    Attributes:
        metrics: figures; their keys lack the name of the benchmark.
        notes: lines that a reader should know beside the figures.
        texts: what a run said, by key as figures have; for tables of the documents, never judged.
        failure: why it could not be measured; empty if it could.
    """

    metrics: list[Metric] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    texts: dict[str, str] = field(default_factory=dict)
    failure: str = ""

    def add(
        self,
        variant: str,
        metrics: Iterable[Metric],
        judged: bool = True,
        held_out: bool = False,
    ) -> None:
        """Add figures of a variant.

        Args:
            variant: goes before their keys.
            metrics: the figures.
            judged: whether they have bars and a baseline, or are only shown.
            held_out: whether no parameter was chosen on what they were measured on.
        """
        for metric in metrics:
            shown = metric if judged else info(metric.key, metric.value, metric.unit)
            self.metrics.append(replace(shown.under(variant), held_out=held_out))


@dataclass(frozen=True, slots=True)
class Benchmark:
    """A benchmark that can be run by its name.

    Attributes:
        summary: one line for `--list`.
        needs: folders that it reads, below the folder of recordings.
        run: measures; takes the folder of recordings.
        quick: whether it is one of those that every change is judged by, of some ten seconds each.
    """

    summary: str
    needs: tuple[str, ...]
    run: Callable[[Path], Outcome]
    quick: bool = False


def data_folder() -> Path:
    """The folder of recordings.

    Raises:
        DataError: if the environment does not name one.
    """
    named = os.environ.get(DATA_VARIABLE)
    if not named:
        raise DataError(
            f"{DATA_VARIABLE} is not set: it names the folder of recordings; "
            f"run `{DATA_VARIABLE}=FOLDER python -m benchmarks.run`"
        )
    if not Path(named).is_dir():
        raise DataError(f"{DATA_VARIABLE}={named}: no such folder")
    return Path(named).resolve()


def require(benchmark: Benchmark, data: Path) -> None:
    """Make sure that the recordings of a benchmark are there before anything runs.

    Raises:
        DataError: naming what is missing.
    """
    for need in benchmark.needs:
        if not (data / need).exists():
            raise DataError(f"{data / need}: not there; {DATA_VARIABLE} must name a folder with it")
