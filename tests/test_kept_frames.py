# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the verdict looks at: without rejected features, and those alone that were used."""

from dataclasses import replace

import numpy as np
import pytest

from slam_graph import simulate
from slam_graph.arrays import IntArray
from slam_graph.pipeline.kept_frames import KeptFrames
from slam_graph.pipeline.stage import EstimatedFrame, NoObjects
from slam_graph.sensors import FeatureFrame


@pytest.mark.parametrize(("part", "left_out"), [(0.3, True), (0.7, False)])
def test_rejected_features_are_left_out_where_they_are_few(part: float, left_out: bool) -> None:
    kept, rejected = _kept("rejected", part)
    seen = _ids(kept.frames)
    assert len(kept.frames) == len(kept) > 10
    assert len(rejected) > 20
    assert bool(seen & rejected) != left_out
    assert len(kept.imu) > 200


@pytest.mark.parametrize(("part", "enough"), [(0.6, True), (0.2, False)])
def test_features_that_were_used_stand_alone_where_they_are_enough(
    part: float, enough: bool
) -> None:
    kept, used = _kept("landmark_ids", part)
    assert len(used) > 20
    assert _ids(kept.frames) - used
    assert _ids(kept.used_frames) == (_ids(kept.frames) & used if enough else set())


@pytest.mark.parametrize("field", ["rejected", "dynamic"])
def test_used_features_that_move_are_left_out(field: str) -> None:
    kept, moving = _kept(field, 0.3, "landmark_ids")
    assert moving
    assert _ids(kept.used_frames) == _ids(kept.frames) - moving != set()


def _kept(field: str, part: float, *everywhere: str) -> tuple[KeptFrames, set[int]]:
    """Frames of a flight with part of the ids in a field, in every third frame; and these ids.

    Args:
        field: of the frames.
        part: of the ids.
        everywhere: names of fields with all ids.
    """
    flight = simulate(duration_s=3.0, seed=1, rate_hz=20.0)
    kept, none, chosen = KeptFrames(True, NoObjects()), np.zeros(0, np.int64), set[int]()
    assert kept.frames == kept.used_frames == []
    for k, packet in enumerate(flight.packets()):
        features = packet.frame
        assert isinstance(features, FeatureFrame)
        ids: IntArray = features.cameras[0].ids
        now = ids[ids % 10 < 10 * part] if k % 3 == 1 else none
        chosen |= set(now.tolist())
        state = None, none, np.zeros((0, 3)), none, (1.0, 1.0), True
        values = {field: now, **dict.fromkeys(everywhere, ids)}
        kept.add(replace(EstimatedFrame(packet, features, *state), **values))
    return kept, chosen


def _ids(frames: list[FeatureFrame]) -> set[int]:
    return {int(i) for frame in frames for i in frame.cameras[0].ids}
