# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The baseline: what the gate compares with, and what the tables of the documents are made of."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import baseline, report, tables
from benchmarks.metric import COMPUTING_TIMES, Metric, info
from benchmarks.recordings import CHOSEN_ON, HELD_OUT, is_held_out
from benchmarks.registry import BENCHMARKS
from benchmarks.suite import Outcome
from slam_graph.errors import DataError

NAN = math.nan


def recorded(*metrics: Metric) -> baseline.Baseline:
    """A baseline of these figures."""
    names = {baseline.benchmark_of(metric.key) for metric in metrics}
    return baseline.updated({}, metrics, names)


def test_the_gate_names_bars_missed_figures_worse_and_figures_gone() -> None:
    metrics = [
        Metric("a.good", 1.0, "m", "lower", 2.0),
        Metric("a.high", 3.0, "m", "lower", 2.0),
        Metric("a.worse", 1.0, "m", "lower"),
        info("a.shown", 99.0, "m"),
    ]
    before = recorded(
        Metric("a.good", 1.0, "m", "lower"),
        Metric("a.worse", 0.5, "m", "lower"),
        Metric("a.gone", 1.0, "m", "lower"),
        info("a.shown_once", 1.0, "m"),
        Metric("b.not_run", 1.0, "m", "lower"),
    )
    lines = baseline.complaints(metrics, before, {"a"})
    assert [line.split()[0] for line in lines] == ["a.high", "a.high", "a.worse", "a.gone"]
    assert "misses 2.0" in lines[0]
    assert "not in the baseline" in lines[1]
    assert "0.5" in lines[2]
    assert baseline.complaints(metrics[:1], before, {"c"}) == []


def test_a_baseline_is_read_back_and_keeps_what_was_not_run(tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    assert baseline.read_baseline(path) == {}
    before = recorded(Metric("a.old", 1.0, "m", "lower"), Metric("b.kept", 2.0, "m", "lower"))
    metrics = [
        Metric("a.new", 0.123456, "m", "lower", 0.2, tolerance=0.1, held_out=True),
        Metric("a.none", NAN, "m", "lower"),
        Metric("a.band", 1.0, "", "band", (0.3, 4.0)),
        info("a.shown", 3.0, "m"),
    ]
    said = {"a.new.said": "lost at 3 s × 2, for “no” reason"}
    baseline.write_baseline(baseline.updated(before, metrics, {"a", "failed"}, said), path)
    found = baseline.read_baseline(path)
    assert {name: list(record.metrics) for name, record in found.items()} == {
        "a": ["a.new", "a.none", "a.band", "a.shown"],
        "b": ["b.kept"],
    }
    kept = found["a"].metrics
    assert kept["a.new"] == replace(metrics[0], value=0.1235)
    assert math.isnan(kept["a.none"].value)
    assert [kept["a.band"], kept["a.shown"]] == metrics[2:]
    assert "gtsam" in found["a"].versions
    assert found["a"].texts == said
    assert baseline.text_of(found, "a.new.said") == said["a.new.said"]
    assert baseline.text_of(found, "b.kept.said") is None
    spoken = {"a": replace(found["a"], metrics={})}
    assert baseline.complaints([], spoken, {"a"}) == [], "texts are not judged"


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"schema_version": 99, "benchmarks": {}}'])
def test_a_file_that_is_no_baseline_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "baseline.json"
    path.write_text(text)
    with pytest.raises(DataError, match="--update-baseline") as caught:
        baseline.read_baseline(path)
    assert "\n" not in str(caught.value)


def test_the_committed_baseline_knows_only_benchmarks_that_exist() -> None:
    records = baseline.read_baseline()
    assert records.keys() <= BENCHMARKS.keys()
    for name, record in records.items():
        assert {baseline.benchmark_of(key) for key in record.metrics} == {name}


def test_every_quick_benchmark_has_a_baseline() -> None:
    quick = {name for name, benchmark in BENCHMARKS.items() if benchmark.quick}
    assert quick
    assert quick <= baseline.read_baseline().keys()


def test_the_tables_of_the_documents_are_those_of_the_baseline() -> None:
    assert not tables.outdated(tables.documents(), baseline.read_baseline()), (
        "run `python -m benchmarks.tables`"
    )
    pages = [page.read_text(encoding="utf-8") for page in tables.documents()]
    shown = [found["name"] for page in pages for found in tables.MARKED.finditer(page)]
    once = "each table is in one document, that of the README also in the site's results"
    assert sorted(shown) == sorted([*tables.TABLES, "results"]), once
    marks = sum(page.count("<!-- table:") for page in pages)
    assert marks == len(shown), "each begin has its end"


def test_a_table_says_what_the_baseline_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(tables.TABLES, "small", lambda figures: iter([figures("a.x", 2)]))
    page = "before\n<!-- table: small -->\nold\n<!-- end -->\nafter\n"
    known = recorded(Metric("a.x", 1.234, "m", "lower"))
    expected = "before\n<!-- table: small -->\n1.23\n<!-- end -->\nafter\n"
    assert tables.with_tables(page, known) == expected
    assert tables.with_tables(expected, known) == expected
    with pytest.raises(DataError, match=r"a\.x is not in the baseline.*--only a"):
        tables.with_tables(page, {})
    with pytest.raises(DataError, match="no table is called 'big'"):
        tables.with_tables(page.replace("small", "big"), known)


@pytest.mark.parametrize("unit", COMPUTING_TIMES)
def test_what_a_machine_takes_is_never_judged(unit: str) -> None:
    assert info("a.b", 1.0, unit).meets_bar is None
    with pytest.raises(ValueError, match="depends on the machine"):
        Metric("a.b", 1.0, unit, "lower", 2.0)


def test_quick_benchmarks_judge_ratios_of_times_generously() -> None:
    """One alone does, the least of two runs: load has made a single one worse by 1.6."""
    records = baseline.read_baseline()
    quick = [records[name] for name, benchmark in BENCHMARKS.items() if benchmark.quick]
    metrics = [metric for record in quick for metric in record.metrics.values()]
    times = [metric for metric in metrics if metric.has_baseline and "LK" in metric.unit]
    assert [metric.key for metric in times] == ["speed_quick.cost_mean"]
    assert times[0].tolerance == 0.5


def test_every_recording_of_a_benchmark_is_chosen_on_or_held_out() -> None:
    needs = {need for benchmark in BENCHMARKS.values() for need in benchmark.needs}
    assert {need for need in needs if is_held_out(need)} == set(HELD_OUT)
    assert not set(HELD_OUT) & set(CHOSEN_ON)
    with pytest.raises(DataError, match="not in the tables"):
        is_held_out("nowhere")


def test_held_out_figures_are_reported_apart() -> None:
    outcome = Outcome()
    outcome.add("kept", [Metric("ate", 1.0, "m", "lower")], held_out=True)
    outcome.add("known", [Metric("ate", 2.0, "m", "lower")])
    lines = [line.split()[0] for line in report.lines({"a": outcome}, {}) if line]
    assert lines == ["figure", "a", "known.ate", "held", "kept.ate"]
    page = list(report.markdown({"a": outcome}, {}))
    assert page.index(report.HELD_OUT) > next(i for i, row in enumerate(page) if "known" in row)
