# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Maps: second halves of flights located in maps of the first, and both maps merged."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.metric import EXACT, QUANTISED_TOLERANCE, Metric, info
from benchmarks.suite import Benchmark, Outcome
from slam_graph.config import load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.errors import EstimationError
from slam_graph.maps.map_merge import merge_maps
from slam_graph.maps.map_model import SlamMap
from slam_graph.pipeline.run_recording import run
from slam_graph.results.localization_result import errors_in_map, map_alignment
from slam_graph.results.run_result import RunResult
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulation_config import (
    ImageConfig,
    LandmarkConfig,
    SimulationConfig,
    TrackConfig,
)
from slam_graph.simulation.simulator import simulate

SEEDS, HALF_S, RATE_HZ = 5, 60.0, 10.0
IMAGES_SEED, IMAGES_HALF_S, IMAGES_RATE_HZ = 1, 60.0, 5.0

MH01, MH01_HALF_S = "euroc/MH_01_easy_17s", 8.5

WITHIN_M, WITHIN_DEG = 0.05, 2.0
SHARE_BAR = 0.95
"""Share of all frames of the second half, those before the first fix included, that must be within
these of the truth."""

MERGED_BAR_M = 0.02
"""Error of the keyframes of a merged map, root mean square, when both halves are aligned as one."""


def flight(seed: int, cameras: int, images: bool) -> SimulatedSequence:
    """A tour through three rooms, of which each lap takes 40 s."""
    half_s = IMAGES_HALF_S if images else HALF_S
    return simulate(
        SimulationConfig(
            kind="images" if images else "tracks",
            trajectory="rooms",
            duration_s=2 * half_s,
            rate_hz=IMAGES_RATE_HZ if images else RATE_HZ,
            seed=seed,
            cameras=cameras,
            landmarks=LandmarkConfig(density=4.0),
            tracks=TrackConfig(features=80, loss=0.02, outliers=0.01, descriptors=True),
            images=ImageConfig(texel_m=0.012),
        )
    )


def mapped(sequence: SimulatedSequence, half_s: float, start_s: float = 0.0) -> RunResult:
    """A run over a half that makes a map."""
    settings = ["map.enabled=true", "loop_closure.enabled=true"]
    return run(sequence, load_config(None, settings, start_s=start_s, duration_s=half_s))


def located(seeds: range, cameras: int, images: bool, judged: bool, folder: Path) -> Outcome:
    """Second halves, whose start is not known, in maps of first halves."""
    outcome, half_s = Outcome(), IMAGES_HALF_S if images else HALF_S
    shares, errors, first = [], [], []
    for seed in seeds:
        known = mapped(flight(seed, cameras, images), half_s)
        if known.slam_map is None or known.input.truth is None:
            return Outcome(failure=f"seed {seed}: {known.message or 'no map'}")
        config = load_config(None, ["final_ba.enabled=false"], start_s=half_s)
        result = run(flight(seed, cameras, images), config, known_map=known.slam_map)
        log = result.localization
        if log is None or not log.located.any():
            shares.append(0.0)
            continue
        similarity = map_alignment(known.input.truth, known.slam_map)
        metres, degrees = errors_in_map(known.input.truth, log.trajectory(), similarity)
        shares.append(
            float(np.sum((metres < WITHIN_M) & (degrees < WITHIN_DEG))) / result.logs.frames
        )
        errors.append(metres)
        first.append(float(log.stamps_ns[log.located][0] - result.input.start_ns) * 1e-9)
    bar = SHARE_BAR if judged else None
    outcome.metrics += [
        Metric("least_share", min(shares), "", "higher", bar, QUANTISED_TOLERANCE),
        info("mean_share", float(np.mean(shares)), ""),
    ]
    if errors:
        pooled = np.concatenate(errors)
        outcome.metrics += [
            Metric("rmse_m", float(np.sqrt(np.mean(pooled**2))), "m", "lower"),
            info("p95_m", float(np.percentile(pooled, 95)), "m"),
            info("first_fix_s", float(np.mean(first)), "s"),
        ]
    return outcome


def real(folder: Path) -> Outcome:
    """The second half of a real flight in the map of the first; it comes back in part only."""
    outcome, path = Outcome(), folder / MH01
    spacing = [f"loop_closure.keyframes.{key}=0.1" for key in ("distance_m", "angle_rad")]
    settings = ["map.enabled=true", *spacing]
    known = run(open_dataset(str(path)), load_config(None, settings, duration_s=MH01_HALF_S))
    if known.slam_map is None or known.input.truth is None:
        return Outcome(failure=known.message or "no map")
    config = load_config(None, ["final_ba.enabled=false"], start_s=MH01_HALF_S)
    result = run(open_dataset(str(path)), config, known_map=known.slam_map)
    log = result.localization
    if log is None or not log.located.any():
        return Outcome(failure="never located")
    similarity = map_alignment(known.input.truth, known.slam_map)
    metres, degrees = errors_in_map(known.input.truth, log.trajectory(), similarity)
    outcome.metrics += [
        Metric("rmse_m", float(np.sqrt(np.mean(metres**2))), "m", "lower", WITHIN_M),
        Metric("rmse_deg", float(np.sqrt(np.mean(degrees**2))), "deg", "lower", WITHIN_DEG),
        info("located_share", float(log.located.sum()) / result.logs.frames, ""),
    ]
    return outcome


def merged(folder: Path) -> Outcome:
    """Maps of both halves of a flight made one, and maps of two worlds, which must be refused."""
    outcome, config = Outcome(), load_config()
    before, after, halves = [], [], []
    for seed in range(SEEDS):
        first = mapped(flight(seed, 2, False), HALF_S)
        second = mapped(flight(seed, 2, False), HALF_S, HALF_S)
        if first.slam_map is None or second.slam_map is None or first.input.truth is None:
            return Outcome(failure=f"seed {seed}: no map")
        halves.append(first.slam_map)
        both = merge_maps(first.slam_map, second.slam_map, config.loop_closure, config.localization)
        before += [keyframe_errors(x, first) for x in (first.slam_map, second.slam_map)]
        after.append(keyframe_errors(both.content, first))
    refused = 0
    for one, other in pairwise(halves):
        try:
            merge_maps(one, other, config.loop_closure, config.localization)
        except EstimationError:
            refused += 1
    outcome.metrics += [
        Metric("rmse_m", rms(after), "m", "lower", MERGED_BAR_M),
        info("apart_rmse_m", rms(before), "m"),
        Metric("strangers_refused", refused / (len(halves) - 1), "", "higher", 1.0, EXACT),
    ]
    return outcome


def keyframe_errors(content: SlamMap, result: RunResult) -> np.ndarray:
    """(K,) errors of the keyframes of a map, all recordings aligned as one."""
    assert result.input.truth is not None
    similarity = map_alignment(result.input.truth, content)
    return np.concatenate(
        [errors_in_map(result.input.truth, t, similarity)[0] for t in content.trajectories()]
    )


def rms(errors: list[np.ndarray]) -> float:
    """Root mean square of all of them."""
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


BENCHMARKS = {
    "map_stereo": Benchmark(
        "Second halves of flights in maps of the first, stereo tracks",
        (),
        partial(located, range(SEEDS), 2, False, True),
    ),
    "map_mono": Benchmark(
        "Second halves of flights in maps of the first, one camera",
        (),
        partial(located, range(SEEDS), 1, False, False),
    ),
    "map_images": Benchmark(
        "The second half of a rendered flight in the map of the first, stereo",
        (),
        partial(located, range(IMAGES_SEED, IMAGES_SEED + 1), 2, True, True),
    ),
    "map_mh01": Benchmark("The second half of MH_01 in the map of the first", (MH01,), real),
    "map_merge": Benchmark("Maps of both halves of flights made one", (), merged),
}
