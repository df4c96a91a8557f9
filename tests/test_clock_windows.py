# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A time offset that changes in the course of a recording is noticed, whatever it is."""

import re
from collections.abc import Mapping

import numpy as np
import pytest
from groups import slow

import slam_graph as sg
from slam_graph.config import load_config
from slam_graph.datasets.faults.injection import inject
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.diagnosis import Diagnosis
from slam_graph.diagnosis.clock_windows import ClockWindow, ClockWindows
from slam_graph.diagnosis.finding import Finding
from slam_graph.diagnosis.gathering import Part
from slam_graph.diagnostics import Diagnostics
from slam_graph.pipeline.clock_watch import ClockWatch
from slam_graph.pipeline.stage import EstimatedFrame, NoObjects
from slam_graph.results import RunInput, RunResult
from slam_graph.sensors import FeatureFrame, ImuData

WINDOW_S = ClockWindows.LENGTH_NS * 1e-9
CHANGES_S = 10.0


def windows(
    fault: str = "", duration_s: float = 24.0, readout_s: float | None = None
) -> ClockWindows:
    """The windows of a flight, one after another."""
    flight = sg.simulate(
        trajectory="random",
        duration_s=duration_s,
        rate_hz=10.0,
        seed=3,
        shutter_readout_s=readout_s,
    )
    packets = list((inject(flight, [fault]) if fault else flight).packets())
    frames = [p.frame for p in packets if isinstance(p.frame, FeatureFrame)]
    found = ClockWindows.of(
        flight.rig, [Part(frames, ImuData.concatenate([p.imu for p in packets]))]
    )
    assert len(list(found)) == round(duration_s / WINDOW_S)
    return found


def first(found: ClockWindows) -> ClockWindow:
    return next(iter(found))


def between_s(values: Mapping[str, object]) -> tuple[float, float]:
    """The times between which a finding says that the offset changes."""
    between = values["between_s"]
    assert isinstance(between, list)
    return between[0], between[1]


@pytest.mark.parametrize(("by_s", "readout_s"), [(0.03, None), slow(-0.03, 0.03), (0.08, None)])
def test_the_offset_of_each_window_is_found(by_s: float, readout_s: float | None) -> None:
    """As in the calibration, also where its rows are exposed one after the other."""
    found = windows(f"imu_late:at_s={CHANGES_S},by_s={by_s}", readout_s=readout_s)
    for window, late_s in zip(list(found)[::2], (0.0, by_s), strict=True):
        assert abs(window.offset_s - late_s) < 4.0 * window.sigma_s
        assert window.sigma_s < 2.5e-3
    change = found.change(first(found).begin_ns)
    assert change is not None
    assert change.values["change_s"] == pytest.approx(by_s, abs=0.012)


def test_an_offset_that_stays_is_no_change() -> None:
    for fault in ("", "imu_late:at_s=0,by_s=0.03"):
        found = windows(fault, duration_s=16.0)
        assert found.change(first(found).begin_ns) is None


@pytest.mark.parametrize("late_from_s", [7.0, slow(9.0), 11.0, slow(13.0), 15.0])
def test_a_change_is_where_it_is_said_to_be(late_from_s: float) -> None:
    found = windows(f"imu_late:at_s={late_from_s},by_s=0.03")
    change = found.change(first(found).begin_ns)
    assert change is not None
    begin_s, end_s = between_s(change.values)
    assert begin_s < late_from_s < end_s <= begin_s + WINDOW_S + 0.1


def watched(
    flight: RecordedSequence, lost_s: tuple[float, float] | None, noticed_s: float
) -> list[Finding]:
    """What a watch over a flight finds whose estimate is lost, as is noticed at a frame."""
    info = flight.info()
    asked = RunInput(info, load_config(), flight.rig, info.start_ns, info.end_ns)
    result, diagnostics = RunResult(asked), Diagnostics()
    watch, none = ClockWatch(result, NoObjects(), diagnostics), np.zeros(0, np.int64)
    for packet in flight.packets():
        features = packet.frame
        assert isinstance(features, FeatureFrame)
        losses = result.segments.losses
        if lost_s and not losses and features.stamp_ns >= info.start_ns + noticed_s * 1e9:
            begin_ns, end_ns = (info.start_ns + round(at_s * 1e9) for at_s in lost_s)
            losses.append((begin_ns, end_ns))
        watch.add(
            EstimatedFrame(packet, features, None, none, np.zeros((0, 3)), none, (1.0, 1.0), True)
        )
    found = watch.finish().findings
    assert not diagnostics.counts
    return found


def test_windows_before_and_after_a_loss_are_compared() -> None:
    """Those that reach into it are not: neither with what was before nor with what comes."""
    flight = sg.simulate(trajectory="random", duration_s=26.0, rate_hz=10.0, seed=3)
    late = inject(flight, ["imu_late:at_s=9,by_s=0.03"])
    (whole,) = watched(late, None, 0.0)
    assert between_s(whole.values) == pytest.approx((4.0, 12.0), abs=0.2)
    (across,) = watched(late, (9.0, 16.5), 16.5)
    assert between_s(across.values) == pytest.approx((4.0, 20.5), abs=0.3)
    assert across.values["change_s"] == pytest.approx(0.03, abs=0.006)
    assert not watched(late, (7.0, 16.5), 16.5), "nothing is left before it"
    assert not watched(late, (9.0, 25.9), 25.9), "nothing comes after it"


def test_frames_without_features_are_not_looked_at() -> None:
    """They neither begin a window nor fill it, and their samples are not kept."""
    flight = sg.simulate(trajectory="random", duration_s=26.0, rate_hz=10.0, seed=3)
    late = inject(flight, ["imu_late:at_s=9,by_s=0.03", "camera_lost:at_s=0,duration_s=2,camera=0"])
    (found,) = watched(late, None, 0.0)
    assert between_s(found.values) == pytest.approx((6.0, 14.0), abs=0.2)


def test_what_is_plainer_comes_before_a_change() -> None:
    """And a single offset of the whole recording not at all."""
    kinds = ["gyroscope_unit", "time_offset", "focal_length"]
    found = Diagnosis([Finding(kind, "error", kind) for kind in kinds])
    change = Diagnosis([Finding("time_offset_change", "error", "it changes")])
    together = [finding.kind for finding in found.with_clocks(change).findings]
    assert together == ["gyroscope_unit", "time_offset_change", "focal_length"]
    assert found.with_clocks(Diagnosis([])).findings == found.findings


@pytest.mark.slow
def test_doctor_names_a_change() -> None:
    """And no single offset of the whole recording."""
    flight = sg.simulate(trajectory="random", duration_s=20.0, rate_hz=10.0, seed=3)
    for fault, named in (([], []), (["imu_late:at_s=9,by_s=0.03"], ["time_offset_change"])):
        diagnosis = Diagnosis.of(inject(flight, fault))
        assert [finding.kind for finding in diagnosis.setup_faults] == named


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late_from_s", "seconds", "between"), [(9, 20.0, "4 and 12"), (33, 44.0, r"2\d and 3\d")]
)
def test_a_run_whose_clocks_change_uncorrected_is_suspect(
    late_from_s: int, seconds: float, between: str
) -> None:
    """Also after all frames that the rest of the verdict looks at."""
    flight = sg.simulate(trajectory="random", duration_s=seconds, rate_hz=10.0, cameras=2, seed=1)
    late = inject(flight, [f"imu_late:at_s={late_from_s},by_s=0.03"])
    kept = "backend.initialization.check_calibration=false", "final_ba.enabled=false"
    result = sg.run(late, algorithm="okvis", overrides=kept)
    assert result.status == "suspect", result.message
    assert re.search(
        r"the time offset between camera and IMU changes by (2|3)\d\.\d ± \d\.\d ms "
        rf"between t = {between} s, from -?\d\.\d to (2|3)\d\.\d ms",
        result.message,
    )
