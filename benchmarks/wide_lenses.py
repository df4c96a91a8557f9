# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Wide lenses: rendered flights with a fisheye, against the same flights with a pinhole.

One camera, images of 512 x 512 pixels: a pinhole of 90° and lenses of about 190°, at the same place
on the same flight through the same textures. The renderer draws what is less than 85° off the axis.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.metric import EXACT, Metric, info
from benchmarks.running import Run
from benchmarks.suite import Benchmark, Outcome
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.sensors import Camera
from slam_graph.simulation.simulator import euroc_rig, simulate

DURATION_S = 10.0
SEEDS = (1, 2, 3, 4)
ALGORITHM = "msckf"
RATIO_BAR = 1.2
"""Largest error relative to that of the pinhole; mean over the seeds."""

PINHOLE = Camera(256.0, 256.0, 255.5, 255.5, "none", (), 512, 512)
LENSES = {
    "equidistant": Camera(154.0, 154.0, 255.5, 255.5, "equidistant", (0.0,) * 4, 512, 512),
    "double_sphere": Camera(135.0, 135.0, 255.5, 255.5, "double_sphere", (-0.2, 0.58), 512, 512),
    "mei": Camera(420.0, 420.0, 255.5, 255.5, "mei", (1.6, 0.0, 0.0, 0.0, 0.0), 512, 512),
}
FLIGHTS: dict[str, dict[str, Any]] = {
    "at_rest": {"flight": {"hover_s": 1.0}},
    "in_motion": {"flight": {"hover_s": 0.0}},
}
"""Flights that begin at rest, and in motion. Some of the latter have too little acceleration for a
start with one camera; only flights that end well with both lenses count for the errors, and
`finished` is how many of those that end well with the pinhole do so with the wide lens."""


def measure(data: Path) -> Outcome:
    """Errors with each lens, relative to the pinhole's.

    Nothing is read from `data`.
    """
    outcome = Outcome()
    for flight, settings in FLIGHTS.items():
        pinhole = [_error(PINHOLE, seed, settings) for seed in SEEDS]
        for name, lens in LENSES.items():
            wide = [_error(lens, seed, settings) for seed in SEEDS]
            both = np.isfinite(pinhole) & np.isfinite(wide)
            ate, reference = (float(np.mean(np.array(e)[both])) for e in (wide, pinhole))
            ended = float(np.sum(np.isfinite(pinhole)))
            finished = float(np.sum(both))
            figures = [
                Metric("finished", finished, "flights", "higher", ended, EXACT),
                Metric("ratio", ate / reference, "× pinhole", "lower", RATIO_BAR),
                info("ate", ate, "m"),
                info("pinhole_ate", reference, "m"),
            ]
            outcome.add(f"{flight}.{name}", figures)
    return outcome


def _error(lens: Camera, seed: int, settings: dict[str, Any]) -> float:
    """ATE of the causal estimate in m; NaN if the run did not come to a good end."""
    rig = euroc_rig()
    rig = replace(rig, cameras=(replace(rig.cameras[0], camera=lens),))
    with tempfile.TemporaryDirectory() as folder:
        calibration, images = Path(folder) / "calibration.yaml", Path(folder) / "images"
        write_kalibr(rig, calibration)
        simulate(
            kind="images",
            calibration=calibration,
            duration_s=DURATION_S,
            seed=seed,
            **settings,
        ).save(images)
        run = Run(images, ALGORITHM, 1)
    return run.errors("yaw").position_m


BENCHMARKS = {
    "wide_lenses": Benchmark(
        "rendered flights with one camera: errors of lenses of 190° relative to a pinhole's",
        (),
        measure,
    )
}
