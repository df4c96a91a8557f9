# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""An object that moves through a third of the view: what is rendered, and what runs make of it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_graph.arrays import BoolArray
from slam_graph.config import load_config
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.errors import ConfigError
from slam_graph.frontend import Feedback, FrontendConfig, build_frontend
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult
from slam_graph.sensors import FeatureObservations
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.rendering import cast
from slam_graph.simulation.simulated_sequence import SimulatedImages
from slam_graph.simulation.simulation_config import SimulationConfig
from slam_graph.simulation.simulator import euroc_rig, simulate
from slam_graph.simulation.world import World

RUN_S = 4.0


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rig of EuRoC with images of half the width."""
    cameras = []
    for mounted in euroc_rig().cameras:
        model = mounted.camera
        focal, middle = (model.fx / 2, model.fy / 2), (model.cx / 2, model.cy / 2)
        half = Camera(*focal, *middle, model.distortion, model.coefficients, 376, 240)
        cameras.append(replace(mounted, camera=half))
    path = tmp_path_factory.mktemp("rig") / "half.yaml"
    write_kalibr(Rig(tuple(cameras)), path)
    return path


def flight(
    calibration: Path, moving_object: dict[str, float] | None, **options: Any
) -> SimulatedImages:
    """A flight with an object that moves, or without."""
    config: dict[str, Any] = {
        "kind": "images",
        "calibration": calibration,
        "duration_s": RUN_S,
        "images": {"texel_m": 0.012, "noise_sigma": 0.5},
        "flight": {"hover_s": 0.0},
        "seed": 1,
        "moving_object": moving_object,
    }
    sequence = simulate(SimulationConfig.model_validate(config | options))
    assert isinstance(sequence, SimulatedImages)
    return sequence


class WithoutStart:
    """A sequence whose start nobody knows."""

    def __init__(self, sequence: SimulatedImages) -> None:
        self._sequence = sequence

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sequence, name)

    def initial_state(self) -> None:
        return None


def test_the_object_hides_what_is_behind_it_and_nothing_else(calibration: Path) -> None:
    """In both cameras, and it covers about a third of what they see."""
    sharp = {"images": {"texel_m": 0.02, "noise_sigma": 0.0}}
    sequence, empty = (flight(calibration, m, **sharp) for m in ({"texel_m": 0.01}, None))
    motion, board = sequence.flight.motion, sequence.board
    assert board is not None
    walls = sequence.flight.world.panels
    for index in (0, 30, 59):
        stamp_ns = int(sequence.flight.exposures_ns[index])
        frames = (s.renderer.frame(motion, stamp_ns).images for s in (sequence, empty))
        world = World((*walls, board.at(stamp_ns)))
        at = np.array([stamp_ns])
        world_R_body, body = motion.rotations(at).as_matrix()[0], motion.positions(at)[0]
        for mounted, image, without in zip(sequence.rig.cameras, *frames, strict=True):
            pixels = np.argwhere(np.ones(image.shape, bool))[:, ::-1].astype(float)
            rays = np.column_stack([mounted.camera.undistort(pixels), np.ones(len(pixels))])
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            matrix = mounted.body_T_camera.matrix()
            eye = body + world_R_body @ matrix[:3, 3]
            rays = rays @ (world_R_body @ matrix[:3, :3]).T
            on_board = cast(world, eye, rays.astype(np.float32)).panel == len(walls)
            assert 0.25 < np.mean(on_board) < 0.4
            np.testing.assert_array_equal(image.ravel()[~on_board], without.ravel()[~on_board])
            assert np.mean(image.ravel()[on_board] != without.ravel()[on_board]) > 0.9


def test_the_object_moves_as_it_is_told(calibration: Path) -> None:
    sequence = flight(calibration, {"since_s": 2.0, "speed": 0.5, "sway_m": 0.4})
    board, stamps = sequence.board, sequence.flight.exposures_ns
    camera = sequence.rig.cameras[0].body_T_camera.matrix()

    def sideways_m(stamp_ns: int) -> float:
        """Of its middle in the first camera, which follows nearly the same path."""
        panel, at = board.at(stamp_ns), np.array([stamp_ns])
        middle = panel.corner + 0.5 * (panel.size[0] * panel.across + panel.size[1] * panel.along)
        R = sequence.flight.motion.rotations(at).as_matrix()[0]
        p = sequence.flight.motion.positions(at)[0] + R @ camera[:3, 3]
        return float(((middle - p) @ (R @ camera[:3, :3]))[0])

    places = np.array([sideways_m(int(t)) for t in stamps])
    seconds = (stamps - stamps[0]) * 1e-9
    assert np.all(np.abs(places[seconds > 2.0]) < 0.9)
    assert places[0] > 0.5
    assert np.ptp(places[seconds > 2.0]) > 0.3


def test_tracks_have_no_moving_board() -> None:
    with pytest.raises(ConfigError, match="moving_points"):
        simulate(SimulationConfig.model_validate({"moving_object": {}}))


def on_board(sequence: SimulatedImages, stamp_ns: int, seen: FeatureObservations) -> BoolArray:
    """Which features (N,) of the first camera are truly on the board."""
    flight, board, at = sequence.flight, sequence.board, np.array([stamp_ns])
    assert board is not None
    walls = flight.world.panels
    camera = sequence.rig.cameras[0].body_T_camera.matrix()
    R = flight.motion.rotations(at).as_matrix()[0]
    eye = flight.motion.positions(at)[0] + R @ camera[:3, 3]
    rays = np.column_stack([seen.normalized, np.ones(len(seen))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = (rays @ (R @ camera[:3, :3]).T).astype(np.float32)
    hit: BoolArray = cast(World((*walls, board.at(stamp_ns))), eye, rays).panel == len(walls)
    return hit


def test_features_that_move_are_followed_apart_and_the_walls_are_not_among_them(
    calibration: Path,
) -> None:
    """The front end is told once, after a second, which of its features are on the board."""
    sequence = flight(calibration, {})
    frontend = build_frontend(sequence.rig, FrontendConfig(keep_moving=True))
    right, moving, walls, walls_moving = 0, 0, 0, 0
    for k, packet in enumerate(sequence.packets()):
        frame = frontend.track(packet.frame, packet.imu)
        static, apart = frame.cameras[0], frame.moving[0]
        assert not np.isin(apart.ids, static.ids).any()
        is_static, is_apart = (on_board(sequence, frame.stamp_ns, f) for f in (static, apart))
        if k == 20:
            told = static.ids[is_static]
            assert len(told) > 10
            frontend.receive_feedback(Feedback(moving=told))
        if k == 21:
            assert not np.isin(told, static.ids).any()
            assert np.isin(told, apart.ids).mean() > 0.8
        if k > 20:
            right, moving = right + np.count_nonzero(is_apart), moving + len(apart)
            walls_moving += np.count_nonzero(~is_apart)
            walls += np.count_nonzero(~is_static) + np.count_nonzero(~is_apart)
    assert right > 0.9 * moving
    assert walls_moving < 0.1 * walls


def ate_m(result: RunResult) -> float:
    result.check()
    return float(result.metrics["accuracy"]["se3"]["ate"]["translation_m"]["rmse"])


def started_s(result: RunResult) -> float:
    return float(result.trajectory.stamps_ns[0] - result.input.start_ns) * 1e-9


@pytest.mark.slow
def test_an_object_through_a_third_of_the_view_does_little_harm(calibration: Path) -> None:
    """There from the first frame on, before a stereo camera that begins in motion.

    With half of the pixels, half a pixel is what a whole one is otherwise.
    """
    config = load_config(overrides=["final_ba.enabled=false", "backend.noise.pixel_sigma=0.5"])
    clean, spoilt = (
        run(WithoutStart(flight(calibration, moving)), config) for moving in (None, {})
    )
    assert spoilt.status == "ok"
    assert started_s(spoilt) < started_s(clean) + 0.5
    assert ate_m(spoilt) < 1.7 * ate_m(clean)


def test_a_start_at_rest_before_a_moving_object(calibration: Path) -> None:
    """The IMU is calm and most features stand still: that one third moves changes nothing."""
    at_rest = {"flight": {"hover_s": 2.0}, "duration_s": 2.5, "cameras": 1}
    sequence = WithoutStart(flight(calibration, {}, **at_rest))
    result = run(sequence, load_config(overrides=["final_ba.enabled=false"]))
    assert started_s(result) < 1.3
    assert ate_m(result) < 0.01
