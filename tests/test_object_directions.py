# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Objects before one camera: a direction and its rate, and nothing in metres."""

import json
from pathlib import Path

import numpy as np
import pytest

from slam_graph.cli.run import echo_summary
from slam_graph.pipeline import run
from slam_graph.results import RunResult
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulator import simulate

SIGMA_PX = 0.5


@pytest.fixture(scope="module")
def flight() -> SimulatedSequence:
    return simulate(
        duration_s=6.0,
        rate_hz=10.0,
        seed=0,
        cameras=1,
        tracks={"pixel_sigma": SIGMA_PX},
        objects={"count": 1},
    )


@pytest.fixture(scope="module")
def found(flight: SimulatedSequence) -> RunResult:
    changes = {"objects.enabled": True, "backend.noise.pixel_sigma": SIGMA_PX}
    return run(flight, overrides=changes)


def test_an_object_is_seen_where_it_is(flight: SimulatedSequence, found: RunResult) -> None:
    """Its tracks are on the side that the camera sees, so their mean is beside its middle."""
    (body,) = flight.bodies
    assert found.objects is not None
    directions = found.objects.directions
    assert {seen.number for seen in directions} == {1}
    assert len(directions) > 40
    camera, offset_ns = flight.rig.cameras[0].body_T_camera, round(flight.rig.pose_offset_s * 1e9)
    errors = []
    for seen in directions:
        stamp_ns = seen.stamp_ns + offset_ns
        eye = flight.groundtruth().at(stamp_ns).compose(camera).translation()
        truth = body.pose(stamp_ns)[1] - eye
        cosine = float(seen.direction @ truth / np.linalg.norm(truth))
        errors.append(np.degrees(np.arccos(min(cosine, 1.0))))
        assert np.linalg.norm(seen.direction) == pytest.approx(1.0)
        assert abs(float(seen.direction @ seen.rate)) < 0.2 * np.linalg.norm(seen.rate)
    assert np.median(errors) < 3.0
    assert max(errors) < 8.0


def test_nothing_is_said_in_metres(
    found: RunResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written = found.save(tmp_path)
    echo_summary(found, tmp_path, written)
    (line,) = (row for row in capsys.readouterr().out.splitlines() if row.startswith("moving"))
    assert "m/s" not in line
    assert "scale is not known" in line
    files = {path.relative_to(tmp_path).as_posix() for path in written}
    assert not any(name.startswith(("objects.csv", "objects/")) for name in files)
    head, *rows = (tmp_path / "object_directions.csv").read_text("utf-8").splitlines()
    assert "_m" not in head
    assert found.objects is not None
    assert len(rows) == len(found.objects.directions)
    table = json.loads((tmp_path / "metrics.json").read_text("utf-8"))["moving_objects"]
    assert table["scale"] == "unknown"
    assert set(table) == {"scale", "directions", "ms_per_frame"}
    assert len(found.objects) == 0


def test_nothing_is_found_where_nothing_moves() -> None:
    sequence = simulate(
        duration_s=4.0, rate_hz=10.0, seed=1, cameras=1, tracks={"pixel_sigma": SIGMA_PX}
    )
    changes = {"objects.enabled": True, "backend.noise.pixel_sigma": SIGMA_PX}
    result = run(sequence, overrides={**changes, "final_ba.enabled": False})
    assert result.objects is not None
    assert result.objects.directions == []
