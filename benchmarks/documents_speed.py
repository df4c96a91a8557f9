# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of the page on performance: what a frame costs, its parts, the longest functions."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from benchmarks.documents import Figures, line
from benchmarks.speed import PROFILED
from benchmarks.speed_worker import LONGEST
from benchmarks.suite import CORE, RECURSIVE


def performance(figures: Figures) -> Iterator[str]:
    """Cost of a frame of every algorithm of the engine."""
    yield "| | two cameras [flows] | one camera [flows] | peak memory [MB] |"
    yield "|---|---:|---:|---:|"
    for name in RECURSIVE:
        stereo, mono = (f"speed_mh01_{kind}.{name}" for kind in ("stereo", "mono"))
        yield line(
            f"`{name}`",
            figures(f"{stereo}.cost_mean", 1),
            figures(f"{mono}.cost_mean", 1),
            figures(f"{stereo}.peak_memory", 0),
        )


def performance_parts(figures: Figures) -> Iterator[str]:
    """What a frame with two cameras is spent on."""
    yield "| [flows] | " + " | ".join(f"`{name}`" for name in CORE) + " | `msckf`, before |"
    yield "|---|" + "---:|" * (len(CORE) + 1)
    for part, label in PARTS.items():
        keys = [f"speed_mh01_stereo.{name}.part_{part}" for name in CORE]
        yield line(label, *(figures(key, 2) for key in keys), f"{BEFORE[part]:.2f}")


PARTS = {
    "decoding": "decoding of images",
    "frontend_temporal": "front end: tracking in time",
    "frontend_ransac": "RANSAC",
    "frontend_detect": "detection",
    "frontend_stereo": "matching between cameras",
    "frontend_other": "rest of the front end",
    "backend_propagation": "back end: propagation",
    "backend_cost": "cost construction",
    "backend_gauss_newton": "Gauss-Newton steps",
    "backend_marginalization": "marginalization",
    "backend_other": "rest of the back end, start-up",
    "other": "notes of the run",
}

BEFORE = {
    "decoding": 3.11,
    "frontend_temporal": 0.82,
    "frontend_ransac": 0.31,
    "frontend_detect": 0.91,
    "frontend_stereo": 0.85,
    "frontend_other": 0.21,
    "backend_propagation": 0.31,
    "backend_cost": 1.40,
    "backend_gauss_newton": 0.82,
    "backend_marginalization": 0.51,
    "backend_other": 0.78,
    "other": 0.12,
}
"""The parts of `msckf` before it was made fast, as `speed_mh01_stereo` measured them (commit
bcf5682f)."""


def performance_profile(figures: Figures) -> Iterator[str]:
    """The functions with the most time of their own."""
    yield "| | calls a frame | share of the time [%] |"
    yield "|---|---:|---:|"
    for place in range(1, LONGEST + 1):
        key = f"speed_mh01_stereo.{PROFILED}.profile_{place}"
        name = figures.text(f"{key}.name")
        yield line(f"`{name}`", figures(f"{key}.calls", 1), figures(f"{key}.share", 1))


TABLES: dict[str, Callable[[Figures], Iterator[str]]] = {
    "performance": performance,
    "performance_parts": performance_parts,
    "performance_profile": performance_profile,
}
"""By the name in the marker of a document."""
