# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How packets come to carry position fixes, known poses and odometry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from slam_graph.sensors import AidingData, Packet, Rig


def with_aiding(packets: Iterator[Packet], data: AidingData, rig: Rig) -> Iterator[Packet]:
    """Packets that carry what was measured up to the states of their frames.

    Unchanged if there is nothing. Odometry is interpolated, so it goes on to the first sample at or
    after the state. The state is no later than the last row of the frame or the last sample of the
    IMU, however the time offset is estimated.

    Args:
        packets: in the order of time.
        data: on the clock of the states.
        rig: tells how much later than the stamp of its frame a state is.
    """
    if not len(data):
        yield from packets
        return
    pose_ns, end_ns = (round(1e9 * s) for s in (rig.pose_offset_s, rig.end_offset_s))
    fixes_ns = odometry_ns = latest_ns = None
    for packet in packets:
        stamp_ns = packet.frame.stamp_ns + pose_ns
        reached = [packet.frame.stamp_ns + end_ns, *packet.imu.stamps_ns[-1:].tolist()]
        latest_ns = max(reached if latest_ns is None else [latest_ns, *reached])
        beyond = int(np.searchsorted(data.odometry_stamps_ns, latest_ns))
        until_ns = latest_ns
        if beyond < len(data.odometry_stamps_ns):
            until_ns = int(data.odometry_stamps_ns[beyond])
        fixes, odometry = data.within(fixes_ns, stamp_ns), data.within(odometry_ns, until_ns)
        part = fixes.with_odometry(
            odometry.odometry_stamps_ns, odometry.odometry_positions, odometry.odometry_quaternions
        )
        fixes_ns, odometry_ns = stamp_ns, until_ns
        yield replace(packet, aiding=part)
