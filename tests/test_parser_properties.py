# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of the readers of text files: what is written is read again, and anything is judged.

Round trips over generated values; then arbitrary and near-valid content, which is read as finite
values with increasing times, or refused in one line.
"""

import bz2
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import (
    ANYTHING,
    LARGEST_STAMP_NS,
    dressed,
    examples,
    finite,
    in_seconds,
    parsed,
    quaternions,
    rows_of,
    stamps,
    trajectories,
    vectors,
)
from scipy.spatial.transform import Rotation

from slam_graph.bundle_adjustment.bal_file import bal_lines, is_bal, read_bal
from slam_graph.bundle_adjustment.bal_problem import BalEstimates, BalProblem
from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.datasets.streams.aiding_files import aiding_texts, read_aiding
from slam_graph.datasets.streams.csv_rows import nanoseconds, read_rows
from slam_graph.datasets.streams.imu_stream import ImuFile, parse_imu_rows
from slam_graph.datasets.streams.object_truth import object_truth_lines, read_object_truth
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import Trajectory
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_files import g2o_lines, read_pose_graph
from slam_graph.sensors import AidingData, ImuData

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]


def alike(one: Trajectory, other: Trajectory, decimals: float) -> None:
    """The same trajectory, but for rounding of its numbers and of their last bits."""
    np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
    for name in ("positions", "quaternions", "velocities", "gyro_biases", "accel_biases"):
        mine, its = getattr(one, name), getattr(other, name)
        assert (mine is None) == (its is None)
        if mine is not None:
            np.testing.assert_allclose(mine, its, rtol=1e-14, atol=decimals)


# --- trajectories ---------------------------------------------------------------------------------

SECONDS_NS = LARGEST_STAMP_NS // 10**9 * 10**9
"""Times of files in seconds are whole seconds nearer to zero."""


@examples()
@given(st.data())
def test_tum_trajectories(folder: Path, data: st.DataObject) -> None:
    limits = {"least": 1 - SECONDS_NS, "end": SECONDS_NS}
    written = data.draw(trajectories(columns=(7,), **limits))
    path = folder / "flight.tum"
    path.write_bytes(data.draw(dressed("".join(written.tum_lines()), ("#", "%"))))
    alike(read_groundtruth(path), written, 2e-9)


@examples()
@given(st.data())
def test_euroc_trajectories(folder: Path, data: st.DataObject) -> None:
    written = data.draw(trajectories())
    path = folder / "flight.csv"
    path.write_bytes(data.draw(dressed("".join(written.euroc_lines()), ("#", "%"))))
    alike(read_groundtruth(path), written, 2e-9)


@examples()
@given(st.integers(1 - SECONDS_NS, SECONDS_NS - 1), st.integers(0, 12))
def test_seconds_are_exact_to_the_nanosecond(stamp_ns: int, zeros: int) -> None:
    text = in_seconds(stamp_ns)
    for written in (text, text + "0" * zeros, f"{stamp_ns}e-9", f" {text}\t"):
        assert nanoseconds(written) == stamp_ns


def check_trajectory(path: Path) -> None:
    truth = read_groundtruth(path)
    assert (np.diff(truth.stamps_ns) > 0).all()  # and does not overflow
    assert len(truth) > 0
    np.testing.assert_allclose(np.linalg.norm(truth.quaternions, axis=1), 1.0, atol=1e-12)
    for values in (truth.positions, truth.velocities, truth.gyro_biases, truth.accel_biases):
        assert values is None or np.isfinite(values).all()


# --- samples of an IMU, position fixes, odometry, known poses, objects ----------------------------


@st.composite
def samples(draw: st.DrawFn, largest: float = 1e300) -> ImuData:
    times = draw(stamps(fewest=1))
    rows = np.array([draw(vectors(6, largest)) for _ in times])
    return ImuData(times, rows[:, :3], rows[:, 3:])


def imu_of(path: Path) -> ImuData:
    return ImuData.concatenate([parse_imu_rows(rows) for rows in read_rows(path)])


@examples()
@given(st.data())
def test_samples(folder: Path, data: st.DataObject) -> None:
    """Of the columns of EuRoC, to the bit."""
    imu = data.draw(samples())
    rows = zip(imu.stamps_ns.tolist(), imu.gyro.tolist(), imu.accel.tolist(), strict=True)
    lines = ["#timestamp [ns],w,a", *(",".join(map(repr, [t, *w, *a])) for t, w, a in rows)]
    path = folder / "imu.csv"
    path.write_bytes(data.draw(dressed("\n".join(lines), ("#", "%"))))
    found = imu_of(path)
    np.testing.assert_array_equal(found.stamps_ns, imu.stamps_ns)
    np.testing.assert_array_equal(found.gyro, imu.gyro)
    np.testing.assert_array_equal(found.accel, imu.accel)


@st.composite
def aiding(draw: st.DrawFn) -> AidingData:
    """Position fixes, odometry and known poses, or some of these."""
    sigma, data = st.floats(1e-6, 1e6), AidingData.empty()
    fixes, moves, known = draw(stamps()), draw(stamps()), draw(stamps())
    if len(fixes):
        places = np.array([draw(vectors(3)) for _ in fixes])
        sigmas = np.array([[draw(sigma) for _ in range(3)] for _ in fixes])
        covariances = sigmas[:, :, None] ** 2 * np.eye(3)
        datum = draw(st.none() | st.tuples(finite(90.0), finite(360.0), finite(1e6)))
        data = AidingData.of_fixes(fixes, places, covariances, datum)
    if len(moves):
        turns = np.array([draw(quaternions()) for _ in moves])
        data = data.with_odometry(moves, np.array([draw(vectors(3)) for _ in moves]), turns)
    if len(known):
        turns = np.array([draw(quaternions()) for _ in known])
        sigmas = np.array([[draw(sigma) for _ in range(6)] for _ in known])
        places = np.array([draw(vectors(3, 1e6)) for _ in known])
        data = data.with_poses(known, places, turns, sigmas)
    return data


@examples()
@given(st.data())
def test_aiding(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    written, folder = data.draw(aiding()), tmp_path_factory.mktemp("aiding")
    for name, text in aiding_texts(written).items():
        (folder / name).write_bytes(data.draw(dressed(text)))
    diagnostics = Diagnostics()
    found = read_aiding([folder], {}, diagnostics)
    assert not diagnostics.counts
    assert found.datum == written.datum
    for name in ("fix_stamps_ns", "odometry_stamps_ns", "pose_stamps_ns", "fix_positions"):
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))
    for name in ("odometry_positions", "odometry_quaternions", "pose_positions", "pose_sigmas"):
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))
    np.testing.assert_allclose(found.fix_covariances, written.fix_covariances, rtol=1e-14)


@examples(30)
@given(st.dictionaries(st.integers(-(2**63), 2**63 - 1), trajectories(columns=(7,)), max_size=3))
def test_true_poses_of_objects(folder: Path, truth: dict[int, Trajectory]) -> None:
    path = folder / "objects_truth.csv"
    path.write_text("".join(object_truth_lines(truth)))
    found = read_object_truth(path)
    assert found.keys() == truth.keys()
    for number, one in truth.items():
        np.testing.assert_array_equal(found[number].stamps_ns, one.stamps_ns)
        np.testing.assert_allclose(found[number].positions, one.positions, rtol=1e-8)


def check_imu(path: Path) -> None:
    for imu in ImuFile(path, parse_imu_rows).blocks(Diagnostics(), None):
        assert (np.diff(imu.stamps_ns) > 0).all()
        assert np.isfinite([imu.gyro, imu.accel]).all()


def check_aiding(path: Path) -> None:
    """As each of the three files."""
    named = {"gnss": "fix", "odometry": "odometry", "poses": "pose"}
    for sensor, prefix in named.items():
        found = parsed(read_aiding, [], {sensor: str(path)}, Diagnostics())
        if found is not None:
            times = getattr(found, f"{prefix}_stamps_ns")
            assert (times[1:] > times[:-1]).all()
            assert np.isfinite(getattr(found, f"{prefix}_positions")).all()
            assert np.isfinite(found.fix_covariances).all()


def check_objects(path: Path) -> None:
    for path_of_one in read_object_truth(path).values():
        assert np.isfinite(path_of_one.positions).all()
        assert (np.diff(path_of_one.stamps_ns) > 0).all()


# --- pose graphs ----------------------------------------------------------------------------------


@st.composite
def graphs(draw: st.DrawFn, dimension: int, largest: float = 1e17) -> tuple[PoseGraph, Poses]:
    """Graphs of two to five poses with any ids, each but the first with an edge to one before."""
    ids = st.lists(st.integers(-(2**63), 2**63 - 1), min_size=2, max_size=5, unique=True)
    keys = np.array(sorted(draw(ids)), np.int64)
    ends = np.array([[draw(st.integers(0, k - 1)), k] for k in range(1, len(keys))])
    k = 3 * (dimension - 1)

    def some(count: int) -> Poses:
        places = np.array([draw(vectors(dimension, largest)) for _ in range(count)])
        if dimension == 3:
            turns = np.array([draw(quaternions()) for _ in range(count)])
            return Poses(Rotation.from_quat(turns).as_matrix(), places)
        angles = np.array([draw(finite(3.2)) for _ in range(count)])
        cos, sin = np.cos(angles), np.sin(angles)
        return Poses(np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2), places)

    scale = draw(st.floats(1e-12, 1e12))
    factors = np.array([draw(vectors(k * k, 1.0)) for _ in ends]).reshape(-1, k, k)
    information = scale * (factors @ factors.transpose(0, 2, 1) + np.eye(k))
    estimates = some(len(keys))
    return PoseGraph(keys, estimates, ends, some(len(ends)), information), estimates


@pytest.mark.parametrize("dimension", [2, 3])
@examples(40)
@given(data=st.data())
def test_g2o(folder: Path, dimension: int, data: st.DataObject) -> None:
    graph, estimates = data.draw(graphs(dimension))
    path = folder / "graph.g2o"
    path.write_bytes(data.draw(dressed("".join(g2o_lines(graph, estimates)))))
    diagnostics = Diagnostics()
    found = read_pose_graph(path, diagnostics)
    assert not diagnostics.counts
    np.testing.assert_array_equal(found.keys, graph.keys)
    np.testing.assert_array_equal(found.edges, graph.edges)
    assert found.estimates is not None
    for mine, its in ((found.estimates, estimates), (found.measured, graph.measured)):
        np.testing.assert_array_equal(mine.translations, its.translations)
        np.testing.assert_allclose(mine.rotations, its.rotations, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(
        found.information, np.triu(graph.information) + np.triu(graph.information, 1).mT
    )


@examples(40)
@given(data=st.data(), with_information=st.booleans())
def test_toro(folder: Path, data: st.DataObject, with_information: bool) -> None:
    """Information is in the order xx xy yy θθ xθ yθ, or left out."""
    places = data.draw(st.lists(vectors(3, 3.0), min_size=2, max_size=5))
    weights = data.draw(st.lists(st.floats(1e-6, 1e6), min_size=3, max_size=3))
    cross = [0.1 * np.sqrt(weights[0] * weights[k]) for k in (1, 2)]
    lines = [f"VERTEX2 {k} {x!r} {y!r} {a!r}" for k, (x, y, a) in enumerate(places)]
    order = [weights[0], cross[0], weights[1], weights[2], cross[1], 0.0]
    more = " ".join(map(repr, map(float, order))) if with_information else ""
    for k, (x, y, a) in enumerate(places[1:]):
        lines.append(f"EDGE2 {k} {k + 1} {x!r} {y!r} {a!r} {more}".rstrip())
    path = folder / "graph.graph"
    path.write_bytes(data.draw(dressed("\n".join(lines))))
    found = read_pose_graph(path)
    wanted = np.diag(weights)
    wanted[0, 1] = wanted[1, 0] = cross[0]
    wanted[0, 2] = wanted[2, 0] = cross[1]
    for one in found.information:
        np.testing.assert_array_equal(one, wanted if with_information else np.eye(3))
    np.testing.assert_array_equal(found.measured.translations, np.array(places)[1:, :2])
    turned = np.array(places)[1:, 2]
    np.testing.assert_allclose(np.cos(found.measured.angles() - turned), 1.0, atol=1e-14)


def check_graph(path: Path) -> None:
    graph = read_pose_graph(path)
    assert len(graph.edges) > 0
    for of in (graph.measured, graph.estimates):
        assert of is None or (
            np.isfinite(of.rotations).all() and np.isfinite(of.translations).all()
        )
    assert np.isfinite(graph.information).all()


# --- bundle adjustment ----------------------------------------------------------------------------


@st.composite
def problems(draw: st.DrawFn, largest: float = 1e17) -> BalProblem:
    """One to three cameras and points, and one to five observations."""
    cameras, points = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    seen = draw(
        st.lists(
            st.tuples(st.integers(0, cameras - 1), st.integers(0, points - 1)),
            min_size=1,
            max_size=5,
        )
    )
    turns = np.array([draw(quaternions()) for _ in range(cameras)])
    estimates = BalEstimates(
        Rotation.from_quat(turns).as_matrix(),
        np.array([draw(vectors(3, largest)) for _ in range(cameras)]),
        np.array([draw(vectors(3, largest)) for _ in range(cameras)]),
        np.array([draw(vectors(3, largest)) for _ in range(points)]),
    )
    camera, point = np.array(seen, np.int64).T
    pixels = np.array([draw(vectors(2, largest)) for _ in seen])
    return BalProblem(estimates, camera, point, pixels, "problem")


@examples(40)
@given(data=st.data(), packed=st.booleans())
def test_bal(folder: Path, data: st.DataObject, packed: bool) -> None:
    problem = data.draw(problems())
    content = data.draw(dressed("".join(bal_lines(problem, problem.estimates)), ()))
    path = folder / "problem.txt"
    path.write_bytes(bz2.compress(content) if packed else content)
    assert is_bal(path)
    found = read_bal(path)
    for name in ("camera", "point", "pixels"):
        np.testing.assert_array_equal(getattr(found, name), getattr(problem, name))
    for name in ("translations", "intrinsics", "points"):
        wanted = getattr(problem.estimates, name)
        np.testing.assert_array_equal(getattr(found.estimates, name), wanted)
    mine, its = found.estimates.rotations, problem.estimates.rotations
    np.testing.assert_allclose(mine, its, rtol=0.0, atol=1e-12)


def check_bal(path: Path) -> None:
    parsed(is_bal, path)
    problem = read_bal(path)
    for values in (problem.pixels, problem.estimates.points, problem.estimates.rotations):
        assert np.isfinite(values).all()
    assert (problem.camera < problem.cameras).all()
    assert (problem.point < problem.points).all()


NEAR_BAL = st.one_of(
    rows_of(" ", 4).map(lambda text: f"1 1 1\n{text}"),
    st.lists(
        st.floats(-10.0, 10.0).map(repr) | st.sampled_from(["nan", "1e101", "x", "0x1", "-"])
    ).map(lambda values: "1 1 1\n0 0 " + "\n".join(values)),
    st.lists(st.floats(-10.0, 10.0).map(repr), min_size=14, max_size=14).map(
        lambda values: "1 1 1\n0 0 " + " ".join(values)
    ),
)

# --- anything -------------------------------------------------------------------------------------

GRAPH_TAGS = ("VERTEX2", "EDGE2", "VERTEX_SE2", "EDGE_SE2", "ODOMETRY", "EDGE3", "EDGE_SE3:QUAT")

READERS: dict[str, tuple[Callable[[Path], None], Any]] = {
    "tum": (check_trajectory, rows_of(" ", 8)),
    "euroc": (check_trajectory, rows_of(",", 8) | rows_of(",", 17)),
    "imu": (check_imu, rows_of(",", 7)),
    "fixes": (check_aiding, rows_of(",", 7)),
    "poses": (check_aiding, rows_of(",", 8) | rows_of(",", 14)),
    "nmea": (
        check_aiding,
        rows_of(",", 14, ("1,$GPGGA,", "$GPGGA,", "1403636579763555584,$GPGGA,")),
    ),
    "objects": (check_objects, rows_of(",", 9)),
    "2d graph": (check_graph, rows_of(" ", 11, GRAPH_TAGS)),
    "3d graph": (check_graph, rows_of(" ", 29, ("EDGE3", "VERTEX3", "EDGE_SE3:QUAT"))),
    "bal": (check_bal, NEAR_BAL),
}


@pytest.mark.parametrize("name", READERS)
@examples(80)
@given(data=st.data())
def test_lines_that_are_nearly_right(folder: Path, name: str, data: st.DataObject) -> None:
    check, lines = READERS[name]
    path = folder / "lines.txt"
    path.write_bytes(data.draw(lines).encode("utf-8", "surrogatepass"))
    parsed(check, path)


@examples(150)
@given(content=ANYTHING)
def test_anything(folder: Path, content: bytes) -> None:
    path = folder / "anything.txt"
    path.write_bytes(content)
    for check in {check for check, _ in READERS.values()}:
        parsed(check, path)
