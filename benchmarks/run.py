# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Run benchmarks: `SLAM_GRAPH_DATA=FOLDER python -m benchmarks.run [--quick] [--gate]`."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from benchmarks import baseline, report
from benchmarks.registry import BENCHMARKS
from benchmarks.suite import Outcome, data_folder, require
from slam_graph.errors import SlamGraphError
from slam_graph.files import Files

FAILED = 1

LONGEST = (
    "held_out", "mh01_stereo", "openvins_sim_stereo", "openvins_sim_mono", "mh01_mono",
    "speed_quick", "wheel_v101",
)  # fmt: skip
"""The quick benchmarks that take longest: several workers begin with these, so that none ends with
one while the others have nothing to do."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for.

    Returns:
        0; 1 if something could not be measured, or with `--gate` if a bar is missed or a figure
        got worse.
    """
    options = parser().parse_args(arguments)
    if options.list:
        width = max(map(len, BENCHMARKS))
        for name, benchmark in BENCHMARKS.items():
            print(f"{name:{width}}  {'quick' if benchmark.quick else '     '}  {benchmark.summary}")
        return 0
    try:
        before = baseline.read_baseline(options.baseline)
        results = execute(chosen(options), options.workers)
    except SlamGraphError as error:
        print(f"error: {error}", file=sys.stderr)
        return FAILED
    print("\n".join(report.lines(results, before)))
    write(options, results, before)
    if options.gate:
        return gate(results, before)
    return FAILED if any(outcome.failure for outcome in results.values()) else 0


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(prog="python -m benchmarks.run", description=__doc__)
    add = made.add_argument
    add("--list", action="store_true", help="list the benchmarks and leave")
    some = made.add_mutually_exclusive_group()
    names = list(BENCHMARKS)
    some.add_argument("--only", nargs="+", metavar="NAME", choices=names, help="run only these")
    some.add_argument("--quick", action="store_true", help="run those that judge every change")
    add("--workers", type=int, default=1, metavar="N", help="benchmarks at a time (default: 1)")
    add("--json", type=Path, metavar="FILE", help="write all figures as JSON")
    add("--markdown", type=Path, metavar="FILE", help="write the tables as Markdown")
    add("--gate", action="store_true", help="exit 1 if a bar is missed or a figure is worse or new")
    add("--update-baseline", action="store_true", help="make what is measured the baseline")
    add(
        "--baseline",
        type=Path,
        metavar="FILE",
        default=baseline.BASELINE_FILE,
        help="compare with this baseline (default: %(default)s)",
    )
    return made


def chosen(options: argparse.Namespace) -> list[str]:
    """The names of the benchmarks that are asked for; all if none are."""
    if options.quick:
        return [name for name, benchmark in BENCHMARKS.items() if benchmark.quick]
    return list(options.only or BENCHMARKS)


def execute(names: Sequence[str], workers: int = 1) -> dict[str, Outcome]:
    """Run benchmarks by their names, after a look whether all that they need is there.

    Args:
        names: of the benchmarks.
        workers: processes at a time; 1 runs them here, one after the other.

    Raises:
        DataError: if a recording is missing. What fails later is told in its outcome, so that the
            others are not lost.
    """
    data = data_folder()
    for name in names:
        require(BENCHMARKS[name], data)
    if workers == 1:
        return {name: measured(name, data) for name in names}
    place = {name: number for number, name in enumerate(LONGEST)}
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        outcomes = {
            name: pool.submit(measured, name, data)
            for name in sorted(names, key=lambda name: place.get(name, len(LONGEST)))
        }
        return {name: outcomes[name].result() for name in names}


def measured(name: str, data: Path) -> Outcome:
    """What a benchmark finds, or why it does not."""
    print(f"{name} …", file=sys.stderr, flush=True)
    wall_s, cpu_s = time.monotonic(), time.process_time()
    try:
        outcome = BENCHMARKS[name].run(data)
    except SlamGraphError as error:
        outcome = Outcome(failure=str(error))
    wall_s, cpu_s = time.monotonic() - wall_s, time.process_time() - cpu_s
    print(f"{name}: {wall_s:.0f} s, {cpu_s:.0f} s of CPU", file=sys.stderr, flush=True)
    return outcome


def write(options: argparse.Namespace, results: report.Results, before: baseline.Baseline) -> None:
    """Write the files that are asked for."""
    if options.json:
        Files.write_text(options.json, [json.dumps(report.table(results), indent=2), "\n"])
    if options.markdown:
        Files.write_text(
            options.markdown, [line + "\n" for line in report.markdown(results, before)]
        )
    if options.update_baseline:
        measured = report.measured(results)
        now = baseline.updated(before, measured, results.keys(), report.texts(results))
        baseline.write_baseline(now, options.baseline)


def gate(results: report.Results, before: baseline.Baseline) -> int:
    """Say what keeps the gate shut; 0 if nothing does."""
    faults = [f"{name}: {outcome.failure}" for name, outcome in results.items() if outcome.failure]
    faults += baseline.complaints(report.measured(results), before, results.keys())
    for fault in faults:
        print(f"gate: {fault}", file=sys.stderr)
    print(f"gate: {len(faults)} faults" if faults else "gate: passed", file=sys.stderr)
    return FAILED if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
