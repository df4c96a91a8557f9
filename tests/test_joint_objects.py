# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Platform and objects as one problem, against the same problem with dense matrices.

Two cameras without an IMU, so that the platform is uncertain, and an object that turns evenly and
so tells something of it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray, skew
from slam_graph.backend.smoothing import joint_objects, object_smoothing
from slam_graph.backend.smoothing.final_adjustment import FinalBa
from slam_graph.backend.smoothing.joint_objects import JointObject, joined
from slam_graph.backend.smoothing.pose_equations import PoseEquations
from slam_graph.backend.solve.single_thread import on_one_thread
from slam_graph.geometry import Trajectory, interpolate
from slam_graph.pipeline import run
from slam_graph.results import RunResult
from slam_graph.simulation.simulator import simulate

STATE = 15
PARTS = {"x": (0, 6), "v": (6, 3), "b": (9, 6)}
"""First component and width of each kind of variable in a state."""


@dataclass(frozen=True)
class Flight:
    """A run, and its adjustments of platform and objects before and after they were joined."""

    result: RunResult
    platform: FinalBa
    apart: dict[int, FinalBa]
    best: FinalBa
    together: dict[int, JointObject]


@pytest.fixture(scope="module")
def flight() -> Flight:
    sequence = simulate(
        duration_s=5.0,
        rate_hz=10.0,
        seed=3,
        with_imu=False,
        tracks={"pixel_sigma": 0.5},
        objects={"count": 1},
    )
    kept: list[tuple[FinalBa, dict[int, FinalBa]]] = []

    def noting(platform: FinalBa, objects: dict[int, FinalBa]) -> object:
        kept.append((platform, dict(objects)))
        return joined(platform, objects)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(object_smoothing, "joined", noting)
        changes = {"objects.enabled": True, "backend.noise.pixel_sigma": 0.5}
        result = run(sequence, overrides=changes)
    ((platform, apart),) = kept
    best, together = on_one_thread(joined)(platform, apart)  # as the run does
    return Flight(result, platform, apart, best, together)


def covariance(equations: PoseEquations) -> FloatArray:
    """Of the poses of all keyframes."""
    size = 6 * len(equations.keyframes)
    P = equations.times_covariance(np.eye(size))
    return 0.5 * (P + P.T)


def rotations(path: Trajectory) -> FloatArray:
    return Rotation.from_quat(path.quaternions).as_matrix()


def root(information: FloatArray) -> FloatArray:
    """Rows whose squares are an information."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)


def inertial_rows(own: PoseEquations, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rows of all factors but images, by the motions of the platform and by the states.

    An error of a motion is one of the next pose in the frame of the object, and turns the velocity
    there as that of the platform in the world is turned.

    Args:
        own: the equations of an object with L states.
        moved: (L, 3, 3) how a turn of the platform changes the velocity.

    Returns:
        (n, 6 L - 6 + 15 L), and the right-hand side (n,).
    """
    graph, values, motions = own.minimum.inertial, own.minimum.values, 6 * len(moved) - 6
    rows, right = [], []
    for i in range(graph.size()):
        linear = graph.at(i).linearize(values)
        A, b = linear.jacobian()
        row, first = np.zeros((len(b), motions + STATE * len(moved))), 0
        for key in list(linear.keys()):
            kind, k = chr(gtsam.symbolChr(key)), gtsam.symbolIndex(key)
            begin, width = PARTS[kind]
            at = motions + STATE * k + begin
            row[:, at : at + width] = A[:, first : first + width]
            first += width
        if len(b) == STATE:
            k = gtsam.symbolIndex(graph.at(i).keys()[2])
            at = motions + STATE * k
            row[:, 6 * k - 6 : 6 * k] = -row[:, at : at + 6]
            row[:, 6 * k - 6 : 6 * k - 3] -= row[:, at + 6 : at + 9] @ moved[k]
        rows.append(row)
        right.append(b)
    return np.vstack(rows), np.concatenate(right)


def motions(path: Trajectory) -> FloatArray:
    """Errors (6 I, 6 I + 6) of the motions between poses, by those of the poses."""
    E = np.zeros((6 * len(path) - 6, 6 * len(path)))
    for k in range(len(path) - 1):
        back = path.pose(k + 1).between(path.pose(k)).AdjointMap()
        E[6 * k : 6 * k + 6, 6 * k : 6 * k + 12] = np.hstack([-back, np.eye(6)])
    return E


def test_step_and_covariance_are_those_of_the_dense_problem(flight: Flight) -> None:
    informed = {n: item.coupling for n, item in flight.together.items() if item.coupling}
    number = max(informed, key=lambda n: float(np.abs(informed[n].information).max()))
    found = flight.apart[number]
    best, _ = joined(flight.platform, {number: found})
    own, world = found.equations, flight.platform.equations
    assert own is not None
    assert world is not None
    stamps_ns, count = own.stamps_ns[own.keyframes], len(own.keyframes)
    platform, _ = interpolate(flight.platform.trajectory, stamps_ns)
    turned = [matrix @ skew(v) for matrix, v in velocities(platform, found, own.keyframes)]
    dynamics, b = inertial_rows(own, -np.array(turned))
    by_keyframes = motions(platform) @ world.error_rows(stamps_ns, rotations(platform))
    size, split = by_keyframes.shape[1], len(by_keyframes)
    S, gradient = own.images()
    images = np.zeros((len(S), dynamics.shape[1]))
    poses = np.concatenate([split + STATE * k + np.arange(6) for k in range(count)])
    images[:, poses] = root(S)
    alone = np.linalg.inv(np.linalg.cholesky(covariance(world)))
    objects = np.vstack([dynamics, images])
    rows = np.block(
        [
            [alone, np.zeros((size, STATE * count))],
            [objects[:, :split] @ by_keyframes, objects[:, split:]],
        ]
    )
    right = [np.zeros(size), b, np.linalg.lstsq(root(S).T, gradient, rcond=1e-12)[0]]
    scale = 1.0 / np.linalg.norm(rows, axis=0)
    Q, R = np.linalg.qr(rows * scale)
    inverse = scale[:, None] * np.linalg.inv(R)
    P, step = inverse[:size] @ inverse[:size].T, inverse @ (Q.T @ np.concatenate(right))
    assert best.equations is not None
    joint, before = covariance(best.equations), covariance(world)
    assert np.trace(joint) < 0.995 * np.trace(before)
    np.testing.assert_allclose(joint, P, atol=1e-3 * P.max())
    made = [
        gtsam.Pose3.Logmap(flight.platform.trajectory.pose(k).between(best.trajectory.pose(k)))
        for k in world.keyframes.tolist()
    ]
    np.testing.assert_allclose(np.ravel(made), step[:size], atol=0.02 * np.abs(step[:size]).max())


def velocities(
    platform: Trajectory, found: FinalBa, keyframes: IntArray
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Axes (3, 3) of the platform in an object, and its velocity (3,) in the world, its axes."""
    assert platform.velocities is not None
    in_object = rotations(found.trajectory.select(keyframes))
    for R, of_world, v in zip(in_object, rotations(platform), platform.velocities, strict=True):
        yield R, of_world.T @ v


def test_a_certain_platform_changes_nothing(flight: Flight) -> None:
    world = flight.platform.equations
    assert world is not None
    certain = world.with_information(1e16 * np.eye(6 * len(world.keyframes)))
    best, together = joined(replace(flight.platform, equations=certain), flight.apart)
    path = flight.platform.trajectory
    np.testing.assert_allclose(best.trajectory.positions, path.positions, atol=1e-9)
    for number, found in flight.apart.items():
        own = found.trajectory
        np.testing.assert_allclose(
            together[number].relative.trajectory.positions, own.positions, atol=1e-8
        )
        assert found.equations is not None
        stamps_ns = own.stamps_ns[2:20]
        by_own = found.equations.error_rows(stamps_ns, rotations(own)[2:20])
        P = by_own @ (by_own @ covariance(found.equations)).T
        adjoint = block_diag(*[own.pose(k).AdjointMap() for k in range(2, 20)])
        np.testing.assert_allclose(
            together[number].covariance(stamps_ns), adjoint @ P @ adjoint.T, atol=1e-7
        )


def test_the_covariance_of_the_platform_never_grows(flight: Flight) -> None:
    before, after = flight.platform.equations, flight.best.equations
    assert before is not None
    assert after is not None
    P, joint = covariance(before), covariance(after)
    assert np.linalg.eigvalsh(P - joint).min() > -1e-9 * np.trace(P)
    sigmas, found = (x.history.sigmas() for x in (flight.platform, flight.best))
    for rows in (slice(0, 3), slice(3, 6)):  # on all axes, as those of the body have turned
        lengths, before_it = (np.linalg.norm(s[:, rows], axis=1) for s in (found, sigmas))
        assert np.all(lengths <= before_it * (1.0 + 1e-6) + 1e-9)
    assert flight.result.final_ba is not None
    np.testing.assert_array_equal(flight.result.final_ba.history.sigmas(), found)


def test_tracks_of_the_platform_do_not_count_twice(flight: Flight) -> None:
    """An object of tracks that the platform has among its own moves nothing."""
    world = flight.platform.equations
    assert world is not None
    same = {
        number: replace(found, equations=replace(found.equations, features=world.features))
        for number, found in flight.apart.items()
        if found.equations is not None
    }
    best, together = joined(flight.platform, same)
    path = flight.platform.trajectory
    np.testing.assert_allclose(best.trajectory.positions, path.positions, atol=1e-12)
    for number, item in together.items():
        stamps_ns = item.relative.trajectory.stamps_ns[2:5]
        assert np.linalg.eigvalsh(flight.together[number].covariance(stamps_ns))[0] > 0.0
        assert np.linalg.eigvalsh(item.covariance(stamps_ns))[0] > 0.0


def test_without_equations_all_stay_as_they_are(flight: Flight) -> None:
    platform = replace(flight.platform, equations=None)
    best, together = joined(platform, flight.apart)
    assert best is platform
    for number, found in flight.apart.items():
        assert together[number].relative is found
        P = together[number].covariance(found.trajectory.stamps_ns[1:3])
        joint = flight.together[number].covariance(found.trajectory.stamps_ns[1:3])
        np.testing.assert_allclose(np.diag(P)[3:6], np.diag(joint)[3:6], rtol=0.5)
        assert np.isnan(P[:6, 6:]).all()


def test_an_object_without_equations_is_placed_by_the_joined_platform(flight: Flight) -> None:
    number = next(iter(flight.apart))
    mixed = flight.apart | {number: replace(flight.apart[number], equations=None)}
    best, together = joined(flight.platform, mixed)
    assert together[number].coupling is None
    assert all(item.platform is best for item in together.values())


def test_objects_that_contradict_the_platform_are_not_joined(
    flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An object that is not at its minimum asks for a step that nothing it measures allows."""
    found = joint_objects._Coupling.of

    def wrong(platform: FinalBa, one: FinalBa) -> joint_objects._Coupling:
        part = found(platform, one)
        return replace(part, gradient=part.gradient + 1e6)

    monkeypatch.setattr(joint_objects._Coupling, "of", staticmethod(wrong))
    best, together = joined(flight.platform, flight.apart)
    assert best is flight.platform
    assert all(item.coupling is None for item in together.values())
