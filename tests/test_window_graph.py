# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The window as a factor graph: its linearisation has the engine's normal equations."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from flight import FISHEYE, RADTAN, Flight, packets, rig, room
from groups import slow_but
from typer.testing import CliRunner

from slam_graph.arrays import FloatArray
from slam_graph.backend import engine
from slam_graph.backend.backend_config import (
    BackendConfig,
    CalibrationConfig,
    InitializationConfig,
    NoiseConfig,
)
from slam_graph.backend.cost.cost import Cost
from slam_graph.backend.engine import SquareRootEngine
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.solve import gauss_newton
from slam_graph.backend.solve.gauss_newton import linearized
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.cli.main import app
from slam_graph.config import algorithm_names, load_config
from slam_graph.errors import EstimationError
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations

OWN = [n for n in algorithm_names() if load_config(algorithm=n).algorithm.engine == "square_root"]
BRIEF = ("msckf", "okvis")
"""Of these, what `make test` runs of the longer tests."""
SMOOTHERS = [name for name in algorithm_names() if name not in OWN]
SIGMAS = np.array([0.02, 0.05, 0.1, 0.1, 0.01])
DOUBLE_SPHERE = Camera(200.0, 201.0, 254.0, 256.0, "double_sphere", (-0.1, 0.55), 512, 512)
EVERYTHING = CalibrationConfig(extrinsics=True, time_offset=True, intrinsics=True, distortion=True)


def steps(
    name: str,
    camera: Camera = RADTAN,
    cameras: int = 2,
    calibration: CalibrationConfig | None = None,
    outliers: float = 0.0,
    noise: NoiseConfig | None = None,
    **policies: Any,
) -> Iterator[Estimator]:
    """An estimator after each frame of a noisy flight of 1.6 s, with a share of wrong pixels."""
    config = BackendConfig(
        initialization=InitializationConfig(mode="given", check_calibration=False),
        calibration=calibration or CalibrationConfig(),
        noise=noise or NoiseConfig(),
    )
    mounted, rng = rig(cameras, camera), np.random.default_rng(5)
    algorithm = load_config(algorithm=name).algorithm
    changed = type(algorithm).model_validate({**algorithm.model_dump(), **policies})
    estimator = Estimator(mounted, changed, config)
    estimator.start(Flight().nav_state(0.0, SIGMAS))
    for packet in packets(Flight(), mounted, room(60, rng), 1.6, rng, 20.0):
        assert isinstance(packet.frame, FeatureFrame)
        seen = []
        for mount, camera_features in zip(mounted.cameras, packet.frame.cameras, strict=True):
            wrong = rng.random(len(camera_features)) < outliers
            pixels = camera_features.pixels + 15.0 * wrong[:, None]
            normalized = mount.camera.undistort(pixels)
            seen.append(FeatureObservations(camera_features.ids, pixels, normalized))
        estimator.add_imu(packet.imu)
        estimator.add_frame(FeatureFrame(packet.frame.stamp_ns, tuple(seen)))
        yield estimator


def flown(name: str, camera: Camera = RADTAN, **options: Any) -> Estimator:
    """An estimator after the flight."""
    *_, estimator = steps(name, camera, **options)
    return estimator


def eliminated(linear: gtsam.GaussianFactorGraph, keys: list[int]) -> tuple[FloatArray, FloatArray]:
    """Information and its right-hand side over some variables, all others eliminated."""
    ordering, inside = gtsam.Ordering(), set(keys)
    others = [k for k in linear.keyVector() if k not in inside]
    for key in [*others, *keys]:
        ordering.push_back(key)
    A, b = linear.jacobian(ordering)
    R = np.linalg.qr(np.column_stack([A, b]), mode="r")
    first = 3 * len(others)  # all that are eliminated are features
    size = A.shape[1] - first
    R, d = R[first : first + size, first:-1], R[first : first + size, -1]
    return R.T @ R, R.T @ d


def check(estimator: Estimator) -> int:
    """Compare the two; how many features outside the state were in the cost."""
    own = estimator._engine
    assert isinstance(own, SquareRootEngine)
    assert own._cost is not None
    count = len(own._cost.tracks.points) if own._cost.tracks is not None else 0
    cost = own._cost.part(own._cost.factors, np.ones(count, np.bool_))
    expected: SquareRootInformation = linearized(cost)
    window = estimator.factor_graph()
    known = set(window.values.keys())
    assert known.issuperset(expected.layout.dims)
    extra = {k for k in known if k not in expected.layout}
    assert all(chr(gtsam.Symbol(k).chr()) == "l" for k in extra), "only features are eliminated"
    information, right = eliminated(window.linearize(), list(expected.layout.dims))
    theirs = expected.R.T @ expected.R
    scale = np.sqrt(np.diag(theirs))
    np.testing.assert_allclose(
        information / np.outer(scale, scale), theirs / np.outer(scale, scale), atol=1e-9
    )
    size = max(float(np.abs(expected.d).max()), 1.0)
    np.testing.assert_allclose(right / scale, expected.R.T @ expected.d / scale, atol=1e-9 * size)
    return len(cost.tracks.points) if cost.tracks is not None else 0


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("name", OWN)
def test_it_has_the_normal_equations_of_the_engine(name: str, cameras: int) -> None:
    estimator = flown(name, cameras=cameras)
    check(estimator)
    window = estimator.factor_graph()
    points = [k for k in window.values.keys() if chr(gtsam.Symbol(k).chr()) == "l"]  # noqa: SIM118
    assert len(points) > 5


@pytest.mark.parametrize("name", slow_but(BRIEF, OWN))
def test_so_it_has_at_every_frame_with_outliers(name: str) -> None:
    flight = steps(name, cameras=1, outliers=0.1)
    next(flight)  # the start, which has no step
    assert sum(check(estimator) for estimator in flight) > 5, "no features outside the state"


@pytest.mark.parametrize(
    "gauss_newton_steps",
    [{"max_steps": 1}, {"max_steps": 12, "tolerance": 1e-10}],
    ids=["one", "many"],
)
def test_the_prior_is_made_of_it_where_the_last_step_began(
    gauss_newton_steps: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The graph is linearised where that step ended: what differs in the two is that step alone.

    With first estimates a further step may raise the cost, and then the last one is not small.
    """
    began: list[Any] = []
    take_step = gauss_newton._step

    def noted(cost: Cost, *rest: Any) -> Any:
        began.append(cost.snapshot())
        return take_step(cost, *rest)

    def first_of(*arguments: Any, **named: Any) -> gauss_newton.Minimum:
        began.clear()
        found.append(gauss_newton.minimize(*arguments, **named))
        return found[-1]

    found: list[gauss_newton.Minimum] = []
    monkeypatch.setattr(gauss_newton, "_step", noted)
    monkeypatch.setattr(engine, "minimize", first_of)
    flight = steps("msckf", cameras=1, outliers=0.1, gauss_newton=gauss_newton_steps)
    next(flight)
    unequal = 0
    for estimator in flight:
        own, minimum = estimator._engine, found[-1]
        assert isinstance(own, SquareRootEngine)
        assert own._cost is not None
        expected = minimum.posterior.R.T @ minimum.posterior.R
        scale = np.sqrt(np.diag(expected))
        keys = list(minimum.posterior.layout.dims)
        after = eliminated(estimator.factor_graph().linearize(), keys)[0]
        own._cost.restore(began[len(minimum.costs) - 2])  # the trials that were undone are last
        before = eliminated(estimator.factor_graph().linearize(), keys)[0]
        unequal += bool(np.abs((after - expected) / np.outer(scale, scale)).max() > 1e-6)
        normalized = (before - expected) / np.outer(scale, scale)
        np.testing.assert_allclose(normalized, 0.0, atol=1e-9)
    assert unequal > 0


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("name", slow_but(BRIEF, OWN))
def test_so_it_has_with_the_calibration_as_variables(name: str, cameras: int) -> None:
    check(flown(name, cameras=cameras, calibration=EVERYTHING))


@pytest.mark.parametrize("name", slow_but(BRIEF, OWN))
def test_so_it_has_while_it_learns_the_noise_of_each_camera(name: str) -> None:
    learns = NoiseConfig(adaptive_pixels="any")
    before = np.ones(2)
    for number, estimator in enumerate(steps(name, noise=learns)):
        pixels = estimator._context.pixels
        if number == 0:  # what was learned in one camera counts in it only
            before = pixels.sigma_px = np.array([0.7, 1.4])
            continue
        own = estimator._engine
        assert isinstance(own, SquareRootEngine)
        assert own._cost is not None
        np.testing.assert_array_equal(own._cost.sigma_px, before)  # not what came later
        check(estimator)
        before = pixels.sigma_px


@pytest.mark.parametrize("camera", [FISHEYE, DOUBLE_SPHERE], ids=lambda c: c.distortion)
def test_so_it_has_with_other_cameras(camera: Camera) -> None:
    check(flown("okvis", camera))


def test_it_is_serialised_and_read_back() -> None:
    for name, calibration in (("okvis", None), ("msckf", EVERYTHING)):
        window = flown(name, calibration=calibration).factor_graph()
        texts = window.texts()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.deserialize(texts["graph.txt"])
        values.deserialize(texts["values.txt"])
        assert graph.size() == window.graph.size()
        assert graph.error(values) == pytest.approx(window.graph.error(window.values), rel=1e-9)
        assert texts["graph.dot"].startswith("graph {")


@pytest.mark.parametrize("name", SMOOTHERS)
def test_smoothers_have_a_graph_too(name: str) -> None:
    estimator = flown(name)
    window = estimator.factor_graph()
    assert window.graph.size() > 10
    assert window.linearize().size() == window.graph.size()


def test_a_run_saves_the_graphs_that_are_asked_for(tmp_path: Path) -> None:
    options = ["--duration", "8", "--save-graph", "6.5", "--save-graph", "99"]
    out = CliRunner().invoke(
        app,
        ["run", "demo", *options, "--output", str(tmp_path), "--no-progress", "--no-final-ba"],
    )
    assert out.exit_code == 0, out.output
    folder = next(tmp_path.glob("*/latest"))
    (file,) = folder.glob("graph_*_graph.txt")
    graph = gtsam.NonlinearFactorGraph()
    graph.deserialize(file.read_text())
    assert graph.size() > 10
    assert json.loads((folder / "metrics.json").read_text())["warnings"]["graph_not_saved"] == 1


def test_without_a_state_there_is_none() -> None:
    estimator = Estimator(rig(), load_config().algorithm)
    with pytest.raises(EstimationError, match="no state"):
        estimator.factor_graph()


def test_a_second_start_leaves_nothing_of_the_first() -> None:
    estimator = flown("msckf")
    estimator.start(Flight().nav_state(2.0, SIGMAS))
    assert estimator.factor_graph().values.size() == 3  # pose, velocity, bias
