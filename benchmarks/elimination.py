# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One window, linearised and eliminated: by this package's engine, and by GTSAM.

Both are given the windows of the same run, after the Gauss-Newton steps of a frame, and are asked
for a posterior of all variables of the state and for the marginal prior over those that stay. The
engine linearises its arrays, sums the Schur complements of the features and continues by QR. GTSAM
linearises the factor graph of the same cost (`Estimator.factor_graph`), eliminates what leaves, and
then the rest, by QR or by Cholesky. Told are CPU times as multiples of the engine's on the same
window, taken in turn, so that the load of the machine matters little, and how often GTSAM gave up.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.metric import Metric, info
from benchmarks.suite import CORE, Benchmark, Outcome
from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.cost import Cost
from slam_graph.backend.engine import SquareRootEngine
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.gtsam_smoothers.smoother_features import ProjectionFactors, pixel_noise
from slam_graph.backend.solve.gauss_newton import linearized
from slam_graph.config import load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.formats.eqvio import DEMO
from slam_graph.datasets.sequence import Sequence
from slam_graph.experiment import FrontendReport
from slam_graph.sensors.measurements import FeatureFrame, ImuData
from slam_graph.sensors.rig import Rig

RECORDING = "euroc/MH_01_easy_17s"
EVERY = 5
"""One of so many windows is timed; all are tried with Cholesky."""
REPETITIONS = 5
"""Each time is the least of so many."""

Tracked = tuple[ImuData, FeatureFrame]
"""A frame with its features, and the IMU samples since the one before."""

Times = dict[str, float]
"""CPU time by name, in seconds; NaN where it was given up."""


@dataclass(slots=True)
class Windows:
    """What was measured under one algorithm.

    Attributes:
        times: of each window that was timed.
        observations: of each of these.
        columns: dimension of the engine's linear system, features outside the state not counted.
        variance_errors: largest relative error of a variance by Cholesky, taking QR for true;
            infinite where Cholesky gave up.
        tried: how many windows were given to Cholesky.
        failed: how many of them it gave up.
    """

    times: list[Times] = field(default_factory=list)
    observations: list[int] = field(default_factory=list)
    columns: list[int] = field(default_factory=list)
    variance_errors: list[float] = field(default_factory=list)
    tried: int = 0
    failed: int = 0


def measure(data: Path) -> Outcome:
    """Times of GTSAM over those of the engine, for each algorithm."""
    outcome = Outcome()
    for label, recording in (("mh01", data / RECORDING), ("demo", DEMO)):
        sequence = open_dataset(recording)
        frames = tracked(sequence)
        with threadpool_limits(limits=1, user_api="blas"):
            for name in CORE:
                windows = measured(name, sequence.rig, frames)
                outcome.add(f"{label}.{name}", figures(windows), judged=False)
    outcome.notes += [
        "medians over windows; `own`: posterior and next prior of the engine, linearised and "
        "eliminated; `gtsam_KIND` is the same by GTSAM with factors that exist, "
        "`gtsam_KIND_with_build` with projection factors that are made for the window",
        "`gtsam_sequential_KIND` is one elimination of all variables in COLAMD order, without a "
        "next prior, and without the linearisation",
    ]
    return outcome


def tracked(sequence: Sequence) -> list[Tracked]:
    """All frames of a recording with their features."""
    if sequence.info().content == "images":
        found: list[Tracked] = []
        FrontendReport.of_tracks(
            sequence,
            load_config(),
            "",
            lambda packet, features: found.append((packet.imu, features)),
        )
        return found
    frames: list[Tracked] = []
    for packet in sequence.packets():
        assert isinstance(packet.frame, FeatureFrame)
        frames.append((packet.imu, packet.frame))
    return frames


def measured(algorithm: str, rig: Rig, frames: list[Tracked]) -> Windows:
    """Run an algorithm, and measure some of its windows."""
    config = load_config(algorithm=algorithm)
    estimator = Estimator(rig, config.algorithm, config.backend)
    windows = Windows()
    for number, (imu, features) in enumerate(frames):
        estimator.add_imu(imu)
        state = estimator.add_frame(features)
        cost = cost_of(estimator)
        if state is None or cost is None:
            continue
        windows.tried += 1
        windows.failed += gives_up(estimator)
        if cost.tracks is not None and number % EVERY == 0:
            add_window(windows, estimator, cost, rig)
    return windows


def cost_of(estimator: Estimator) -> Cost | None:
    """The cost of the last step, of which `Estimator.factor_graph` is the graph."""
    engine = estimator._engine
    assert isinstance(engine, SquareRootEngine)
    cost = engine._cost
    if cost is None or cost.tracks is None:
        return cost
    return cost.part(cost.factors, np.ones(len(cost.tracks.points), np.bool_))


def gives_up(estimator: Estimator) -> bool:
    """Whether GTSAM's Cholesky finds the window of the last step indeterminate."""
    graph = estimator.factor_graph()
    try:
        graph.graph.linearize(graph.values).eliminateSequential()
    except RuntimeError:
        return True
    return False


def add_window(windows: Windows, estimator: Estimator, cost: Cost, rig: Rig) -> None:
    """Measure the window of the last step."""
    window = estimator.window
    assert window is not None
    assert cost.tracks is not None
    layout = cost.layout()
    keep = [key for key in window.state.variables() if key in layout]
    graph = estimator.factor_graph()
    gone = [key for key in graph.values.keys() if key not in set(keep)]  # noqa: SIM118
    linear = graph.graph.linearize(graph.values)
    factors = ProjectionFactors(rig, pixel_noise(cost.config.noise.pixel_sigma, cost.robust))
    observed = [cost.tracks.obs] + ([cost.landmarks] if cost.landmarks is not None else [])

    def cholesky() -> gtsam.GaussianFactorGraph:
        prior = linear.eliminatePartialMultifrontal(gone)[1]
        prior.eliminateMultifrontal()
        return prior

    def qr() -> gtsam.GaussianFactorGraph:
        prior = linear.eliminatePartialMultifrontal(gone, gtsam.EliminateQR)[1]
        prior.eliminateMultifrontal(function=gtsam.EliminateQR)
        return prior

    work: dict[str, Callable[[], Any]] = {
        "own": lambda: linearized(cost).marginal(keep),
        "gtsam_build": lambda: [factors.of(obs) for obs in observed],
        "gtsam_linearize": lambda: graph.graph.linearize(graph.values),
        "gtsam_eliminate_cholesky": cholesky,
        "gtsam_eliminate_qr": qr,
        "gtsam_sequential_cholesky": linear.eliminateSequential,
        "gtsam_sequential_qr": lambda: linear.eliminateSequential(
            gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR
        ),
    }
    windows.times.append({name: least_cpu_s(job) for name, job in work.items()})
    windows.observations.append(sum(len(obs) for obs in observed))
    windows.columns.append(layout.size)
    windows.variance_errors.append(variance_error(cholesky, qr))


def least_cpu_s(job: Callable[[], object]) -> float:
    """The least CPU time of a few repetitions; NaN if the linear system was found indeterminate."""
    times = []
    for _ in range(REPETITIONS):
        began_s = time.thread_time()
        try:
            job()
        except RuntimeError:
            return np.nan
        times.append(time.thread_time() - began_s)
    return min(times)


def variance_error(
    cholesky: Callable[[], gtsam.GaussianFactorGraph], qr: Callable[[], gtsam.GaussianFactorGraph]
) -> float:
    """Largest relative difference of the variances of the variables that stay."""
    try:
        return float(np.max(np.abs(variances(cholesky()) / variances(qr()) - 1.0)))
    except (RuntimeError, np.linalg.LinAlgError):
        return np.inf


def variances(graph: gtsam.GaussianFactorGraph) -> FloatArray:
    """(n,) marginal variances under a linear system."""
    ordering = gtsam.Ordering()
    for key in sorted(graph.keyVector()):
        ordering.push_back(key)
    information, _ = graph.hessian(ordering)
    scale = np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information / np.outer(scale, scale))
    return np.asarray(np.diag(inverse) / scale**2)


def figures(windows: Windows) -> Iterator[Metric]:
    """Medians over the windows that were timed, and how often Cholesky gave up."""

    def column(name: str) -> FloatArray:
        return np.array([times[name] for times in windows.times])

    own = column("own")
    yield info("windows", len(own), "")
    yield info("observations", float(np.median(windows.observations)), "")
    yield info("columns", float(np.median(windows.columns)), "")
    yield info("own", 1e3 * float(np.median(own)), "ms CPU")
    for name in windows.times[0]:
        if name != "own":
            yield info(name, float(np.nanmedian(column(name) / own)), "× own")
    for kind in ("cholesky", "qr"):
        known = column("gtsam_linearize") + column(f"gtsam_eliminate_{kind}")
        yield info(f"gtsam_{kind}", float(np.nanmedian(known / own)), "× own")
        whole = known + column("gtsam_build")
        yield info(f"gtsam_{kind}_with_build", float(np.nanmedian(whole / own)), "× own")
    errors = np.array(windows.variance_errors)
    yield info("cholesky_tried", windows.tried, "windows")
    yield info("cholesky_failed", windows.failed, "windows")
    yield info("cholesky_variance_error", float(np.median(errors)), "")
    yield info("cholesky_variance_error_max", float(np.max(errors)), "")


BENCHMARKS = {
    "elimination": Benchmark(
        "windows of MH_01 stereo and the demo: GTSAM's elimination over the engine's",
        (RECORDING,),
        measure,
    )
}
