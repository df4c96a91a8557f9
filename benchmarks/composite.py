# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A rendered object that moves before the real images of EuRoC MH_01, with its real IMU.

No real recording of rigid objects with true poses was to be had; this is the nearest thing. The
object is drawn where it is seen from the poses of the ground truth, smoothed by the IMU, in front
of all that the images show. Its light, its sharp borders and its texture are those of a rendering.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.metric import Metric, info
from benchmarks.suite import Benchmark, Outcome
from slam_graph import run
from slam_graph.datasets import open_dataset
from slam_graph.datasets.formats.euroc_writer import EurocWriter
from slam_graph.datasets.streams.object_truth import object_truth_file
from slam_graph.results import RunResult
from slam_graph.sensors import CameraFrame
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedImages
from slam_graph.simulation.world import World

Image = NDArray[np.uint8]

RECORDING = "euroc/MH_01_easy_17s"
SEEDS = range(210, 213)
RATE_HZ = 20.0
OBJECT = {"count": 1, "size_m": 0.8, "distance_m": 2.0, "sway_m": 0.3}
LABELS = "labels"
"""Folder of the masks: beside the recording, so that it is not found unless it is named."""
MOTIONS = ("turning", "stop_and_go")
_BARS = (0.75, 0.015, 0.45, 0.0075)
_MASKS_BARS = (0.5, 0.010, 0.3, 0.005)
"""Largest errors of the motion from frame to frame: deg and m on the way, deg and m smoothed."""
_GROWTH_BAR = 1.1


def measure(data: Path) -> Outcome:
    """Errors of the object with and without masks, and of the platform beside the real clip."""
    outcome = Outcome()
    clean = _ate(run(data / RECORDING, final_ba={"enabled": False}))
    for motion in MOTIONS:
        rows: dict[str, list[dict[str, float]]] = {"tracks": [], "masks": []}
        for seed in SEEDS:
            with tempfile.TemporaryDirectory() as folder:
                drawn = composited(data / RECORDING, Path(folder) / "clip", motion, seed)
                alone = _ate(run(drawn, final_ba={"enabled": False}))
                for name, row in rows.items():
                    found = _errors(drawn, masks=name == "masks")
                    row.append({**found, "alone": alone / clean})
        for name, table in rows.items():
            outcome.add(f"{motion}.{name}", _figures(table, clean, name == "masks"))
    return outcome


def _figures(rows: list[dict[str, float]], clean: float, masks: bool) -> list[Metric]:
    bars = _MASKS_BARS if masks else _BARS

    def mean(name: str) -> float:
        return float(np.mean([row[name] for row in rows]))

    return [
        Metric("rotation", mean("motion_rotation_deg"), "deg", "lower", bars[0]),
        Metric("translation", mean("motion_translation_m"), "m", "lower", bars[1]),
        Metric("smoothed_rotation", mean("smoothed_rotation"), "deg", "lower", bars[2]),
        Metric("smoothed_translation", mean("smoothed_translation"), "m", "lower", bars[3]),
        Metric("growth", mean("ate") / clean, "× ATE", "lower", _GROWTH_BAR),
        info("growth_without_objects", mean("alone"), "× ATE"),
        info("nees", mean("nees"), ""),
        info("steps", mean("steps"), ""),
        info("milliseconds", mean("ms"), "ms"),
    ]


def _errors(clip: Path, masks: bool) -> dict[str, float]:
    labels = clip.with_name(LABELS)
    sequence = open_dataset(clip, "euroc", sources={"masks": str(labels)} if masks else None)
    result = run(sequence, overrides={"objects.enabled": True})
    found = result.metrics["moving_objects"]
    smoothed = found["smoothed"] or {}
    return {
        **found["accuracy"],
        "smoothed_rotation": smoothed.get("motion_rotation_deg", np.nan),
        "smoothed_translation": smoothed.get("motion_translation_m", np.nan),
        "ate": _ate(result),
        "ms": found["ms_per_frame"],
    }


def _ate(result: RunResult) -> float:
    table: Any = result.metrics["accuracy"]["yaw"]["ate"]["translation_m"]
    return float(table["rmse"])


def composited(clip: Path, folder: Path, motion: str, seed: int) -> Path:
    """The recording with a rendered object in its images, its masks and its true poses.

    Args:
        clip: EuRoC folder.
        folder: the new one.
        motion: of the object.
        seed: of its texture and its way.
    """
    real = open_dataset(clip, "euroc")
    drawn = simulate(
        trajectory=str(clip),
        real_imu=True,
        kind="images",
        rate_hz=RATE_HZ,
        seed=seed,
        objects={**OBJECT, "motion": motion},
    )
    assert isinstance(drawn, SimulatedImages)
    # the walls are not needed; one stands for what no ray meets
    drawn.flight = replace(drawn.flight, world=World(drawn.flight.world.panels[:1]))
    renderer, flown = drawn.renderer, drawn.flight.motion
    packets = [p for p in real.packets() if flown.start_ns <= p.frame.stamp_ns <= flown.end_ns]
    stamps = np.array([packet.frame.stamp_ns for packet in packets])
    notes = object_truth_file({body.number: body.trajectory(stamps) for body in drawn.bodies})
    truth = drawn.groundtruth()
    with EurocWriter(folder, real.rig, truth, "composited", RATE_HZ, notes=notes) as writer:
        for packet in packets:
            frame = packet.frame
            assert isinstance(frame, CameraFrame)
            rendered = renderer.frame(flown, frame.stamp_ns)
            labels = [
                renderer.labels(flown, frame.stamp_ns, camera)
                for camera in range(len(frame.images))
            ]
            images = tuple(
                _drawn_over(old, new, label)
                for label, new, old in zip(labels, rendered.images, frame.images, strict=True)
            )
            writer.write_imu(packet.imu)
            writer.write_frame(replace(frame, images=images))
            writer.write_mask(frame.stamp_ns, labels[0])
    (folder / "masks").rename(folder.with_name(LABELS))
    return folder


def _drawn_over(old: Image | None, new: Image | None, labels: NDArray[np.uint16]) -> Image | None:
    """An image with the object; None for the one of the clip that is damaged."""
    return None if old is None or new is None else np.where(labels > 0, new, old)


BENCHMARKS = {
    "composite": Benchmark(
        "A rendered object before the real images of MH_01, 3 seeds", (RECORDING,), measure
    )
}
