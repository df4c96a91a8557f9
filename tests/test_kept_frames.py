# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the verdict looks at leaves out features that the gate rejects, unless these are most."""

import numpy as np
import pytest

from slam_graph import simulate
from slam_graph.arrays import IntArray
from slam_graph.pipeline.kept_frames import KeptFrames
from slam_graph.pipeline.stage import EstimatedFrame, NoObjects
from slam_graph.sensors import FeatureFrame


@pytest.mark.parametrize(("part", "left_out"), [(0.3, True), (0.7, False)])
def test_rejected_features_are_left_out_where_they_are_few(part: float, left_out: bool) -> None:
    flight = simulate(duration_s=3.0, seed=1, rate_hz=20.0)
    kept, none = KeptFrames(True, NoObjects()), np.zeros(0, np.int64)
    assert kept.frames == []
    rejected: set[int] = set()
    for k, packet in enumerate(flight.packets()):
        features = packet.frame
        assert isinstance(features, FeatureFrame)
        # between frames that are kept as well
        ids: IntArray = features.cameras[0].ids
        now = ids[ids % 10 < 10 * part] if k % 3 == 1 else none
        rejected |= set(now.tolist())
        state = None, none, np.zeros((0, 3)), now, (1.0, 1.0), True
        kept.add(EstimatedFrame(packet, features, *state))
    seen = {int(i) for frame in kept.frames for i in frame.cameras[0].ids}
    assert len(kept.frames) == len(kept) > 10
    assert len(rejected) > 20
    assert bool(seen & rejected) != left_out
    assert len(kept.imu) > 200
