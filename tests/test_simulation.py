# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of simulated feature tracks, and the settings of a simulation."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from flight import FISHEYE, FORWARD
from numpy.typing import NDArray
from pydantic import BaseModel
from recordings_public import as_tum_vi
from simulated_tracks import SHAPES, tracks

from slam_graph.datasets.formats.euroc_writer import EurocWriter
from slam_graph.errors import ConfigError, DataError
from slam_graph.sensors.measurements import FeatureFrame
from slam_graph.sensors.rig import Rig, RigCamera
from slam_graph.simulation.landmarks import on_walls
from slam_graph.simulation.simulated_sequence import SimulatedTracks
from slam_graph.simulation.simulation_config import (
    SimulationConfig,
    TrackConfig,
)
from slam_graph.simulation.simulator import euroc_rig, simulate
from slam_graph.simulation.track_simulation import TrackSimulator
from slam_graph.simulation.world import box, three_rooms


def frames(sequence: SimulatedTracks) -> list[FeatureFrame]:
    return list(sequence.frames())


def landmarks_of(sequence: SimulatedTracks, frame: FeatureFrame, camera: int) -> NDArray[Any]:
    """Points in the frame of a camera, for tracks that keep their landmarks' numbers."""
    at = np.array([frame.stamp_ns])
    motion = sequence.flight.motion
    R, p = motion.rotations(at).as_matrix()[0], motion.positions(at)[0]
    body_T_camera = sequence.rig.cameras[camera].body_T_camera.matrix()
    points = sequence.landmarks.at(frame.cameras[camera].ids, frame.stamp_ns)[0]
    return ((points - p) @ R - body_T_camera[:3, 3]) @ body_T_camera[:3, :3]


@pytest.mark.parametrize("shape", SHAPES)
def test_tracks_without_noise_are_projections_of_their_landmarks(shape: str) -> None:
    exact = {"pixel_sigma": 0.0, "keep_ids": True}
    sequence = tracks(trajectory=shape, tracks=exact, landmarks={"moving_points": 60})
    moving = 0
    for frame in frames(sequence)[::7]:
        for camera, seen in enumerate(frame.cameras):
            points = landmarks_of(sequence, frame, camera)
            assert np.all((points[:, 2] > 0.3) & (points[:, 2] < 40.0))
            model = sequence.rig.cameras[camera].camera
            np.testing.assert_allclose(seen.pixels, model.project(points), atol=1e-9)
            np.testing.assert_allclose(seen.normalized, points[:, :2] / points[:, 2:], atol=1e-9)
            assert np.all((seen.pixels >= 8) & (seen.pixels <= (751 - 8, 479 - 8)))
            moving += int(np.sum(seen.ids >= len(sequence.landmarks.points)))
    assert moving > 0 or shape != "figure8"  # the box flies past the camera there


def test_both_cameras_of_a_pair_see_the_same_points() -> None:
    sequence = tracks(tracks={"pixel_sigma": 0.0})
    left, right = sequence.rig.cameras
    left_T_right = left.body_T_camera.between(right.body_T_camera)
    t = left_T_right.translation()
    skew = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    E = skew @ left_T_right.rotation().matrix()
    for frame in frames(sequence)[::10]:
        first, second = frame.cameras
        common, i, j = np.intersect1d(first.ids, second.ids, return_indices=True)
        assert len(common) == len(second) > 0.8 * len(first)
        a = np.column_stack([first.normalized[i], np.ones(len(i))])
        b = np.column_stack([second.normalized[j], np.ones(len(j))])
        assert np.abs(np.einsum("ij,jk,ik->i", a, E, b)).max() < 1e-10


def test_the_number_of_features_is_kept_and_they_are_spread() -> None:
    sequence = tracks(tracks={"features": 80, "loss": 0.1}, duration_s=10.0)
    for frame in frames(sequence):
        seen = frame.cameras[0]
        assert len(seen) == 80
        assert len(np.unique(seen.ids)) == 80
        quarters = (seen.pixels[:, 0] > 376) + 2 * (seen.pixels[:, 1] > 240)
        assert np.bincount(quarters, minlength=4).min() >= 10


def lengths(sequence: SimulatedTracks) -> NDArray[np.int64]:
    ids = np.concatenate([frame.cameras[0].ids for frame in frames(sequence)])
    return np.unique(ids, return_counts=True)[1]


def test_tracks_are_lost_as_often_as_is_asked_for() -> None:
    still = {"flight": {"hover_s": 9.0}, "duration_s": 8.0}
    assert np.all(lengths(tracks(**still)) == 161)  # nothing moves: nothing is lost
    lossy = tracks(**still, tracks={"loss": 0.05})
    expected = 150 + 160 * 150 * 0.05
    assert len(lengths(lossy)) == pytest.approx(expected, rel=0.1)
    assert np.max(lengths(tracks(tracks={"max_length": 12}))) == 12


def test_a_lost_landmark_comes_back_with_a_new_identity_or_the_old_one() -> None:
    def gaps(keep: bool) -> int:
        held = {"loss": 0.05, "keep_ids": keep}
        found: dict[int, list[int]] = {}
        few = {"density": 1.0}
        for index, frame in enumerate(frames(tracks(tracks=held, landmarks=few))):
            for name in frame.cameras[0].ids.tolist():
                found.setdefault(name, []).append(index)
        return sum(np.ptp(seen) + 1 != len(seen) for seen in found.values())

    assert gaps(keep=False) == 0
    assert gaps(keep=True) > 10


def test_noise_and_outliers_are_of_the_size_that_is_asked_for() -> None:
    base = tracks(tracks={"pixel_sigma": 0.7, "outliers": 0.1, "keep_ids": True})
    errors = []
    for frame in frames(base):
        for camera, seen in enumerate(frame.cameras):
            model = base.rig.cameras[camera].camera
            errors.append(seen.pixels - model.project(landmarks_of(base, frame, camera)))
    residuals = np.concatenate(errors)
    wrong = np.linalg.norm(residuals, axis=1) > 5.0
    assert np.mean(wrong) == pytest.approx(0.1, rel=0.05)
    assert residuals[~wrong].std() == pytest.approx(0.7, rel=0.02)
    assert np.abs(residuals[~wrong].mean(axis=0)).max() < 0.02


def test_walls_hide_what_is_behind_them() -> None:
    world = three_rooms()
    eye = np.array([0.0, 0.0, 1.5])
    through_door, behind_wall = [9.0, 0.2, 1.4], [9.0, -3.0, 1.4]
    same_room, above_door = [3.0, 3.0, 1.0], [4.5, 0.0, 3.1]
    points = np.array([through_door, behind_wall, same_room, above_door])
    assert world.hidden(eye, points).tolist() == [False, True, False, True]


def test_panels_of_a_box_face_inwards() -> None:
    low, high = np.array([-1.0, -2.0, 0.0]), np.array([3.0, 1.0, 2.5])
    for panel in box(low, high):
        u, v = panel.size
        middle = panel.corner + 0.5 * (u * panel.across + v * panel.along)
        assert (0.5 * (low + high) - middle) @ panel.normal > 0
        end = panel.corner + u * panel.across + v * panel.along
        assert np.all((end >= low - 1e-12) & (end <= high + 1e-12))


def test_cameras_that_look_elsewhere_have_features_of_their_own() -> None:
    behind = gtsam.Rot3(np.diag([-1.0, -1.0, 1.0]) @ FORWARD)
    rig = Rig(
        (
            RigCamera(FISHEYE, gtsam.Pose3(gtsam.Rot3(FORWARD), np.array([0.1, 0, 0]))),
            RigCamera(FISHEYE, gtsam.Pose3(behind, np.array([-0.1, 0, 0]))),
            RigCamera(FISHEYE, gtsam.Pose3(gtsam.Rot3(FORWARD), np.array([0.1, 0.1, 0]))),
        )
    )
    flight = tracks().flight
    landmarks = on_walls(flight.world, 30.0, np.random.default_rng(0))
    simulator = TrackSimulator(rig, flight.world, landmarks, TrackConfig(features=50), 0)
    assert simulator.groups == [[0, 2], [1]]
    for frame in simulator.frames(flight.motion, flight.exposures_ns[:40]):
        assert [len(frame.cameras[c]) for c in (0, 1)] == [50, 50]
        assert len(np.intersect1d(frame.cameras[0].ids, frame.cameras[1].ids)) == 0
        assert len(np.intersect1d(frame.cameras[0].ids, frame.cameras[2].ids)) > 35


def test_a_time_offset_shifts_the_stamps_of_frames_but_not_what_they_see() -> None:
    config, plain = SimulationConfig(duration_s=2.0), tracks(duration_s=2.0)
    cameras = tuple(replace(mounted, time_offset_s=0.01) for mounted in euroc_rig().cameras)
    flight = replace(plain.flight, rig=Rig(cameras))
    late = SimulatedTracks("late", config, flight, plain.landmarks)
    for a, b in zip(frames(plain), frames(late), strict=True):
        assert a.stamp_ns - b.stamp_ns == 10_000_000
        np.testing.assert_array_equal(a.cameras[1].pixels, b.cameras[1].pixels)
    np.testing.assert_array_equal(late.groundtruth().stamps_ns, plain.groundtruth().stamps_ns)


def test_landmarks_ahead_are_enough_everywhere() -> None:
    sequence = tracks(trajectory="random", landmarks={"kind": "ahead"}, duration_s=15.0)
    counts = [len(frame.cameras[0]) for frame in frames(sequence)]
    assert min(counts) > 100
    assert max(counts) == 150


def test_the_start_is_the_truth_or_in_error_as_its_covariance_says() -> None:
    exact = tracks().initial_state()
    truth = tracks().groundtruth()
    np.testing.assert_array_equal(exact.world_T_body.translation(), truth.positions[0])
    assert exact.covariance is not None
    squares = []
    for seed in range(40):
        state = tracks(start={"error": True}, seed=seed).initial_state()
        plain = tracks(seed=seed).initial_state()
        pose_error = plain.world_T_body.localCoordinates(state.world_T_body)
        rest = [
            getattr(state, n) - getattr(plain, n) for n in ("velocity", "accel_bias", "gyro_bias")
        ]
        error = np.concatenate([pose_error, *rest])
        squares.append(error @ np.linalg.solve(exact.covariance, error) / 15)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.2)


def test_a_frame_ends_every_period() -> None:
    sequence = tracks(trajectory="rooms", duration_s=100.0, cameras=1, tracks={"features": 5})
    assert sum(1 for _ in sequence.packets()) == 2001


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"real_imu": True}, ConfigError, "'figure8' is a generated one"),
        ({"start_s": 3.0, "trajectory": "rooms"}, ConfigError, "'rooms' is a generated one"),
        ({"trajectory": "nowhere"}, DataError, "nowhere: no such trajectory"),
        ({"cameras": 3}, DataError, "asked for 3 cameras, the rig has 2"),
    ],
)
def test_what_cannot_be_simulated_is_said_in_one_line(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        tracks(**options)


def test_settings_come_from_a_file_keywords_and_overrides_in_this_order(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("trajectory: random\nseed: 3\ntracks:\n  loss: 0.01\n  features: 20\n")
    config = simulate(str(file), ["tracks.loss=0.03"], seed=4, duration_s=2.0).config
    assert (config.trajectory, config.seed, config.duration_s) == ("random", 4, 2.0)
    assert (config.tracks.loss, config.tracks.features) == (0.03, 20)
    again = simulate(config, tracks={"features": 30}).config
    assert (again.tracks.loss, again.tracks.features) == (0.03, 30)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("trajektory=random", "unknown key 'trajektory'; did you mean 'trajectory'"),
        ("tracks.descriptor_looks=9", "'tracks.descriptor_looks' is now tracks.distinct_desc"),
        ("images.blur_samples=9", "'images.blur_samples' is a constant now: BLUR_SAMPLES"),
        ("trajectory=figure9", "figure9: no such trajectory; did you mean 'figure8'"),
    ],
)
def test_unknown_and_moved_settings_are_explained(override: str, message: str) -> None:
    with pytest.raises((ConfigError, DataError), match=message):
        simulate(overrides=[override])


def test_a_trajectory_in_place_of_a_file_is_explained() -> None:
    with pytest.raises(ConfigError, match="write trajectory='rooms'"):
        simulate("rooms")


def test_the_plain_settings_are_those_in_the_documents() -> None:
    page = (Path(__file__).parent.parent / "docs" / "simulation.md").read_text(encoding="utf-8")
    table = page[page.index("| setting |") : page.index("All others")]
    assert re.findall(r"^\| `([a-z_.]+)` \|", table, re.MULTILINE) == list(plain(SimulationConfig))


def plain(settings: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Names of the settings that are not for experts."""
    for name, info in settings.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            yield from plain(info.annotation, f"{prefix}{name}.")
        elif not (isinstance(info.json_schema_extra, dict) and info.json_schema_extra["expert"]):
            yield prefix + name


@pytest.mark.parametrize("trajectory", ["figure8", "random", "rooms"])
def test_flights_of_one_world_seed_go_through_one_place(trajectory: str) -> None:
    def flight(seed: int, world_seed: int | None) -> SimulatedTracks:
        made = simulate(
            trajectory=trajectory,
            duration_s=3.0,
            rate_hz=5.0,
            seed=seed,
            world_seed=world_seed,
            tracks={"descriptors": True, "keep_ids": True},
        )
        assert isinstance(made, SimulatedTracks)
        return made

    one, other, elsewhere = flight(1, 7), flight(2, 7), flight(2, None)
    np.testing.assert_array_equal(one.landmarks.points, other.landmarks.points)
    assert not np.array_equal(one.groundtruth().positions, other.groundtruth().positions)
    np.testing.assert_array_equal(other.groundtruth().positions, elsewhere.groundtruth().positions)
    assert not np.array_equal(other.landmarks.points[:50], elsewhere.landmarks.points[:50])
    itself, same = flight(3, 3), flight(3, None)
    if trajectory == "rooms":
        np.testing.assert_array_equal(itself.landmarks.points, same.landmarks.points)


@pytest.mark.parametrize("real_imu", [False, True])
def test_one_flies_along_a_folder_of_tum_vi(tmp_path: Path, real_imu: bool) -> None:
    """As it is downloaded: its calibration is beside ``mav0``."""
    flown = tracks(duration_s=6.0)
    path = tmp_path / "dataset-room9_512_16"
    with EurocWriter(path, flown.rig, flown.groundtruth(), "", 20.0) as writer:
        writer.write_imu(flown.imu())
    for folder in (path / "mav0").glob("cam*"):
        (folder / "data.csv").unlink()
        (folder / "data").rmdir()
    along = simulate(trajectory=str(as_tum_vi(path)), real_imu=real_imu, duration_s=3.0)
    assert along.info().frames > 50
    assert along.rig.cameras[0].camera == flown.rig.cameras[0].camera
