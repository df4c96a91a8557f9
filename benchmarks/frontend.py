# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The front end alone on real stereo images: how good its tracks are, and what they cost."""

from __future__ import annotations

from pathlib import Path
from time import thread_time

import cv2
import numpy as np

from benchmarks.metric import TIMING_TOLERANCE, Metric, info
from benchmarks.speed_worker import Watch, time_flow
from benchmarks.suite import Benchmark, Outcome
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.evaluation.track_quality import TrackQuality
from slam_graph.frontend.build_frontend import build_frontend
from slam_graph.sensors.measurements import CameraFrame

RECORDING = "euroc/MH_01_easy_17s"

LENGTH_BAR_FRAMES = 15.0
EPIPOLAR_BAR_PX = 0.6
COST_BAR = 4.0


def measure(data: Path) -> Outcome:
    """Quality of the tracks of the default front end, and its time beside a Lucas-Kanade flow.

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
    tracks, unit_ms = quality.summary(), float(np.median(flows.cpu))
    cost = float(np.mean(costs)) / unit_ms
    assert tracks.epipolar_px is not None
    assert tracks.wrong is not None
    assert tracks.stereo_px is not None
    return Outcome(
        [
            Metric("length_median", tracks.median_length, "frames", "higher", LENGTH_BAR_FRAMES),
            Metric("length_mean", tracks.mean_length, "frames", "higher"),
            Metric("epipolar", tracks.epipolar_px, "px", "lower", EPIPOLAR_BAR_PX),
            Metric("epipolar_stereo", tracks.stereo_px, "px", "lower"),
            Metric("wrong", tracks.wrong, "of features", "lower"),
            Metric("coverage", tracks.coverage, "of cells", "higher"),
            Metric("cost_mean", cost, "× LK", "lower", COST_BAR, TIMING_TOLERANCE),
            info("features", tracks.features, "a frame"),
            info("reference", unit_ms, "ms = 1 LK"),
        ]
    )


BENCHMARKS = {
    "frontend_mh01_stereo": Benchmark(
        "The front end alone on MH_01 stereo: length and error of tracks, cost in flows",
        (RECORDING,),
        measure,
    )
}
