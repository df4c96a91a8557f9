# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The noise of the pixels: block means of tracks against their definition, and whole flights."""

import numpy as np
import pytest
from estimating import BELIEVED
from flight import Flight, rig, room, scene
from groups import slow

from slam_graph.arrays import FloatArray
from slam_graph.backend import engine_protocol
from slam_graph.backend.backend_config import BackendConfig, NoiseConfig
from slam_graph.backend.cost import pixel_noise
from slam_graph.backend.cost.cost import Cost, TrackFeatures
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.pixel_noise import BLOCK, PixelNoise, block_means
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.winsorised import winsorised
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import State
from slam_graph.config import load_config
from slam_graph.evaluation.consistency import nees
from slam_graph.pipeline.run_recording import run
from slam_graph.simulation.simulation_config import SimulationConfig
from slam_graph.simulation.simulator import simulate

CAMERAS = 2
MOST_NEES = 3.6
"""Mean over a flight of a pose's NEES, which is 6 on average over many flights."""
Tracks = tuple[Observations, Geometry, FloatArray]


@pytest.fixture(scope="module")
def tracks() -> Tracks:
    """Stereo tracks of up to 20 frames, the truth, and derivatives by the points."""
    rng = np.random.default_rng(3)
    obs, truth = scene(
        Flight(), rig(CAMERAS), room(400, rng), np.linspace(0.0, 1.0, 20), rng, 1.0, min_frames=8
    )
    return obs, truth, RigProjection(rig(CAMERAS)).jacobians(obs, truth)[1]


def dense(
    obs: Observations, e: FloatArray, H: FloatArray, feature: int, camera: int
) -> tuple[float, FloatArray]:
    """‖B P e‖² and B P Bᵀ of one feature in one camera, by the definition."""
    rows = np.flatnonzero(obs.feature == feature)
    n = len(rows)
    Q = np.linalg.qr(H[rows].reshape(-1, 3))[0]
    P = np.eye(2 * n) - Q @ Q.T
    seen = np.flatnonzero(obs.camera[rows] == camera)
    B = np.zeros((0, 2 * n))
    for start in range(0, len(seen) - BLOCK + 1, BLOCK):
        for axis in (0, 1):
            row = np.zeros(2 * n)
            row[2 * seen[start : start + BLOCK] + axis] = 1.0 / BLOCK
            B = np.vstack([B, row])
    means = B @ P @ e[rows].reshape(-1)
    return float(means @ means), B @ P @ B.T


def test_block_means_are_those_of_the_definition(tracks: Tracks) -> None:
    obs, _, H = tracks
    e = np.random.default_rng(1).normal(size=(len(obs), 2))
    for camera, found in enumerate(block_means(obs, e, H, CAMERAS)):
        sums = [dense(obs, e, H, j, camera) for j in range(len(obs.ids))]
        sums = [(s, S) for s, S in sums if len(S)]
        trace = np.array([np.trace(S) for _, S in sums])
        square = np.array([np.trace(S @ S) for _, S in sums])
        np.testing.assert_allclose(found.squares, [s for s, _ in sums] / trace, rtol=1e-6)
        np.testing.assert_allclose(found.dof, trace**2 / square, rtol=1e-6)


def test_white_noise_has_a_winsorised_mean_of_one_and_these_degrees_of_freedom(
    tracks: Tracks,
) -> None:
    obs, _, H = tracks
    rng = np.random.default_rng(2)
    noise = (rng.normal(size=(len(obs), 2)) for _ in range(100))
    draws = [block_means(obs, e, H, CAMERAS)[0] for e in noise]
    squares = np.array([draw.squares for draw in draws])
    assert squares.size > 5000
    dof = draws[0].dof
    assert np.mean(squares) == pytest.approx(1.0, abs=0.02)
    assert np.mean(dof * (squares - 1.0) ** 2) == pytest.approx(2.0, rel=0.05)
    means = np.array([winsorised(draw.squares, draw.dof, 0.95) for draw in draws])
    assert np.average(means, axis=1, weights=dof).mean() == pytest.approx(1.0, abs=0.02)


def test_a_wild_track_counts_little() -> None:
    squares, dof = np.append(np.ones(99), 1e6), np.full(100, 4.0)
    assert np.mean(winsorised(squares, dof, 0.95)) < 1.1


def test_errors_that_last_count_for_more_than_their_size(tracks: Tracks) -> None:
    obs, _, H = tracks
    rng = np.random.default_rng(4)
    e = rng.normal(size=(len(obs), 2))
    memory = 0.8  # of the errors of a feature in a camera, from frame to frame
    last: dict[tuple[int, int], FloatArray] = {}
    for row in range(len(obs)):
        key = int(obs.feature[row]), int(obs.camera[row])
        if key in last:
            e[row] = memory * last[key] + np.sqrt(1.0 - memory**2) * e[row]
        last[key] = e[row]
    found = block_means(obs, e, H, CAMERAS)[0]
    assert np.average(found.squares, weights=found.dof) > 2.0


def learned(tracks: Tracks, sigmas: tuple[float, float], config: NoiseConfig) -> FloatArray:
    """What is used of what is found in tracks of two cameras, each with its own noise."""
    return after(tracks, sigmas, config).sigma_px


def after(tracks: Tracks, sigmas: tuple[float, float], config: NoiseConfig) -> PixelNoise:
    """The noise as it is known after tracks of two cameras at true poses."""
    obs, truth, _ = tracks
    rng = np.random.default_rng(6)
    state = State()
    for k, t_s in enumerate(np.linspace(0.0, 1.0, 20).tolist()):
        state.insert_imu_state(k, Flight().nav_state(t_s, np.ones(5)))
    noise = PixelNoise(config, CAMERAS)
    projection = RigProjection(rig(CAMERAS))
    exact = obs.pixels - projection.residuals(obs, truth)[0]
    cost = Cost(state, projection, BackendConfig(), SquareRootInformation.empty())
    for step in range(200):
        pixels = exact + rng.normal(size=exact.shape) * np.array(sigmas)[obs.camera][:, None]
        noisy = Observations(
            obs.ids, obs.frames, obs.feature, obs.frame, obs.camera, pixels, obs.normalized
        )
        some = rng.random(len(obs.ids)) < 0.1
        features = TrackFeatures(noisy, truth.points, np.zeros(len(obs.ids), np.bool_))
        noise.learn(cost, features.subset(some), step * 50_000_000)
    return noise


def test_each_camera_has_its_noise_within_bounds(tracks: Tracks) -> None:
    on = NoiseConfig(adaptive_pixels="any")
    np.testing.assert_allclose(learned(tracks, (0.5, 2.0), on), [0.5, 2.0], rtol=0.08)
    np.testing.assert_allclose(learned(tracks, (0.05, 0.05), on), [0.25, 0.25])
    np.testing.assert_allclose(learned(tracks, (20.0, 20.0), on), [4.0, 4.0])
    assert NoiseConfig().adaptive_pixels == "clear"
    for choice, smaller in (("clear", 0.5), ("larger", 1.0)):
        config = NoiseConfig.model_validate({"adaptive_pixels": choice})
        np.testing.assert_allclose(learned(tracks, (0.5, 2.0), config), [smaller, 2.0], rtol=0.08)
        np.testing.assert_array_equal(learned(tracks, (1.1, 0.9), config), [1.0, 1.0])
    never = NoiseConfig(adaptive_pixels="never")
    np.testing.assert_array_equal(learned(tracks, (0.5, 2.0), never), [1.0, 1.0])


def test_a_camera_that_is_blind_for_a_day_keeps_what_it_has_shown(tracks: Tracks) -> None:
    obs, truth, _ = tracks
    config = NoiseConfig(adaptive_pixels="any")
    noise = after(tracks, (0.5, 2.0), config)
    before = noise.estimate_px
    state = State()
    for k, t_s in enumerate(np.linspace(0.0, 1.0, 20).tolist()):
        state.insert_imu_state(k, Flight().nav_state(t_s, np.ones(5)))
    cost = Cost(state, RigProjection(rig(CAMERAS)), BackendConfig(), SquareRootInformation.empty())
    exact = obs.pixels - cost.rig.residuals(obs, truth)[0]
    one = obs.camera == 0
    pixels = exact + np.random.default_rng(7).normal(0.0, 0.5, exact.shape)
    seen = Observations(
        obs.ids, obs.frames, obs.feature[one], obs.frame[one], obs.camera[one], pixels[one],
        obs.normalized[one],
    )  # fmt: skip
    features = TrackFeatures(seen, truth.points, np.zeros(len(obs.ids), np.bool_))
    for hour in range(1, 25):
        noise.learn(cost, features, hour * 3_600_000_000_000)
    np.testing.assert_allclose(noise.estimate_px, [0.5, before[1]], rtol=0.1)
    assert np.all(np.isfinite(noise.sigma_px))


@pytest.mark.parametrize(("drift_px", "sigma_px"), [(0.01, 0.25), (0.1, 0.635), (0.2, 1.0)])
def test_no_less_is_used_than_the_drift_of_a_window(
    tracks: Tracks, drift_px: float, sigma_px: float
) -> None:
    """The mean of n steps of a random walk has the variance n / 3, that of white noise 1 / n."""
    config = NoiseConfig(drift_px=drift_px, adaptive_drift=False)
    np.testing.assert_allclose(learned(tracks, (0.05, 0.05), config), sigma_px, rtol=1e-3)


def test_what_is_found_does_not_depend_on_what_is_used(tracks: Tracks) -> None:
    found = [
        after(tracks, (0.5, 2.0), NoiseConfig.model_validate({"adaptive_pixels": choice}))
        for choice in ("larger", "clear", "any")
    ]
    np.testing.assert_array_equal(found[0].estimate_px, found[2].estimate_px)
    np.testing.assert_array_equal(found[1].estimate_px, found[2].estimate_px)


def test_tracks_that_have_hardly_moved_say_nothing(
    tracks: Tracks, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pixel_noise, "_LEAST_MOTION_PX", 1e4)
    on = NoiseConfig(adaptive_pixels="any")
    np.testing.assert_allclose(learned(tracks, (0.5, 2.0), on), [1.0, 1.0], rtol=1e-12)


class Recorded(PixelNoise):
    """Keeps what the last estimator uses."""

    last: PixelNoise

    def __init__(self, config: NoiseConfig, cameras: int, with_depth: bool) -> None:
        super().__init__(config, cameras, with_depth)
        Recorded.last = self


@pytest.mark.parametrize(
    ("name", "sigma_px"), [slow("msckf", 0.5), ("msckf", 1.0), slow("swf", 2.0)]
)
def test_a_flight_finds_its_noise_and_knows_its_errors(
    name: str, sigma_px: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_protocol, "PixelNoise", Recorded)
    tree = {"duration_s": 11.0, "seed": 1, "tracks": {"pixel_sigma": sigma_px}}
    off = ["final_ba.enabled=false", "backend.initialization.fix_gauge=false", BELIEVED]
    config = load_config(name, [*off, "backend.noise.adaptive_pixels=any"])
    result = run(simulate(SimulationConfig.model_validate(tree)), config)
    found = Recorded.last.sigma_px
    np.testing.assert_allclose(found, sigma_px, rtol=0.05 if sigma_px == 1.0 else 0.1)
    assert result.groundtruth is not None
    errors = nees(result.trajectory, result.history.pose_covariances(), result.groundtruth)
    assert np.mean(errors.pose) < MOST_NEES, f"pose NEES {np.mean(errors.pose):.1f} of six"
