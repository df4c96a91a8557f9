# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Two cameras of which one is lost for good: the other one carries the run alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from estimating import from_given_state

from slam_graph.config import load_config
from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.faults.injection import inject
from slam_graph.pipeline.run_recording import run
from slam_graph.simulation import simulate

LOST = "camera_lost:at_s=3,duration_s=60,camera={}"


@pytest.fixture(scope="module")
def tracks() -> RecordedSequence:
    return simulate(
        trajectory="figure8",
        cameras=2,
        duration_s=7.0,
        rate_hz=10.0,
        seed=1,
        tracks={"features": 80},
    )


def frames_kept(sequence: RecordedSequence) -> float:
    """How many frames the keyframes of `okvis` reach back, on average over the last second."""
    reach = []
    for estimator in from_given_state(sequence, "okvis"):
        assert estimator.window is not None
        reach.append(estimator.window.frame - min(estimator.window.keyframes, default=0))
    return float(np.mean(reach[-10:]))


def test_keyframes_reach_as_far_back_whichever_camera_is_lost(tracks: RecordedSequence) -> None:
    """A frame of the second camera alone is a keyframe only where it sees something new."""
    first, second = (frames_kept(inject(tracks, [LOST.format(camera)])) for camera in (0, 1))
    assert first == pytest.approx(second, rel=0.3)


@pytest.mark.slow
@pytest.mark.data
def test_the_second_camera_goes_on_alone_on_real_images(data_dir: Path) -> None:
    """After six seconds nothing is left of what the first one saw."""
    folder = data_dir / "euroc" / "MH_01_easy_17s"
    overrides = ["final_ba.enabled=false"]
    config = load_config(algorithm="okvis", duration_s=9.0, overrides=overrides)
    result = run(open_dataset(folder, faults=[LOST.format(0)]), config)
    assert result.status == "ok", result.message
    result.check()
    assert result.metrics["accuracy"]["se3"]["ate"]["translation_m"]["rmse"] < 0.01
