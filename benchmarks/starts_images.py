# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Starts in rendered images: the front end begins at the same frame as the estimator.

The images are rendered along flights with their real IMU; what is judged is that of `starts`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from benchmarks.flights import KIND, flight_is_held_out, in_parallel
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from benchmarks.starts import (
    SPACING_S,
    Start,
    add_together,
    figures_of,
    packets_from,
    rows_of_starts,
    start,
)
from benchmarks.suite import Benchmark, Outcome
from slam_graph.config import RunConfig, load_config
from slam_graph.frontend import build_frontend
from slam_graph.sensors import CameraFrame, Packet, Rig
from slam_graph.simulation import simulate

FLIGHTS = ("euroc_inertial/V1_02_medium", "euroc_inertial/V2_02_medium")
RATE_HZ = 20.0


def measure(data: Path) -> Outcome:
    """Starts from every second second of the flights, with one camera and two."""
    outcome = Outcome()
    paths = [data / flight for flight in FLIGHTS]
    together: dict[tuple[int, bool], list[Start]] = {}
    for path, found in zip(paths, in_parallel(starts_of, [(path,) for path in paths]), strict=True):
        held_out = flight_is_held_out(path)
        for cameras, starts in found.items():
            name = f"{path.name}.{KIND[cameras]}"
            outcome.add(name, figures_of(starts, cameras), judged=False, held_out=held_out)
            together.setdefault((cameras, held_out), []).extend(starts)
    add_together(outcome, together)
    return outcome


def starts_of(path: Path) -> dict[int, list[Start]]:
    """Every start of one flight, by number of cameras; images are rendered once."""
    sequence = simulate(
        trajectory=str(path),
        real_imu=True,
        kind="images",
        cameras=2,
        rate_hz=RATE_HZ,
        seed=FIRST_HELD_OUT_SEED,
    )
    packets, truth = list(sequence.packets()), sequence.groundtruth()
    config = load_config(algorithm="msckf")
    found = {}
    for cameras in (1, 2):
        rig = replace(sequence.rig, cameras=sequence.rig.cameras[:cameras])
        found[cameras] = [
            start(rig, config, _tracked(packets_from(packets, row), rig, config), truth)
            for row in rows_of_starts(packets, cameras, SPACING_S)
        ]
    return found


def _tracked(packets: Iterator[Packet], rig: Rig, config: RunConfig) -> Iterator[Packet]:
    """The packets with the features that a front end which begins here finds."""
    frontend = build_frontend(rig, config.frontend)
    for packet in packets:
        assert isinstance(packet.frame, CameraFrame)
        frame = replace(packet.frame, images=packet.frame.images[: len(rig.cameras)])
        yield replace(packet, frame=frontend.track(frame, packet.imu))


BENCHMARKS = {
    "starts_images": Benchmark(
        "starts in rendered images along two flights with a real IMU: latency, errors, failures",
        FLIGHTS,
        measure,
    )
}
