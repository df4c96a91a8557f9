# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Tracks that slide: process noise against a batch solution, and what is found of the drift."""

from collections.abc import Iterator

import numpy as np
import pytest
from estimating import BELIEVED
from flight import Flight, rig, room, scene
from groups import slow
from gtsam.symbol_shorthand import X

from slam_graph.arrays import FloatArray
from slam_graph.backend import engine_protocol
from slam_graph.backend.backend_config import NoiseConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.pixel_noise import PixelNoise
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.track_drift import EVERY_FRAMES, TrackDrift, add_drift_noise
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.state import State, landmark_keys
from slam_graph.backend.window import Window
from slam_graph.config import load_config
from slam_graph.datasets import dataset_from_arrays
from slam_graph.evaluation import nees_of_run
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors import FeatureFrame, FeatureObservations, ImuData
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulator import simulate

CAMERAS = 2


def test_a_filter_with_sliding_points_is_a_batch_of_all_their_positions() -> None:
    """Random measurements of three points and a pose, in four frames with noise in between."""
    rng, frames, points, size = np.random.default_rng(1), 4, 9, 15
    roots = rng.normal(size=(frames - 1, 3, 3, 2))
    measured = [rng.normal(size=(20, size + 1)) for _ in range(frames)]
    layout = Layout({**dict.fromkeys(landmark_keys(np.arange(3)), 3), X(0): 6})
    own = SquareRootInformation(layout, triangularize(measured[0]))
    for root, rows in zip(roots, measured[1:], strict=True):
        own = own.with_noise(root @ root.transpose(0, 2, 1)).updated(rows)
    # the batch: points at the first frame, steps of the walk (6 a frame), and the pose
    steps = 6 * (frames - 1)
    A = [np.hstack([np.zeros((steps, points)), np.eye(steps), np.zeros((steps, 6 + 1))])]
    to_last = np.zeros((size, points + steps + 6))
    to_last[:points, :points], to_last[points:, -6:] = np.eye(points), np.eye(6)
    for k, rows in enumerate(measured):
        by_steps = [(i < k) * rows[:, :points] @ _blocks(root) for i, root in enumerate(roots)]
        A.append(np.hstack([rows[:, :points], *by_steps, rows[:, points:]]))
    to_last[:points, points:-6] = np.hstack([_blocks(root) for root in roots])
    whole = np.vstack(A)
    mean = np.linalg.lstsq(whole[:, :-1], whole[:, -1])[0]
    covariance = to_last @ np.linalg.inv(whole[:, :-1].T @ whole[:, :-1]) @ to_last.T
    np.testing.assert_allclose(own.solution(), to_last @ mean, atol=1e-9)
    np.testing.assert_allclose(own.covariance(), covariance, atol=1e-9)


def _blocks(roots: FloatArray) -> FloatArray:
    """Roots (J, 3, 2) on the diagonal of a (3 J, 2 J) matrix."""
    matrix = np.zeros((3 * len(roots), 2 * len(roots)))
    for k, root in enumerate(roots):
        matrix[3 * k : 3 * k + 3, 2 * k : 2 * k + 2] = root
    return matrix


def test_points_slide_across_their_rays_and_as_far_as_is_said() -> None:
    rng, sigma_px, projection = np.random.default_rng(2), 0.3, RigProjection(rig(CAMERAS))
    state = State()
    state.insert_imu_state(EVERY_FRAMES, Flight().nav_state(0.3, np.ones(5)))
    body_T_camera = rig(CAMERAS).cameras[0].body_T_camera
    world_T_camera = state.frames.atPose3(X(EVERY_FRAMES)).compose(body_T_camera)
    bearings = np.column_stack([rng.uniform(-0.4, 0.4, (5, 2)), np.ones(5)])
    points = np.array(
        [
            world_T_camera.transformFrom(b * d)
            for b, d in zip(bearings, (2, 3, 4, 5, 6), strict=True)
        ]
    )
    ids = np.array([3, 4, 7, 8, 9])
    state.insert_points(ids, points)
    order = landmark_keys(ids[[2, 0, 1, 4, 3]])
    layout = Layout({**dict.fromkeys(order, 3), X(EVERY_FRAMES): 6})
    prior = SquareRootInformation(layout, triangularize(rng.normal(size=(60, layout.size + 1))))
    window = Window(EVERY_FRAMES, 0, state, prior, state_features=ids)
    normalized = bearings[:4, :2]  # the last point is not seen
    seen = FeatureObservations(
        ids[:4], rig(CAMERAS).cameras[0].camera.pixels(normalized), normalized
    )
    window.tracks.add(EVERY_FRAMES, FeatureFrame(0, (FeatureObservations.empty(), seen)[::-1]))
    add_drift_noise(window, projection, sigma_px)
    keys = landmark_keys(ids)
    added = window.prior.covariance_of(keys) - prior.covariance_of(keys)
    at = Geometry(*state.poses((EVERY_FRAMES,)), points)
    rows = np.arange(5)
    obs = Observations(
        ids, (EVERY_FRAMES,), rows, 0 * rows, 0 * rows, np.zeros((5, 2)), np.zeros((5, 2))
    )
    J = projection.jacobians(obs, at)[1]
    for k in range(5):
        block = added[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        variance = EVERY_FRAMES * sigma_px**2 if k < 4 else 0.0
        np.testing.assert_allclose(J[k] @ block @ J[k].T, variance * np.eye(2), atol=1e-6)
        ray = points[k] - world_T_camera.translation()
        np.testing.assert_allclose(block @ ray, 0.0, atol=1e-9)
        added[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = 0.0
    np.testing.assert_allclose(added, 0.0, atol=1e-9)
    rest = [X(EVERY_FRAMES)]
    np.testing.assert_allclose(window.prior.covariance_of(rest), prior.covariance_of(rest))


@pytest.mark.parametrize(
    ("white_px", "drift_px"), [(1.0, 0.0), (0.3, 0.0), (0.3, 0.1), (1.0, 0.3), (0.02, 0.2)]
)
def test_white_noise_and_drift_are_told_apart(white_px: float, drift_px: float) -> None:
    rng = np.random.default_rng(3)
    obs, truth = scene(
        Flight(), rig(CAMERAS), room(400, rng), np.linspace(0.0, 1.0, 20), rng, 1.0, min_frames=8
    )
    by_point = RigProjection(rig(CAMERAS)).jacobians(obs, truth)[1]
    drift = TrackDrift(NoiseConfig())
    for step in range(25):
        walks = np.cumsum(rng.normal(0.0, drift_px, (len(obs.ids), len(obs.frames), 2)), axis=1)
        r = rng.normal(0.0, white_px, (len(obs), 2)) + walks[obs.feature, obs.frame]
        drift.learn(obs, r, by_point, CAMERAS, step * 50_000_000)
    assert drift.sigma_px == pytest.approx(drift_px, rel=0.08, abs=0.06 * white_px)


def sliding(sequence: SimulatedSequence, sigma_px: float) -> Iterator[FeatureFrame]:
    """The frames of a recording with tracks that slide, alike in all cameras."""
    rng, lenses = np.random.default_rng(4), [mounted.camera for mounted in sequence.rig.cameras]
    off: dict[int, FloatArray] = {}
    for packet in sequence.packets():
        assert isinstance(packet.frame, FeatureFrame)
        seen = np.unique(np.concatenate([camera.ids for camera in packet.frame.cameras])).tolist()
        off = {j: off.get(j, np.zeros(2)) + rng.normal(0.0, sigma_px, 2) for j in seen}
        cameras = []
        for lens, c in zip(lenses, packet.frame.cameras, strict=True):
            pixels = c.pixels + np.array([off[j] for j in c.ids.tolist()]).reshape(-1, 2)
            cameras.append(FeatureObservations(c.ids, pixels, lens.undistort(pixels)))
        yield FeatureFrame(packet.frame.stamp_ns, tuple(cameras))


class Recorded(PixelNoise):
    """Keeps what the last estimator uses."""

    last: PixelNoise

    def __init__(self, config: NoiseConfig, cameras: int, with_depth: bool) -> None:
        super().__init__(config, cameras, with_depth)
        Recorded.last = self


@pytest.mark.parametrize(("name", "learns"), [("msckf", True), slow("ekf", False)])
def test_a_flight_finds_its_drift_and_knows_its_errors(
    name: str, learns: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All features of `ekf` are in the state, so that no tracks tell: its drift is set."""
    monkeypatch.setattr(engine_protocol, "PixelNoise", Recorded)
    flight = simulate(
        trajectory="figure8",
        duration_s=12.0,
        rate_hz=20.0,
        seed=2,
        cameras=CAMERAS,
        tracks={"features": 60, "pixel_sigma": 0.1},
    )
    imu = ImuData.concatenate([packet.imu for packet in flight.packets()])
    recording = dataset_from_arrays(
        flight.rig,
        imu_stamps_ns=imu.stamps_ns,
        gyro=imu.gyro,
        accel=imu.accel,
        features=list(sliding(flight, 0.2)),
        groundtruth=flight.groundtruth(),
    )
    found = {}
    for on in (True, False):
        overrides = [f"adaptive_drift={on and learns}", f"drift_px={0.2 * (on and not learns)}"]
        overrides = [f"backend.noise.{override}" for override in overrides]
        result = run(recording, load_config(name, ["final_ba.enabled=false", BELIEVED, *overrides]))
        assert result.groundtruth is not None
        errors = nees_of_run(result.groundtruth, result.history, False, None)[0]
        found[on] = np.mean(errors.position), np.mean(errors.orientation)
        # some less: what may be chance is left out
        assert (0.14 if on else 0.0) <= Recorded.last.drift.sigma_px <= (0.21 if on else 0.0)
    assert max(found[True]) < 4.5, f"NEES of position and orientation {found}"
    assert sum(found[False]) > 1.3 * sum(found[True])
