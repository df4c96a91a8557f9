# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes in Rerun: those of the recording, in their own world, as good as they say."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from rerun.chunk import RrdReader
from rerun_rows import Row, colour, rows_of
from scipy.spatial.transform import Rotation

import slam_graph as sg
from slam_graph.arrays import FloatArray
from slam_graph.backend import BackendConfig, Estimator
from slam_graph.datasets import Sequence
from slam_graph.geometry import interpolate
from slam_graph.results import RunResult
from slam_graph.sensors import AidingData
from slam_graph.visualization import RerunRecording
from slam_graph.visualization.rerun_blueprints import GROWING
from slam_graph.visualization.rerun_fixes import (
    FIX_SIGMA,
    FIXES,
    POSE_AXES,
    POSE_SIGMA,
    POSES,
    FixLog,
    FixViews,
    KnownPoseLog,
)
from slam_graph.visualization.rerun_palette import ORANGE, VERMILLION
from slam_graph.visualization.rerun_stream import RerunStream


def drive(duration_s: float = 40.0) -> Sequence:
    """A car without an IMU, every fifth of whose fixes is off by 10 m."""
    return sg.simulate(
        trajectory="car",
        duration_s=duration_s,
        with_imu=False,
        seed=1,
        tracks={"features": 60},
        gnss={"sigma_m": 1.0, "multipath": 0.2},
    )


def fixes_of(sequence: Sequence) -> AidingData:
    """All of a recording."""
    return AidingData.concatenate(p.aiding for p in sequence.packets() if p.aiding is not None)


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunResult, Mapping[str, list[Row]]]:
    path = tmp_path_factory.mktemp("fixes") / "fixes.rrd"
    viewer = RerunRecording("save", "fixes", path).viewer()
    result = sg.run(drive(), viewer=viewer, final_ba={"enabled": False})
    assert not result.warnings["viewer_failed"]
    return result, rows_of(path)


def shown(rows: Mapping[str, list[Row]]) -> tuple[FloatArray, list[tuple[int, int, int]]]:
    """Places (N, 3) and colours of the fixes that are shown."""
    (entity,) = (name for name in rows if name.endswith(f"/{FIXES}"))
    places = np.concatenate([row["positions"] for row in rows[entity]])
    return places, [colour(packed) for row in rows[entity] for packed in row["colors"]]


@pytest.mark.slow
def test_all_fixes_are_in_the_world_of_the_fixes(
    watched: tuple[RunResult, Mapping[str, list[Row]]],
) -> None:
    _, rows = watched
    assert f"/world/{FIXES}" not in rows, "the world of the beginning is not that of the fixes"
    (entity,) = (name for name in rows if name.endswith(f"/{FIXES}"))
    world = entity.removesuffix(f"/{FIXES}")
    places, _ = shown(rows)
    # the first row has those from before the alignment, which began this world
    begun = len(rows[entity][0]["positions"])
    assert begun > 3
    assert f"/world_from_{rows[entity][0]['frame']}" == world
    np.testing.assert_allclose(places, fixes_of(drive()).fix_positions, rtol=1e-6)
    path = np.concatenate([row["translation"] for row in rows[f"{world}/body"]])
    assert np.median(np.linalg.norm(places[begun:, None] - path, axis=2).min(axis=1)) < 2.0


@pytest.mark.slow
def test_fixes_that_the_gate_rejects_are_red(
    watched: tuple[RunResult, Mapping[str, list[Row]]],
) -> None:
    _, rows = watched
    places, colours = shown(rows)
    (entity,) = (name for name in rows if name.endswith(f"/{FIXES}"))
    begun = len(rows[entity][0]["positions"])
    red = np.array([seen == VERMILLION for seen in colours])
    assert set(colours) == {ORANGE, VERMILLION}
    assert not red[:begun].any(), "those that told where the world is went through no gate"
    truth = drive().groundtruth()
    assert truth is not None
    near, valid = interpolate(truth, fixes_of(drive()).fix_stamps_ns, 1.0)
    # the truth and the fixes are of one world here
    error = np.linalg.norm(places[valid] - near.positions, axis=1)[begun:]
    later = red[valid][begun:]
    assert later.sum() >= 2
    assert error[later].min() > 5.0 > np.median(error[~later])


@pytest.mark.slow
def test_without_use_of_the_fixes_none_are_shown(tmp_path: Path) -> None:
    viewer = RerunRecording("save", "unused", tmp_path / "unused.rrd").viewer()
    off = {"backend.gnss.enabled": False, "final_ba.enabled": False}
    result = sg.run(drive(10.0), viewer=viewer, overrides=off)
    assert not result.warnings["viewer_failed"]
    assert not any(FIXES in name.split("/") for name in rows_of(tmp_path / "unused.rrd"))


@pytest.mark.slow
def test_a_saved_run_shows_the_fixes_of_its_recording(
    watched: tuple[RunResult, Mapping[str, list[Row]]], tmp_path: Path
) -> None:
    result, _ = watched
    assert result.metrics["world"]["of_fixes"]
    with RerunRecording("save", "saved", tmp_path / "saved.rrd") as recording:
        recording.show_run(
            result, np.zeros((0, 3)), {}, rig=result.causal_rig, recording=drive(), images=False
        )
    places, colours = shown(rows_of(tmp_path / "saved.rrd"))
    estimated = fixes_of(drive()).within(None, int(result.trajectory.stamps_ns[-1]))
    np.testing.assert_allclose(places, estimated.fix_positions[-len(places) :], rtol=1e-6)
    assert len(places) > 30
    assert set(colours) == {ORANGE}, "files do not say which were rejected"
    entities = {str(chunk.entity_path) for chunk in RrdReader(tmp_path / "saved.rrd").stream()}
    assert "/world/gravity" not in entities, "without an IMU nothing tells where it points"
    assert "/world/path/causal" in entities


def test_ellipsoids_are_the_covariances(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    axes = rng.normal(size=(20, 3, 3))
    covariances = axes @ axes.transpose(0, 2, 1) + 1e-3 * np.eye(3)
    places = rng.normal(scale=50.0, size=(20, 3))
    stream = RerunStream("save", "fixes", tmp_path / "fixes.rrd")
    log = FixLog(stream, "world")
    stream.at(0, 0)
    log.add(places, covariances, np.zeros(20, np.bool_))
    stream.close()
    (row,) = rows_of(tmp_path / "fixes.rrd")[f"/world/{FIX_SIGMA}"]
    np.testing.assert_allclose(row["centers"], places, rtol=1e-6)
    R = Rotation.from_quat(row["quaternions"]).as_matrix()
    variances = np.square(row["half_sizes"])
    again = np.einsum("nij,nj,nkj->nik", R, variances, R)
    np.testing.assert_allclose(again, covariances, rtol=1e-4, atol=1e-4)
    assert {FIXES, FIX_SIGMA} <= set(GROWING), "or the viewer shows the last one only"


def test_known_poses_of_a_run_are_shown_in_their_world(tmp_path: Path) -> None:
    flight = sg.simulate(
        duration_s=8.0,
        tracks={"features": 60},
        known_poses={"position_sigma_m": 0.02, "rate_hz": 2.0},
    )
    viewer = RerunRecording("save", "poses", tmp_path / "poses.rrd").viewer()
    result = sg.run(flight, viewer=viewer, final_ba={"enabled": False})
    assert not result.warnings["viewer_failed"]
    rows = rows_of(tmp_path / "poses.rrd")
    (entity,) = (name for name in rows if name.endswith(f"/{POSES}"))
    places = np.concatenate([row["positions"] for row in rows[entity]])
    known = fixes_of(flight).within(None, int(result.trajectory.stamps_ns[-1]))
    np.testing.assert_allclose(places, known.pose_positions[-len(places) :], rtol=1e-5, atol=1e-6)
    assert len(places) > 8
    assert not any(name.endswith(f"/{FIXES}") for name in rows)


@pytest.mark.slow
def test_a_saved_run_shows_only_what_it_used(tmp_path: Path) -> None:
    """Like the run that is watched: no fixes where they are not used."""
    flight = sg.simulate(
        duration_s=8.0,
        tracks={"features": 60},
        gnss={},
        known_poses={"position_sigma_m": 0.02, "rate_hz": 2.0},
    )
    off = {"backend.gnss.enabled": False, "final_ba.enabled": False}
    result = sg.run(flight, overrides=off)
    assert result.metrics["world"]["of_fixes"]
    with RerunRecording("save", "used", tmp_path / "used.rrd") as recording:
        recording.show_run(
            result, np.zeros((0, 3)), {}, rig=result.causal_rig, recording=flight, images=False
        )
    names = {name.split("/")[-1] for name in rows_of(tmp_path / "used.rrd")}
    assert POSES in names
    assert FIXES not in names


def test_axes_and_ellipsoids_of_known_poses_are_what_was_measured(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    sigmas = rng.uniform(0.01, 0.1, (6, 6))
    sigmas[1, 3:], sigmas[2, :3] = np.inf, np.inf  # a place without orientation, and the reverse
    places, turns = rng.normal(size=(6, 3)), Rotation.random(6, random_state=1)
    data = AidingData.empty().with_poses(np.arange(6), places, turns.as_quat(), sigmas)
    stream = RerunStream("save", "poses", tmp_path / "poses.rrd")
    stream.at(0, 0)
    KnownPoseLog(stream, "world").add(data, np.arange(6) == 4)
    stream.close()
    rows = rows_of(tmp_path / "poses.rrd")
    placed, both = [0, 1, 3, 4, 5], [0, 3, 4, 5]
    (points,), (ellipsoids,), (axes,) = (
        rows[f"/world/{name}"] for name in (POSES, POSE_SIGMA, POSE_AXES)
    )
    np.testing.assert_allclose(points["positions"], places[placed], rtol=1e-6)
    reds = [colour(packed) == VERMILLION for packed in points["colors"]]
    assert reds == [False, False, False, True, False]
    sizes = np.sort(ellipsoids["half_sizes"], axis=1)
    np.testing.assert_allclose(sizes, np.sort(sigmas[placed, :3], axis=1), rtol=1e-5)
    vectors = np.reshape(axes["vectors"], (-1, 3, 3))
    unit = vectors / np.linalg.norm(vectors, axis=2, keepdims=True)
    np.testing.assert_allclose(unit, turns[both].as_matrix().transpose(0, 2, 1), atol=1e-6)
    assert {POSES, POSE_SIGMA, POSE_AXES} <= set(GROWING), "or the viewer shows the last one only"


@pytest.mark.parametrize("estimated", [False, True])
def test_fixes_are_shown_with_the_state_of_their_time(tmp_path: Path, estimated: bool) -> None:
    """The state is 0.2 s later than the stamp of its frame; 0.1 s if the offset is estimated."""
    plain = drive(1.0).rig
    late = replace(plain.cameras[0], time_offset_s=0.2)
    estimator = cast(
        Estimator,
        SimpleNamespace(
            rig=replace(plain, cameras=(late,)),
            solved_ns=10**9,
            times_ns={10**9: 1_100_000_000} if estimated else {},
            config=BackendConfig(),
            aiding=SimpleNamespace(
                gates=defaultdict(lambda: SimpleNamespace(tested=0, rejected=0))
            ),
        ),
    )
    stamps_ns = np.array([1_050_000_000, 1_150_000_000, 1_250_000_000])
    data = AidingData.empty().with_poses(
        stamps_ns, np.zeros((3, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)), np.ones((3, 6))
    )
    stream = RerunStream("save", "poses", tmp_path / "poses.rrd")
    views = FixViews(stream)
    views._take(data, estimator)
    stream.close()
    ((taken, _, _),) = views._taken
    assert taken.pose_stamps_ns.tolist() == stamps_ns[: 1 if estimated else 2].tolist()
