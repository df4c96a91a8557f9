# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rendered flights with a textured object that moves through a third of the view."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from benchmarks.metric import Metric
from benchmarks.running import Run
from benchmarks.suite import Benchmark, Outcome
from slam_graph.simulation.simulation_config import SimulationConfig
from slam_graph.simulation.simulator import simulate

DURATION_S = 10.0

FLIGHTS: dict[str, dict[str, Any]] = {
    "in_motion": {"seed": 1, "flight": {"hover_s": 0.0}},
    "at_rest": {"seed": 3, "flight": {"hover_s": 1.5}},
}
"""One that begins in motion, and one that begins at rest while the object moves already."""

OBJECTS: dict[str, dict[str, float]] = {
    "always": {},
    "later": {"since_s": 4.0},
    "fast": {"speed": 1.0, "sway_m": 0.5},
}
"""There from the first frame on, or later; by default its speed to the side is up to 0.5 m/s."""

ALGORITHMS = ("msckf", "swf", "okvis")
JUDGED = ("msckf", "swf")
"""Without `--objects` the others are only shown."""
WITH_OBJECTS = "objects"
"""Variants with two cameras in which moving objects are estimated (`--objects`)."""
GROWTH_BAR, GROWTH_BAR_WITH_OBJECTS = 2.0, 1.1
DELAY_BAR_S = 0.5


def measure(data: Path) -> Outcome:
    """How much the ATE grows beside the same flight without the object, and the start is delayed.

    Nothing is read from `data`.
    """
    outcome = Outcome()
    for flight, settings in FLIGHTS.items():
        clean = _runs(settings, None)
        for name, moving_object in OBJECTS.items():
            for variant, run in _runs(settings, moving_object).items():
                estimated = variant.startswith(WITH_OBJECTS)
                without = clean[variant.replace(WITH_OBJECTS, "stereo")]
                bar = GROWTH_BAR_WITH_OBJECTS if estimated else GROWTH_BAR
                ate, ate_without = (r.errors("se3").position_m for r in (run, without))
                delay_s = run.seconds_to_start - without.seconds_to_start
                figures = [
                    Metric("growth", ate / ate_without, "× ATE", "lower", bar),
                    Metric("ate", ate, "m", "lower"),
                    Metric("delay", delay_s, "s", "lower", DELAY_BAR_S, None),
                ]
                judged = estimated or variant.endswith(JUDGED)
                outcome.add(f"{flight}.{name}.{variant}", figures, judged)
                outcome.notes += run.notes()
        for variant, run in clean.items():
            figure = Metric("ate", run.errors("se3").position_m, "m", "lower")
            outcome.add(f"{flight}.without.{variant}", [figure])
    return outcome


def _runs(settings: dict[str, Any], moving_object: dict[str, float] | None) -> dict[str, Run]:
    """Runs of all algorithms, by the names of variants, on images that are rendered once."""
    config = SimulationConfig.model_validate(
        {
            "kind": "images",
            "duration_s": DURATION_S,
            "moving_object": moving_object,
            **settings,
        }
    )
    with tempfile.TemporaryDirectory() as folder:
        images = Path(folder) / "images"
        simulate(config).save(images)
        variants: list[tuple[str, int, list[str]]] = [("mono", 1, []), ("stereo", 2, [])]
        if moving_object is not None:
            variants.append((WITH_OBJECTS, 2, ["objects.enabled=true"]))
        return {
            f"{word}.{algorithm}": Run(images, algorithm, cameras, overrides=overrides)
            for word, cameras, overrides in variants
            for algorithm in ALGORITHMS
        }


BENCHMARKS = {
    "moving_object": Benchmark(
        "Rendered flights, an object moving through a third of the view: growth of ATE, start",
        (),
        measure,
    )
}
