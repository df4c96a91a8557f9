# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Front ends compared on one recording: track quality, and accuracy of an algorithm on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from slam_graph.config import RunConfig
from slam_graph.datasets import Sequence
from slam_graph.errors import DataError
from slam_graph.experiment.track_quality import TrackQuality, TrackSummary
from slam_graph.frontend import build_frontend
from slam_graph.pipeline import Tracking, run
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, Packet


@dataclass(frozen=True)
class FrontendReport:
    """Results of a front end on a recording.

    Attributes:
        name: of the front end.
        tracks: the quality of its tracks.
        inliers: share of the associated features that pass outlier rejection.
        counts: mean counts per frame.
        ms: mean milliseconds per frame of each stage; `total` is the whole front end.
        ate_m: ATE of an algorithm on these tracks after SE(3) alignment; None without an algorithm
            or ground truth.
        status: status of the run of the algorithm; empty without one.
    """

    name: str
    tracks: TrackSummary
    inliers: float
    counts: dict[str, float]
    ms: dict[str, float]
    ate_m: float | None = None
    status: str = ""

    def table(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        return asdict(self)

    @staticmethod
    def of_tracks(
        sequence: Sequence,
        config: RunConfig,
        name: str,
        watch: Callable[[Packet, FeatureFrame], None] = lambda packet, features: None,
    ) -> FrontendReport:
        """Run the front end alone, and report.

        Args:
            sequence: of images.
            config: `frontend`, `seed`, `start_s` and `duration_s` matter.
            name: for the report.
            watch: called with every packet and what was found in its frame.

        Raises:
            DataError: if the recording holds no images.
        """
        info = sequence.info()
        if info.content != "images" or info.frames == 0:
            raise DataError(f"{info.name}: holds no images; there is nothing to track")
        quality = TrackQuality(sequence.rig, sequence.groundtruth())
        frontend = build_frontend(
            sequence.rig,
            config.frontend,
            config.seed,
            sequence.diagnostics,
            gravity=config.backend.noise.gravity,
        )
        start_ns = info.start_ns + round(config.start_s * 1e9)
        end_ns = None if config.duration_s is None else start_ns + round(config.duration_s * 1e9)
        packets = sequence.packets(start_ns if config.start_s > 0 else None, end_ns)
        logs = RunResult.Logs()
        with Tracking(packets, frontend).in_turn() as tracking:
            for tracked in tracking:
                packet, features = tracked.packet, tracked.features
                quality.write(packet.imu, features)
                logs.count_frame(features.stamp_ns, tracked.clock.milliseconds, tracked.frame_stats)
                watch(packet, features)
        return _report(name, quality, logs.features, logs.frontend_milliseconds(), logs.frames)

    @staticmethod
    def of_run(sequence: Sequence, config: RunConfig, name: str) -> FrontendReport:
        """Run the whole pipeline, with feedback of the back end to the front end, and report.

        Args:
            sequence: of images.
            config: all settings.
            name: for the report.
        """
        quality = TrackQuality(sequence.rig, sequence.groundtruth())
        result = run(sequence, config, recorder=quality)
        accuracy = result.metrics.get("accuracy") or {}
        ate_m = accuracy.get("se3", {}).get("ate", {}).get("translation_m", {}).get("rmse")
        logs = result.logs
        took_ms = logs.frontend_milliseconds()
        return _report(name, quality, logs.features, took_ms, logs.frames, ate_m, result.status)


def _report(
    name: str,
    quality: TrackQuality,
    counts: Mapping[str, int],
    milliseconds: dict[str, float],
    frames: int,
    ate_m: float | None = None,
    status: str = "",
) -> FrontendReport:
    good = counts["tracked"] - counts["recovered"]
    bad = counts["rejected_ransac"] + counts["rejected_map"]
    return FrontendReport(
        name,
        quality.summary(),
        good / (good + bad) if good + bad else math.nan,
        {key: value / max(frames, 1) for key, value in sorted(counts.items()) if value},
        milliseconds,
        ate_m,
        status,
    )
