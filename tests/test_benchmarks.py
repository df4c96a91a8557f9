# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark suite: what its gate lets through, what it writes, and how it divides time."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import (
    clocks,
    cost_over_time,
    monte_carlo,
    policy_product,
    report,
    run,
    speed,
    speed_worker,
    verdict,
)
from benchmarks.metric import Bar, Direction, Metric, info
from benchmarks.openvins_sim import Quality, best
from benchmarks.registry import BENCHMARKS
from benchmarks.running import Errors
from benchmarks.suite import DATA_VARIABLE, Benchmark, Outcome
from slam_graph.errors import EstimationError
from slam_graph.geometry.trajectory import Trajectory

NAN = math.nan


@pytest.mark.parametrize(
    ("value", "direction", "bar", "met"),
    [
        (0.1, "lower", 0.1, True),
        (0.11, "lower", 0.1, False),
        (0.0, "lower", 0.0, True),
        (1.0, "higher", 1.0, True),
        (0.99, "higher", 1.0, False),
        (0.3, "band", (0.3, 4.0), True),
        (0.29, "band", (0.3, 4.0), False),
        (4.1, "band", (0.3, 4.0), False),
        (5.0, "lower", None, None),
        (NAN, "lower", 0.1, False),
        (NAN, "higher", 0.1, False),
        (NAN, "band", (0.3, 4.0), False),
        (math.inf, "lower", 0.1, False),
    ],
)
def test_a_bar_is_met_up_to_itself_and_never_by_what_is_not_a_number(
    value: float, direction: Direction, bar: Bar | None, met: bool | None
) -> None:
    assert Metric("a.b", value, "m", direction, bar).meets_bar is met


@pytest.mark.parametrize(
    ("value", "direction", "before", "worse"),
    [
        (1.1, "lower", 1.0, False),
        (1.11, "lower", 1.0, True),
        (0.1, "lower", 1.0, False),
        (1.0, "lower", 0.0, True),
        (0.0, "lower", 0.0, False),
        (0.9, "higher", 1.0, False),
        (0.89, "higher", 1.0, True),
        (9.0, "higher", 1.0, False),
        (NAN, "lower", 1.0, True),
        (NAN, "higher", 1.0, True),
        (9.0, "lower", NAN, False),
        (9.0, "info", 1.0, False),
    ],
)
def test_worse_is_beyond_the_tolerance_on_the_wrong_side(
    value: float, direction: Direction, before: float, worse: bool
) -> None:
    assert Metric("a.b", value, "m", direction, tolerance=0.1).worse_than(before) is worse


def test_what_depends_on_the_machine_is_judged_by_its_bar_alone() -> None:
    metric = Metric("a.b", 1.1, "×", "higher", 1.0, tolerance=None)
    assert metric.meets_bar
    assert not metric.worse_than(9.0)
    assert not metric.has_baseline


@pytest.mark.parametrize(
    ("direction", "bar"),
    [("band", 1.0), ("band", None), ("lower", (0.0, 1.0)), ("info", 1.0), ("down", None)],
)
def test_a_bar_must_fit_its_direction(direction: Direction, bar: Bar | None) -> None:
    with pytest.raises(ValueError, match=r"a\.b"):
        Metric("a.b", 1.0, "m", direction, bar)


def _made_up(value: float = 1.0, fail: bool = False) -> Benchmark:
    def measure(data: Path) -> Outcome:
        if fail:
            raise EstimationError("diverged at once")
        metrics = [
            Metric("x.ate", value, "m", "lower", 2.0),
            Metric("x.nees", 1.0, "", "band", (0.3, 4.0)),
            info("other.ate", NAN, "m"),
        ]
        return Outcome(metrics, [f"read {data.name}"])

    return Benchmark("made up", ("recording",), measure)


@pytest.fixture
def recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "recordings"
    (folder / "recording").mkdir(parents=True)
    monkeypatch.setenv(DATA_VARIABLE, str(folder))
    return folder


def test_a_run_prints_gates_and_writes(
    tmp_path: Path,
    recordings: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(BENCHMARKS, "made_up", _made_up(1.0))
    files = {name: tmp_path / name for name in ("b.json", "out.json", "out.md")}
    common = ["--only", "made_up", "--baseline", str(files["b.json"])]
    written = ["--json", str(files["out.json"]), "--markdown", str(files["out.md"])]
    assert run.main([*common, "--gate"]) == 1, "nothing to compare with"
    assert run.main([*common, *written, "--update-baseline"]) == 0
    assert run.main([*common, "--gate"]) == 0
    assert "note: read recordings" in capsys.readouterr().out

    table = json.loads(files["out.json"].read_text())
    assert table["schema_version"] == report.SCHEMA_VERSION
    metrics = table["benchmarks"]["made_up"]["metrics"]
    assert [m["key"] for m in metrics] == ["made_up.x.ate", "made_up.x.nees", "made_up.other.ate"]
    assert [m["value"] for m in metrics] == [1.0, 1.0, None]
    assert [m["bar"] for m in metrics] == [2.0, [0.3, 4.0], None]
    assert [m["meets_bar"] for m in metrics] == [True, True, None]
    page = files["out.md"].read_text().splitlines()
    assert page[0] == "### made_up"
    assert len({line.count("|") for line in page if line.startswith("|")}) == 1

    monkeypatch.setitem(BENCHMARKS, "made_up", _made_up(1.5))
    assert run.main(common) == 0
    assert run.main([*common, "--gate"]) == 1
    captured = capsys.readouterr()
    assert "+50.0%" in captured.out
    assert "ok WORSE" in captured.out
    assert "gate: made_up.x.ate = 1.5 m is worse" in captured.err


def test_a_benchmark_that_fails_does_not_lose_the_others(
    tmp_path: Path,
    recordings: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(BENCHMARKS, "bad", _made_up(fail=True))
    monkeypatch.setitem(BENCHMARKS, "good", _made_up())
    common = ["--only", "bad", "good", "--baseline", str(tmp_path / "none.json")]
    assert run.main(common) == 1
    assert run.main([*common, "--gate"]) == 1
    captured = capsys.readouterr()
    assert "FAILED: diverged at once" in captured.out
    assert "x.ate" in captured.out
    assert "gate: bad: diverged at once" in captured.err


def test_missing_recordings_are_told_before_anything_runs(
    recordings: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(BENCHMARKS, "made_up", _made_up())
    (recordings / "recording").rmdir()
    assert run.main(["--only", "made_up"]) == 1
    assert "recording: not there" in capsys.readouterr().err
    monkeypatch.setenv(DATA_VARIABLE, str(recordings / "nowhere"))
    assert run.main(["--only", "made_up"]) == 1
    assert "no such folder" in capsys.readouterr().err
    monkeypatch.delenv(DATA_VARIABLE)
    assert run.main(["--only", "made_up"]) == 1
    error = capsys.readouterr().err
    assert f"{DATA_VARIABLE} is not set" in error
    assert error.count("\n") == 1


def test_the_list_needs_no_recordings(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv(DATA_VARIABLE, raising=False)
    assert run.main(["--list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(BENCHMARKS)


@pytest.mark.parametrize("words", [["--only", "nothing"], ["--only", "bal_small", "--quick"]])
def test_an_unknown_or_contradictory_choice_is_a_usage_error(words: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        run.main(words)
    assert caught.value.code == 2


def test_quick_chooses_the_quick_ones() -> None:
    names = run.chosen(run.parser().parse_args(["--quick"]))
    assert names == [name for name in BENCHMARKS if BENCHMARKS[name].quick]
    assert set(names) < set(run.chosen(run.parser().parse_args([])))


def test_errors_are_taken_at_the_times_of_the_estimate() -> None:
    """Half a step beside the stamps of a moving truth, an exact estimate has no error."""
    true_ns = np.arange(0, 1_000_000_000, 10_000_000)
    own_ns = true_ns[10:-10] + 5_000_000

    def line(stamps_ns: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> Trajectory:
        positions = 1e-9 * stamps_ns[:, None] * np.array([2.0, 1.0, 0.5])
        return Trajectory(stamps_ns, positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(stamps_ns), 1)))

    errors = Errors.of(line(true_ns), line(own_ns), "none")
    assert errors.position_m == pytest.approx(0.0, abs=1e-12)
    assert errors.orientation_deg == pytest.approx(0.0, abs=1e-9)
    assert errors.span_s == pytest.approx(0.79)


def _timed_run() -> dict[str, object]:
    """Three frames, one to start and two steps, that had their core for half of the time."""
    return {
        "reference": [2.0, 4.0],
        "frame": [10.0, 15.0, 20.0],
        "decoding": [1.0, 1.0, 1.0],
        "stages": {
            "frame": [20.0, 30.0, 40.0],
            "read": [3.0, 3.0, 3.0],
            "decoding": [2.0, 2.0, 2.0],
            "frontend": [6.0, 6.0, 6.0],
            "frontend.temporal": [NAN, 4.0, 4.0],
            "backend": [10.0, 20.0, 30.0],
            "backend.start": [9.0, NAN, NAN],
            "backend.cost": [NAN, 15.0, 25.0],
            "total": [19.0, 29.0, 39.0],
        },
    }


def test_the_parts_of_a_frame_add_up_to_its_cost() -> None:
    metrics = {metric.key: metric.value for metric in speed.parts(_timed_run())}
    parts = {key: value for key, value in metrics.items() if key.startswith("part_")}
    assert metrics["reference"] == 3.0
    assert metrics["cost_mean_decoding"] == pytest.approx(15.0 / 3.0)
    assert metrics["cost_mean"] == pytest.approx(14.0 / 3.0)
    assert sum(parts.values()) == pytest.approx(metrics["cost_mean_decoding"])
    assert parts["part_backend_start"] == pytest.approx(9.0 / 3 / 2 / 3.0)
    assert parts["part_backend_cost"] == pytest.approx(40.0 / 3 / 2 / 3.0)
    assert min(parts.values()) >= 0.0


def test_the_least_of_overlapped_runs_counts_in_flows() -> None:
    def run(wall: float, back: float, front: float) -> dict[str, float]:
        return {"wall": wall, "cpu": back, "cpu_front_end": front}

    table = {
        "reference": [2.0, 3.0, 90.0],
        "in_turn": [run(15.0, 14.0, 0.0), run(12.0, 16.0, 0.0)],
        "overlapped": [run(9.0, 8.0, 5.0), run(10.0, 7.0, 6.0)],
    }
    values = {metric.key: metric.value for metric in speed.overlap_figures(table)}
    assert values["wall_overlapped"] == pytest.approx(3.0)
    assert values["wall_ratio"] == pytest.approx(9.0 / 12.0)
    assert (values["cpu_back_end"], values["cpu_front_end"]) == pytest.approx((7 / 3, 5 / 3))


def test_the_reference_flow_takes_time_on_any_image() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (60, 80), dtype=np.uint8)
    watch = clocks.Watch()
    clocks.time_flow(image, np.roll(image, 1, axis=1), watch)
    assert len(watch.wall) == len(watch.cpu) == 1
    assert min(watch.wall + watch.cpu) > 0.0


def test_the_least_disturbed_run_counts_and_one_is_enough_if_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def with_shares(*shares: float) -> tuple[float, int]:
        left = [{"cpu_s": value, "wall_s": 1.0} for value in shares]
        monkeypatch.setattr(speed, "worker", lambda *_: left.pop(0))
        return speed.undisturbed("shipped", Path(), "msckf")["cpu_s"], len(left)

    assert with_shares(0.99, 1.0, 1.0, 1.0) == (0.99, 3)
    assert with_shares(0.5, 0.97, 1.0, 1.0) == (0.97, 2)
    assert with_shares(0.5, 0.7, 0.6, 1.0) == (0.7, 1)


def test_the_peak_of_memory_is_of_this_program() -> None:
    assert 10.0 < speed_worker.peak_memory_mb() < 100_000.0


def test_what_is_not_judged_is_shown_without_its_bar() -> None:
    outcome = Outcome()
    metrics = [Metric("ate", 1.0, "m", "lower", 0.5)]
    outcome.add("judged", metrics)
    outcome.add("shown", metrics, judged=False)
    assert [metric.key for metric in outcome.metrics] == ["judged.ate", "shown.ate"]
    assert [metric.meets_bar for metric in outcome.metrics] == [False, None]
    assert [metric.has_baseline for metric in outcome.metrics] == [True, False]


def test_the_best_is_judged_by_the_figures_of_the_other_system() -> None:
    theirs = Quality(0.03, 0.5, nees_position=0.3, nees_orientation=3.2)
    accurate = Quality(0.02, 0.2, nees_position=2.0, nees_orientation=3.1)
    too_sure = Quality(0.01, 0.6, nees_position=9.0, nees_orientation=3.0)
    assert accurate.no_worse_than(theirs)
    assert not too_sure.no_worse_than(theirs)
    found = {metric.key: metric for metric in best({"a": accurate, "b": too_sure}, theirs)}
    assert (found["best.position"].value, found["best.position"].bar) == (0.01, 0.03)
    assert (found["best.orientation"].value, found["best.orientation"].bar) == (0.2, 0.5)
    assert found["no_worse_in_all"].value == 1
    assert not any(metric.meets_bar for metric in best({"b": too_sure}, accurate)[1:])


def test_growth_is_that_of_the_last_quarter_over_the_second() -> None:
    flat, growing = np.full(101, 7.0), np.arange(1.0, 102.0)
    assert cost_over_time.last_over_second_quarter(flat) == 1.0
    assert cost_over_time.last_over_second_quarter(growing) == pytest.approx(89 / 38)
    series = {
        "ms_backend": np.array([1.0, 9.0, 1.0, 8.0]),
        "ms_backend.smoother": np.array([NAN, 8.0, NAN, 7.0]),
    }
    assert cost_over_time.stepped_ms(series).tolist() == [9.0, 8.0]


@pytest.mark.parametrize(("scale", "met"), [(0.5, True), (1.0, True), (1.6, False)])
def test_monte_carlo_accepts_a_right_or_careful_covariance(scale: float, met: bool) -> None:
    rng = np.random.default_rng(3)
    dof = {"orientation": 3, "position": 3, "pose": 6}
    runs = [
        {f"nees_{part}": scale * rng.chisquare(k, 200) for part, k in dof.items()}
        for _ in range(monte_carlo.SEEDS)
    ]
    judged = [m for m in monte_carlo.consistency(runs) if m.bar is not None]
    assert len(judged) == len(dof)
    assert all(metric.meets_bar is met for metric in judged)
    assert not any(metric.meets_bar for metric in monte_carlo.consistency([]))


@pytest.mark.parametrize(("scale", "met"), [(0.5, True), (1.0, True), (2.0, False)])
def test_a_combination_of_policies_may_be_careful_but_not_too_sure(scale: float, met: bool) -> None:
    rng = np.random.default_rng(3)
    runs = [{"nees_pose": scale * rng.chisquare(6, 80)} for _ in policy_product.SEEDS]
    assert policy_product.pose_nees(runs).meets_bar is met
    assert not policy_product.pose_nees([]).meets_bar


def test_each_combination_of_policies_is_measured_under_its_own_name() -> None:
    names = [algorithm.name for algorithm in policy_product.product()]
    assert len(set(names)) == len(names)
    assert {name.split("-")[0] for name in names} >= {"most_recent", "evenly_spaced", "keyframes"}


def test_a_run_is_missed_if_it_is_harmed_and_ends_well_and_held_out_ones_count_apart() -> None:
    good, small, large = Errors(0.01, 0.5, 20.0), Errors(0.02, 2.9, 20.0), Errors(0.01, 3.1, 20.0)
    found = {t: verdict.Judged("ok", "", good, 400) for t in verdict.good_trials()}
    for clean, wrong in verdict.wrong_trials():
        found[clean] = verdict.Judged("ok", "", good, 400)
        found[wrong] = verdict.Judged("ok", "", small, 400)
    seen, unseen, apart = (
        next(
            w for _, w in verdict.wrong_trials() if w.held_out == held and w.wrong.startswith(what)
        )
        for what, held in (("baseline", False), ("clock", False), ("clock", True))
    )
    found[seen] = verdict.Judged("suspect", "slam-graph doctor", large, 400)
    found[unseen] = found[apart] = verdict.Judged("ok", "", large, 400)
    found[verdict.good_trials()[0]] = verdict.Judged("suspect", "", good, 400)
    figures = {m.key: m for m in verdict.summed_up(found).metrics}
    assert figures["chosen_on.harmed"].value == 2
    assert figures["chosen_on.missed"].value == 1
    assert figures["held_out.missed"].value == 1
    assert figures["held_out.missed"].held_out
    assert figures["held_out.false_alarms"].value == 0.0
    alarms = figures["chosen_on.false_alarms"].value * figures["chosen_on.good"].value
    assert alarms == pytest.approx(1.0)


@pytest.mark.slow
def test_a_long_flight_is_measured_in_a_process_of_its_own() -> None:
    table = speed.worker("benchmarks.memory_worker", "msckf", "1")
    assert table["frames"] == 11
    assert 50.0 < table["peak_mb"] < 1000.0
