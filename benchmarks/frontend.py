# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The front end alone on real stereo images: how good its tracks are, and what they cost."""

from __future__ import annotations

from pathlib import Path
from time import thread_time

import cv2
import numpy as np

from benchmarks.clocks import Watch, time_flow
from benchmarks.metric import QUANTISED_TOLERANCE, TIMING_TOLERANCE, Metric, info
from benchmarks.suite import Benchmark, Outcome
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.experiment.track_quality import TrackQuality, TrackSummary
from slam_graph.frontend.frontend_protocol import build_frontend
from slam_graph.sensors.measurements import CameraFrame

RECORDING = "euroc/MH_01_easy_17s"

LENGTH_BAR_FRAMES = 15.0
EPIPOLAR_BAR_PX = 0.6
COST_BAR = 4.0


def tracks(data: Path) -> Outcome:
    """Quality of the tracks of the default front end."""
    return followed(data)[0]


def cost(data: Path) -> Outcome:
    """Time of the default front end beside a Lucas-Kanade flow."""
    return followed(data)[1]


def followed(data: Path) -> tuple[Outcome, Outcome]:
    """The tracks of the recording, and what they cost.

    Both times are CPU times of this thread with OpenCV held to it, taken frame by frame in turn.
    """
    sequence = open_dataset(data / RECORDING, cameras=2)
    quality = TrackQuality(sequence.rig, sequence.groundtruth())
    frontend = build_frontend(sequence.rig)
    costs, flows = [], Watch()
    last = None
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for packet in sequence.packets():
            began_s = thread_time()
            features = frontend.track(packet.frame, packet.imu)
            costs.append(1e3 * (thread_time() - began_s))
            quality.write(packet.imu, features)
            assert isinstance(packet.frame, CameraFrame)
            image = packet.frame.images[0]
            if last is not None and image is not None:
                time_flow(last, image, flows)
            last = image
    finally:
        cv2.setNumThreads(threads)
    return Outcome(figures_of(quality.summary())), Outcome(times_of(costs, flows))


def figures_of(found: TrackSummary) -> list[Metric]:
    """How good tracks are that were judged by a ground truth."""
    assert found.epipolar_px is not None
    assert found.wrong is not None
    assert found.stereo_px is not None
    return [
        Metric("length_median", found.median_length, "frames", "higher", LENGTH_BAR_FRAMES),
        Metric("length_mean", found.mean_length, "frames", "higher"),
        Metric("epipolar", found.epipolar_px, "px", "lower", EPIPOLAR_BAR_PX),
        Metric("epipolar_stereo", found.stereo_px, "px", "lower"),
        Metric("wrong", found.wrong, "of features", "lower"),
        Metric("coverage", found.coverage, "of cells", "higher", tolerance=QUANTISED_TOLERANCE),
        info("features", found.features, "a frame"),
    ]


def times_of(costs_ms: list[float], flows: Watch) -> list[Metric]:
    """The mean time of a frame as a multiple of the median time of a flow."""
    unit_ms = float(np.median(flows.cpu))
    ratio = float(np.mean(costs_ms)) / unit_ms
    return [
        Metric("cost_mean", ratio, "× LK", "lower", COST_BAR, TIMING_TOLERANCE),
        info("reference", unit_ms, "ms = 1 LK"),
    ]


BENCHMARKS = {
    "frontend_mh01_stereo": Benchmark(
        "The front end alone on MH_01 stereo: length and error of tracks",
        (RECORDING,),
        tracks,
        quick=True,
    ),
    "frontend_cost": Benchmark(
        "The front end alone on MH_01 stereo: cost of a frame in flows",
        (RECORDING,),
        cost,
    ),
}
