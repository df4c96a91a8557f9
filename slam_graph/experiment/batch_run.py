# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`batch`: many recordings, one run for each, with a summary of all."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from slam_graph.experiment.batch_page import write_page
from slam_graph.experiment.batch_plan import absolute_sources, plan
from slam_graph.experiment.batch_summary import Row, rows_of, write_csv
from slam_graph.experiment.batch_task import BatchTask, running
from slam_graph.experiment.comparison_plan import Progress
from slam_graph.experiment.executors import Executor, executor_for
from slam_graph.files import Files
from slam_graph.results import ResultFolder

Watch = Callable[[Mapping[str, float], int], None]
"""Called now and then with the part that is done of each recording that is being run, and the
number of recordings to run."""

_WATCH_PERIOD_S = 0.5


@dataclass
class Batch:
    """Many recordings and their results.

    Attributes:
        folder: of all files; the results of each recording are in a folder of its name.
        tasks: a run for each recording, in the order of the table.
        failures: why a recording could not be run, by its name; a run that diverged is a result.
        skipped: number of recordings that had been done before.
        rows: of the table, one for each recording.
        files: of the summary.
    """

    folder: Path
    tasks: list[BatchTask]
    failures: dict[str, str] = field(default_factory=dict)
    skipped: int = 0
    rows: list[Row] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)


def batch(
    what: str | Path | Sequence[str | Path],
    *,
    output: str | Path = "results/batch",
    config: str | Path | None = None,
    overrides: Iterable[str] = (),
    format: str | None = None,
    calibration: str | Path | None = None,
    sources: Mapping[str, str] | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    tls: Mapping[str, str | Path] | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
    rerun: Literal["off", "save"] = "off",
    rerun_images: Literal["none", "keyframes", "all"] = "all",
    graph_times: Iterable[int | float] = (),
    **settings: Any,
) -> Batch:
    """Run many recordings, and write a summary.

        done = batch("recordings/", duration_s=30)
        for row in done.rows:
            print(row["name"], row["status"], row["ate_m"])

    Recordings that were done by an earlier call with the same settings and `output` are not run
    again. An interruption loses only the runs in progress; the summary is written all the same.

    Args:
        what: one or more of: a recording; a folder, in which recordings of known formats are
            searched; a pattern such as ``data/*/MH_*``; a YAML file that lists recordings.
        output: folder of all results and of the summary.
        config: YAML file of settings for all runs.
        overrides: `a.b=value` for all runs, as `--set` takes them.
        format: of all recordings; None to find it for each.
        calibration: Kalibr file for all recordings.
        sources: where each sensor is, in formats that leave it open.
        jobs: processes at a time; the number of cores if None.
        scheduler: address of a Dask scheduler to do the runs on instead of this machine.
        tls: PEM files for an encrypted connection to it: `ca_file`, `cert`, `key`.
        progress: called after each run with the name of the recording, why it failed or None, the
            number of runs done, and that of all.
        watch: called now and then, by another thread, with the part from 0 to 1 that is done of
            each recording that is being run, by its name, and the number of recordings to run.
        rerun: `save` writes `recording.rrd` beside the results of each recording.
        rerun_images: of which frames it has images.
        graph_times: when the factor graph of the back end is kept, as for `run`.
        settings: top-level settings of all runs, such as `duration_s` and `cameras`; they replace
            those of a list.

    Returns:
        The recordings with their outcome, the rows of the table and the files of the summary.

    Raises:
        ConfigError: if a setting or a name is wrong.
        DataError: if no recording is found.
    """
    names = [str(one) for one in ([what] if isinstance(what, str | Path) else what)]
    executor = executor_for(jobs, scheduler, tls)
    folder = Path(output).resolve()
    common = {
        "format": format,
        "calibration": None if calibration is None else str(Path(calibration).resolve()),
        "sources": absolute_sources(sources or {}, Path.cwd()),
    }
    extras = {
        "rerun": rerun == "save",
        "rerun_images": rerun_images,
        "graph_times": list(graph_times),
    }
    done = Batch(folder, plan(names, folder, config, list(overrides), settings, common, extras))
    Files.make_folder(folder)
    Files.remove_remains(folder)
    missing = [task for task in done.tasks if not task.is_done()]
    done.skipped = len(done.tasks) - len(missing)
    try:
        with _watched(folder, len(missing), watch):
            _do(done, missing, executor, progress)
    finally:
        _summarize(done)
    return done


def _do(
    done: Batch, missing: Sequence[BatchTask], executor: Executor, progress: Progress | None
) -> None:
    """Run the recordings that are not done yet."""
    if not missing:
        return
    with closing(executor.do(missing)) as outcomes:
        for count, (task, failure) in enumerate(outcomes, start=1):
            if failure is not None:
                done.failures[task.name] = failure
            if progress is not None:
                progress(task.name, failure, count, len(missing))


def _summarize(done: Batch) -> None:
    """Write the summary of what is done so far."""
    done.rows = rows_of(done.tasks, done.failures)
    folder = ResultFolder(done.folder)
    write_csv(folder, done.rows)
    write_page(folder, done.rows)
    done.files = folder.files


@contextmanager
def _watched(folder: Path, total: int, watch: Watch | None) -> Iterator[None]:
    """Tell during the block how far each recording is."""
    if watch is None:
        yield
        return
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(_WATCH_PERIOD_S):
            watch(running(folder), total)

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
