# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the rig as variables: derivatives, elimination, and what they must not show."""

from dataclasses import replace

import gtsam
import gtsam_unstable
import numpy as np
import pytest
from flight import FISHEYE, RADTAN, Flight, packets, rig, room, scene
from fov_camera import FOV
from gtsam.symbol_shorthand import E, L, X
from scipy.linalg import eigh
from scipy.stats import chi2
from test_calibration_convergence import calibrate, wrong
from test_estimator_first_estimates import CONFIG, WEAK, claimed_information

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, CalibrationConfig
from slam_graph.backend.cost.calibrated_projection import CalibratedProjection
from slam_graph.backend.cost.cost import Cost, TrackFeatures
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.triangulation import first_centres, moved_in_inverse_depth
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.marginalization.marginalize import relinearized, unobservable_directions
from slam_graph.backend.online_calibration import CalibrationVariables
from slam_graph.backend.policies import GaussNewtonPolicy
from slam_graph.backend.solve.gauss_newton import minimize
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import FrameMotion, State, dims_of
from slam_graph.config import load_config
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.camera_model import CAMERA_MODELS
from slam_graph.sensors.measurements import FeatureFrame

PLAIN = replace(RADTAN, distortion="none", coefficients=())
MEI = replace(
    RADTAN, fx=760.0, fy=758.0, distortion="mei", coefficients=(0.9, -0.1, 0.03, 2e-4, 1e-4)
)
SPHERES = replace(RADTAN, distortion="double_sphere", coefficients=(0.1, 0.55))
CAMERAS = [RADTAN, FISHEYE, PLAIN, MEI, SPHERES, replace(FOV, width=752, height=480)]
each_camera = pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.distortion)
ALL = CalibrationConfig(extrinsics=True, time_offset=True, intrinsics=True, distortion=True)
OFF = CalibrationConfig()
STEP = 1e-6
TIMES = np.linspace(0.0, 3.0, 6)


def case(
    camera: Camera, calibration: CalibrationConfig = ALL
) -> tuple[CalibrationVariables, State, SquareRootInformation, Observations, FloatArray]:
    """Two cameras, poses and a calibration away from their first estimates, and noisy tracks."""
    rng = np.random.default_rng(3)
    flight, two = Flight(), rig(2, camera)
    variables = CalibrationVariables(two, calibration)
    state = State()
    for i, t_s in enumerate(TIMES.tolist()):
        state.insert_imu_state(i, flight.nav_state(t_s))
        state.motions[i] = FrameMotion(rng.normal(size=6), 0.002 * i)
    prior = variables.enter(state, SquareRootInformation.empty())
    if variables.keys:
        scale = {"e": 0.02, "k": 2.0, "d": 1e-3, "t": 0.01}
        sigmas = [
            np.full(prior.layout.dims[key], scale[chr(gtsam.Symbol(key).chr())])
            for key in prior.layout.dims
        ]
        state.update(prior.layout, rng.normal(size=prior.layout.size) * np.concatenate(sigmas))
    obs, at = scene(flight, two, room(60, rng), TIMES, rng)
    return variables, state, prior, obs, at.points


def pixels(
    variables: CalibrationVariables, state: State, obs: Observations, points: FloatArray
) -> FloatArray:
    projection = CalibratedProjection(variables, state)
    at = Geometry(*projection.poses(state.estimate, obs.frames), points)
    return obs.pixels - projection.residuals(obs, at)[0]


def test_every_camera_model_is_tested() -> None:
    assert {camera.distortion for camera in CAMERAS} == set(CAMERA_MODELS)


@each_camera
def test_derivatives_are_the_numerical_ones(camera: Camera) -> None:
    variables, state, prior, obs, points = case(camera)
    projection = CalibratedProjection(variables, state)
    at = Geometry(*projection.poses(state.estimate, obs.frames), points)
    by_pose, by_point, by_calibration = projection.all_jacobians(obs, at)
    layout = prior.layout.extended({X(i): 6 for i in range(len(TIMES))})
    assert layout.size == by_calibration.shape[2] + 36 == 21 + 2 * len(camera.coefficients) + 36

    def moved(column: int, step: float) -> FloatArray:
        other = state.copy()
        other.update(layout, step * np.eye(layout.size)[column])
        return pixels(variables, other, obs, points)

    for column in range(layout.size):
        numerical = (moved(column, STEP) - moved(column, -STEP)) / (2 * STEP)
        if column < prior.layout.size:
            ours = by_calibration[:, :, column]
        else:
            frame, axis = divmod(column - prior.layout.size, 6)
            ours = np.where((obs.frame == frame)[:, None], by_pose[:, :, axis], 0.0)
        np.testing.assert_allclose(ours, numerical, rtol=1e-6, atol=2e-4)
    for axis in range(3):
        shift = STEP * np.eye(3)[axis]
        forward, backward = (
            pixels(variables, state, obs, points + sign * shift) for sign in (1, -1)
        )
        numerical = (forward - backward) / (2 * STEP)
        np.testing.assert_allclose(by_point[:, :, axis], numerical, rtol=1e-6, atol=2e-5)


def test_derivatives_by_the_extrinsics_are_those_of_gtsam() -> None:
    variables, state, _, obs, points = case(PLAIN, CalibrationConfig(extrinsics=True))
    state.rebase()
    projection = CalibratedProjection(variables, state)
    at = Geometry(*projection.poses(state.estimate, obs.frames), points)
    by_pose, by_point, by_calibration = projection.all_jacobians(obs, at)
    unit = gtsam.noiseModel.Unit.Create(2)
    K = gtsam.Cal3_S2(PLAIN.fx, PLAIN.fy, 0.0, PLAIN.cx, PLAIN.cy)
    for row in range(0, len(obs), 7):
        i, j, c = int(obs.frame[row]), int(obs.feature[row]), int(obs.camera[row])
        factor = gtsam_unstable.ProjectionFactorPPPCal3_S2(
            obs.pixels[row], unit, X(i), E(c), L(j), K, True, False
        )
        values = gtsam.Values()
        values.insert(X(i), state.estimate.atPose3(X(i)))
        values.insert(E(c), state.estimate.atPose3(E(c)))
        values.insert(L(j), points[j])
        A, _ = gtsam.JacobianFactor(factor.linearize(values)).jacobian()
        ours = [by_pose[row], by_calibration[row, :, 6 * c : 6 * c + 6], by_point[row]]
        np.testing.assert_allclose(np.hstack(ours), A, rtol=1e-9, atol=1e-9)


def test_coordinates_are_normalised_by_the_estimated_intrinsics() -> None:
    variables, state, _, obs, _ = case(RADTAN)
    again = CalibratedProjection(variables, state).renormalized(obs)
    assert np.abs(again.normalized - obs.normalized).max() > 1e-3
    for c, mounted in enumerate(variables.rig(state.estimate).cameras):
        rows = obs.camera == c
        back = mounted.camera.distort(again.normalized[rows])[0]
        np.testing.assert_allclose(back, obs.pixels[rows], atol=1e-6)


def test_features_used_once_say_of_the_calibration_what_variables_would() -> None:
    """The null space of the features carries the columns of the calibration."""
    variables, state, known, obs, points = case(RADTAN)
    prior = known.extended({X(i): 6 for i in range(len(TIMES))})
    weak = np.hstack([0.1 * np.eye(prior.layout.size), np.zeros((prior.layout.size, 1))])
    prior = prior.updated(weak)
    posteriors = []
    for in_state in (False, True):
        variable = np.full(len(obs.ids), in_state)
        cost = Cost(state.copy(), CalibratedProjection(variables), BackendConfig(), prior)
        cost.tracks = TrackFeatures(obs, points, variable)
        if in_state:
            for j, point in zip(obs.ids.tolist(), points, strict=True):
                cost.state.insert_point(j, point)
        posterior = minimize(cost, GaussNewtonPolicy(max_steps=1)).posterior
        assert cost.tracks is not None
        posteriors.append((posterior.covariance_of(list(prior.layout.dims)), cost))
    (once, first), (kept, second) = posteriors
    np.testing.assert_allclose(once, kept, rtol=1e-6, atol=1e-12)
    assert first.tracks is not None
    # the same increments, which features that are no variables take in inverse depth
    centres = first_centres(obs, CalibratedProjection(variables, state), state)
    moved = np.array([second.state.estimate.atPoint3(L(j)) for j in obs.ids.tolist()])
    after = first_centres(obs, CalibratedProjection(variables, first.state), first.state)
    expected = moved_in_inverse_depth(points, moved - points, centres, after)
    np.testing.assert_allclose(first.tracks.points, expected, atol=1e-6)
    for key in variables.keys:
        np.testing.assert_allclose(first.state.offsets[key], second.state.offsets[key], atol=1e-7)


def final_state(name: str, calibration: CalibrationConfig) -> tuple[NavState, Estimator]:
    """The state after a short flight."""
    rng = np.random.default_rng(2)
    flight, mounted = Flight(), rig(2)
    config = CONFIG.model_copy(update={"calibration": calibration})
    estimator = Estimator(mounted, load_config(algorithm=name).algorithm, config)
    estimator.start(flight.nav_state(0.0, WEAK))
    for packet in packets(flight, mounted, room(120, rng), 2.0, rng):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame)
    assert state is not None
    return state, estimator


@each_camera
def test_distortion_is_calibrated_online_with_every_camera_model(camera: Camera) -> None:
    """A coefficient that is off by a standard deviation comes to the truth, as near as claimed."""
    count = len(camera.coefficients)
    sigma = CalibrationConfig().distortion_sigma
    off = tuple(np.array(camera.coefficients) + sigma * np.eye(max(count, 1))[0, :count])
    nominal = rig(1, replace(camera, coefficients=off))
    if not count:
        assert not CalibrationVariables(nominal, CalibrationConfig(distortion=True)).keys
        return
    estimate, _ = calibrate("msckf", nominal, rig(1, camera), ("distortion",), 4.0)
    names = [parameter.name for parameter in estimate.parameters()]
    assert names == [f"cam0_distortion_{n}" for n in range(count)]
    error = np.subtract(estimate.rig.cameras[0].camera.coefficients, camera.coefficients)
    covariance = estimate.covariances["d0"]
    assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.999, count)
    assert np.sqrt(covariance[0, 0]) < 0.7 * sigma
    assert abs(error[0]) < 0.7 * sigma


@pytest.mark.parametrize("name", ["msckf", "okvis", "ekf"])
def test_a_calibration_that_is_certain_changes_nothing(name: str) -> None:
    sigmas = {field: 1e-9 for field in CalibrationConfig.model_fields if "sigma" in field}
    plain, without = final_state(name, OFF)
    state, estimator = final_state(name, ALL.model_copy(update=sigmas))
    assert without.calibration is None
    assert estimator.calibration is not None
    pose = plain.world_T_body.localCoordinates(state.world_T_body)
    np.testing.assert_allclose(pose, 0.0, atol=1e-5)
    np.testing.assert_allclose(state.velocity, plain.velocity, atol=1e-5)
    assert plain.covariance is not None
    assert state.covariance is not None
    np.testing.assert_allclose(
        np.diag(state.covariance), np.diag(plain.covariance), rtol=1e-3, atol=1e-12
    )


def test_nothing_calibrated_is_nothing_computed() -> None:
    variables, state, prior, obs, points = case(RADTAN, OFF)
    assert variables.keys == ()
    assert prior.layout.size == 0
    plain = RigProjection(variables.nominal)
    assert plain.at(state) is plain
    assert plain.renormalized(obs) is obs
    at = Geometry(*plain.poses(state.estimate, obs.frames), points)
    assert plain.all_jacobians(obs, at)[2].shape == (len(obs), 2, 0)


@pytest.mark.parametrize("name", ["msckf", "swf"])
def test_no_calibration_shows_where_the_world_is(name: str) -> None:
    """Its parameters are linearised at their estimates, and where a step is repeated the states
    are too; and yet nothing unseen is claimed.
    """
    rng = np.random.default_rng(2)
    flight, mounted = Flight(), rig(2)
    config = CONFIG.model_copy(update={"calibration": ALL})
    nominal = wrong(mounted, ("extrinsics", "intrinsics", "time_offset"))
    estimator = Estimator(nominal, load_config(algorithm=name).algorithm, config)
    estimator.start(flight.nav_state(0.0, WEAK))
    start, repeated = claimed_information(estimator), 0
    for packet in packets(flight, mounted, room(200, rng), 5.0, rng):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        assert estimator.add_frame(packet.frame) is not None
        growth = eigh(claimed_information(estimator), start, eigvals_only=True)[-1]
        assert growth < 1.0 + 1e-6
        repeated += len(estimator.report.costs) > 2
    assert repeated > 3
    assert estimator.window is not None
    kinds = {chr(gtsam.Symbol(key).chr()) for key in estimator.window.prior.layout.dims}
    assert kinds == set("xvbledkt")


def test_linearisation_points_move_without_a_claim_on_the_world() -> None:
    """The corrected prior says as much of what is not seen as before, and all else nearly so."""
    rng = np.random.default_rng(5)
    state = State()
    for i, t_s in enumerate(TIMES.tolist()):
        state.insert_imu_state(i, Flight().nav_state(t_s))
    layout = Layout(dims_of(state.variables()))
    directions = unobservable_directions(state.first, layout)
    rows = rng.normal(size=(3 * layout.size, layout.size))
    rows -= rows @ directions @ np.linalg.pinv(directions)  # sees nothing of the world
    empty = SquareRootInformation.empty().extended(layout.dims)
    prior = empty.updated(np.hstack([rows, rng.normal(size=(len(rows), 1))]))
    state.freeze(layout.dims)
    state.update(layout, 0.05 * rng.normal(size=layout.size))
    moved = relinearized(prior, state)
    assert not state.offset(layout).any()
    now = unobservable_directions(state.first, layout)
    assert np.abs(prior.R @ now).max() > 0.01
    np.testing.assert_allclose(moved.R @ now, 0.0, atol=1e-9)
    np.testing.assert_allclose(np.tril(moved.R, -1), 0.0)
    information, before = moved.R.T @ moved.R, prior.R.T @ prior.R
    assert np.abs(information - before).max() < 0.2 * np.abs(before).max()
