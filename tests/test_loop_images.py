# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure on rendered images: a place that is seen again is recognised by its appearance."""

from typing import cast

import gtsam
import numpy as np
from scipy.spatial.distance import cdist

from slam_graph.frontend.frontend_protocol import build_frontend
from slam_graph.loop_closure.loop_config import KeyframeConfig, VerificationConfig
from slam_graph.loop_closure.loop_keyframes import Keyframe, KeyframeLog
from slam_graph.loop_closure.loop_verification import LoopVerifier
from slam_graph.sensors.measurements import ImuData
from slam_graph.simulation.simulated_sequence import SimulatedImages
from slam_graph.simulation.simulation_config import FlightConfig, ImageConfig, SimulationConfig
from slam_graph.simulation.simulator import simulate

FRAMES = 5
"""How many images lead up to a keyframe."""


def seen_at(sequence: SimulatedImages, row: int) -> Keyframe:
    """The keyframe at a frame, tracked over the frames before it by a front end that knows none."""
    frontend, truth = build_frontend(sequence.rig), sequence.groundtruth()
    log = KeyframeLog(sequence.rig, KeyframeConfig(distance_m=1e-6))
    for index in range(row - FRAMES + 1, row + 1):
        stamp_ns = int(truth.stamps_ns[index])
        frame = sequence.renderer.frame(sequence.flight.motion, stamp_ns)
        features = frontend.track(frame, ImuData.empty())
        log.add(features, truth.pose(index), frame.images[0])
    return log.keyframes[-1]


def test_a_place_seen_again_in_images_closes_a_loop() -> None:
    config = SimulationConfig(
        kind="images",
        trajectory="rooms",
        duration_s=60.0,
        rate_hz=5.0,
        seed=2,
        flight=FlightConfig(hover_s=0.0),
        images=ImageConfig(texel_m=0.012),
    )
    sequence = cast(SimulatedImages, simulate(config))
    truth = sequence.groundtruth()
    views = np.column_stack([truth.positions, truth.quaternions])
    apart = cdist(views, views)
    old = np.tril(np.ones_like(apart, bool), -100)
    old[:, :FRAMES] = False
    second, first = np.unravel_index(np.argmin(np.where(old, apart, np.inf)), apart.shape)
    keyframes = [seen_at(sequence, int(row)) for row in (first, second)]
    elsewhere = seen_at(sequence, int(first) + 30)

    verifier = LoopVerifier(sequence.rig.cameras[0], VerificationConfig())
    loop = verifier.verify(keyframes, 0, 1)
    assert loop is not None
    true = truth.pose(int(first)).between(truth.pose(int(second)))
    error = gtsam.Pose3.localCoordinates(true, loop.first_T_second)
    assert np.linalg.norm(error[:3]) < 0.0087
    assert np.linalg.norm(error[3:]) < 0.036
    assert verifier.verify([keyframes[0], elsewhere], 0, 1) is None
