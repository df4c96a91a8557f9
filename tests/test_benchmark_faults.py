# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the benchmark of faults says of a run: in words, and in standard deviations."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import documents, faults
from benchmarks.baseline import updated
from benchmarks.faults import AT_S, BACK_S, Off, RunPath, Survived, in_words, said_by
from benchmarks.metric import info
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import Similarity, Trajectory

START_NS = 1_403_636_579_763_555_584
SIGMA_M = 0.02
AFTER_S = AT_S + BACK_S


def flown(shift_sigmas: float = 0.0) -> RunPath:
    """A turning flight with a right covariance, shifted by so many σ from the fault on."""
    seconds = np.arange(1.0, 17.0, 0.05)
    positions = np.column_stack([np.cos(seconds), np.sin(2.0 * seconds), 0.1 * seconds])
    turns = Rotation.from_rotvec(0.3 * positions).as_quat()
    truth = Trajectory(START_NS + np.round(seconds * 1e9).astype(np.int64), positions, turns)
    moved = positions + np.outer(seconds >= AT_S, [0.0, shift_sigmas * SIGMA_M, 0.0])
    variances = np.diag([1e-4] * 3 + [SIGMA_M**2] * 3)
    covariances = np.broadcast_to(variances, (len(seconds), 6, 6)).copy()
    return RunPath(replace(truth, positions=moved), covariances, truth, START_NS)


def survived(path: RunPath | None) -> Survived:
    """A run in one segment."""
    return Survived("ok", 0.01, (0.01,), 0.0, path=path)


@pytest.mark.parametrize("shift", [0.0, 2.5, 7.0])
def test_an_error_is_counted_in_sigmas_whatever_yaw_and_position_the_world_has(
    shift: float,
) -> None:
    world = Similarity(Rotation.from_euler("z", 1.1).as_matrix(), np.array([3.0, -2.0, 5.0]))
    for where in (Similarity.identity(), world):
        clean, path = (
            survived(replace(p, estimate=where.apply(p.estimate))) for p in (flown(), flown(shift))
        )
        off = Off.after(path, clean, 0.0)
        assert off.error == pytest.approx(shift, abs=1e-6)
        assert (off.clean, off.factor) == (pytest.approx(0.0, abs=1e-6), 1.0)
        assert off.within is (shift <= 3.0)
        assert path.path is not None
        assert clean.path is not None
        onto = clean.path.onto_truth()
        assert path.path.sigmas(onto, AT_S - 1.0) == pytest.approx(0.0, abs=1e-6)
        assert np.isnan(path.path.sigmas(onto, 40.0))


def test_the_bar_grows_with_the_error_that_is_there_without_a_fault() -> None:
    clean = survived(flown())
    assert clean.path is not None
    noise = np.random.default_rng(0).normal(0.0, 2.0 * SIGMA_M, (len(clean.path.estimate), 3))
    noisy = replace(
        clean.path,
        estimate=replace(clean.path.estimate, positions=clean.path.estimate.positions + noise),
    )
    off = Off.after(survived(flown(5.0)), survived(noisy), 0.0)
    assert off.factor == pytest.approx(2.0, rel=0.1)
    assert off.clean > 3.0
    assert off.within
    assert not replace(off, clean=2.9).within
    assert not Off.after(survived(flown(7.0)), survived(noisy), 0.0).within
    assert not Off.after(survived(None), clean, 0.0).within


def test_a_run_is_back_in_one_segment_by_its_error_and_in_a_new_one_in_time() -> None:
    good, bad = survived(flown(1.0)), survived(flown(60.0))
    again = replace(bad, segments_m=(0.01, 0.01), recovered_s=2.0)
    cases = ((good, True), (bad, False), (again, True), (replace(again, recovered_s=6.0), False))
    for run, back in cases:
        figures = {m.key: m for m in faults.figures_of(run, survived(flown()), 0.0)}
        assert figures["back"].meets_bar is back


def test_what_is_said_is_heard_once_a_kind_and_the_log_is_as_before() -> None:
    logger = logging.getLogger("slam_graph")
    before = (logger.level, logger.propagate, list(logger.handlers))
    diagnostics = Diagnostics()
    with faults._heard() as said:
        for number in range(7):
            diagnostics.warn("imu_gap", f"gap {number}")
        diagnostics.warn("few_features", "3 of 90: too few")
        logger.warning("compiling kernels: once")
        logger.error("lost: that is the message of the run")
    assert said == {"imu_gap": "gap 0", "few_features": "3 of 90: too few"}
    assert (logger.level, logger.propagate, list(logger.handlers)) == before


def test_words_have_seconds_for_stamps_and_no_folder() -> None:
    folder = Path("/somewhere/euroc/MH_01")
    text = f"{folder}/cam0/a.png: lost at frame {START_NS + 7_210_000_000}: after {START_NS} ns"
    assert in_words(text, START_NS, folder) == "cam0/a.png: lost at t = 7.2 s: after t = 0.0 s"
    assert in_words("20 of 194, 2.345 s", START_NS, folder) == "20 of 194, 2.345 s"


def test_a_run_tells_what_the_run_without_a_fault_does_not() -> None:
    clean = replace(survived(None), said={"image_unreadable": "one"})
    run = replace(
        clean, said={**clean.said, "imu_gap": "a", "few": "b"}, counts={"imu_gap": 12, "few": 1}
    )
    assert said_by(clean, clean) == ""
    assert said_by(run, clean) == "`imu_gap` (12 ×): a; `few`: b"
    assert said_by(replace(run, message="lost"), clean).endswith("`few`: b; lost")


@pytest.mark.parametrize(
    ("text", "short"),
    [
        ("IMU sample of t = 7.0 s: no sample for 1 s before t = 7.0 s", "no sample for 1 s before"),
        ("IMU sample of t = 6.0 s: dropped, not finite", "IMU sample of t = 6.0 s: dropped"),
        ("IMU sample at t = 6.0 s left out, stuck: gyroscope 0, 0, 0 rad/s", "IMU sample at t"),
    ],
)
def test_a_line_of_a_table_says_a_time_once_and_no_values(text: str, short: str) -> None:
    clean = survived(None)
    said = said_by(replace(clean, said={"few": text}), clean)
    assert said.startswith(f"`few`: {short}")
    assert said.count("t = ") == 1
    assert "gyroscope" not in said


def test_each_fault_has_a_line_with_what_was_said() -> None:
    clean, run = survived(flown()), replace(survived(flown(2.0)), said={"few": "a | b"})
    keys = {f"x.{faults.fault_key(name)}.{documents.TOLD}": name for name in ("one", "two, 3 s")}
    metrics = [m.under(key) for key in keys for m in faults.figures_of(run, clean, 0.0)]
    for figure, value in (("error", 0.01), ("sigma_factor", 1.5)):
        metrics.append(info(f"x.none.{documents.TOLD}.{figure}", value, ""))
    texts = {f"{key}.{part}": t for key in keys for part, t in (("status", "ok"), ("said", ""))}
    texts[f"{next(iter(keys))}.said"] = said_by(run, clean)
    baseline = updated({}, metrics, {"x"}, texts)
    rows = list(documents._told(documents.Figures(baseline), "x", keys.values()))[3:]
    assert [row.split(" | ")[0] for row in rows] == ["| one", "| two, 3 s"]
    assert r"`few`: a \| b" in rows[0]
    assert "nothing" in rows[1]
    assert "10.0 → 10.0" in rows[0]
    assert "2.0 σ" in rows[0]
