# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A time offset that changes in the course of a recording is noticed, whatever it is."""

import pytest

import slam_graph as sg
from slam_graph.datasets.faults.injection import inject
from slam_graph.diagnosis import Diagnosis
from slam_graph.diagnosis.clock_windows import ClockWindow, ClockWindows
from slam_graph.diagnosis.gathering import Part
from slam_graph.sensors import FeatureFrame, ImuData

WINDOW_S = 8.0
CHANGES_S = 10.0


def windows(fault: str = "", seed: int = 3, duration_s: float = 24.0) -> ClockWindows:
    """The windows of a flight, one after another."""
    flight = sg.simulate(trajectory="random", duration_s=duration_s, rate_hz=10.0, seed=seed)
    packets = list((inject(flight, [fault]) if fault else flight).packets())
    frames = [p.frame for p in packets if isinstance(p.frame, FeatureFrame)]
    found = ClockWindows.of(
        flight.rig, [Part(frames, ImuData.concatenate([p.imu for p in packets]))]
    )
    assert len(list(found)) == round(duration_s / WINDOW_S)
    return found


def first(found: ClockWindows) -> ClockWindow:
    return next(iter(found))


@pytest.mark.parametrize("by_s", [0.03, -0.03, 0.08])
def test_the_offset_of_each_window_is_found(by_s: float) -> None:
    found = windows(f"imu_late:at_s={CHANGES_S},by_s={by_s}")
    for window, late_s in zip(list(found)[::2], (0.0, by_s), strict=True):
        assert abs(window.offset_s - late_s) < 4.0 * window.sigma_s
        assert window.sigma_s < 2.5e-3
    change = found.change([], first(found).begin_ns)
    assert change is not None
    at_s = change.values["at_s"]
    assert isinstance(at_s, float)
    assert abs(at_s - CHANGES_S) <= WINDOW_S


def test_an_offset_that_stays_is_no_change() -> None:
    for fault in ("", "imu_late:at_s=0,by_s=0.03"):
        found = windows(fault, duration_s=16.0)
        assert found.change([], first(found).begin_ns) is None


def test_what_was_lost_does_not_count() -> None:
    found = windows(f"imu_late:at_s={CHANGES_S},by_s=0.03")
    begin_ns = first(found).begin_ns
    lost = [(begin_ns, begin_ns + round(2 * WINDOW_S * 1e9))]
    assert found.change(lost, begin_ns) is None


def test_doctor_names_a_change() -> None:
    """And no single offset of the whole recording."""
    flight = sg.simulate(trajectory="random", duration_s=20.0, rate_hz=10.0, seed=3)
    for fault, named in (([], []), (["imu_late:at_s=9,by_s=0.03"], ["time_offset_change"])):
        diagnosis = Diagnosis.of(inject(flight, fault))
        assert [finding.kind for finding in diagnosis.setup_faults] == named


def test_a_run_whose_clocks_change_is_suspect() -> None:
    flight = sg.simulate(trajectory="random", duration_s=20.0, rate_hz=10.0, cameras=2, seed=1)
    late = inject(flight, ["imu_late:at_s=9,by_s=0.03"])
    result = sg.run(late, algorithm="okvis", overrides=("final_ba.enabled=false",))
    assert result.status == "suspect", result.message
    assert "the time offset between camera and IMU changes at about t = 8 s" in result.message
