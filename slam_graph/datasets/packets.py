# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Packets: each frame of a recording with the IMU samples that lead up to it."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing

import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.sensors import CameraFrame, FeatureFrame, ImuData, Packet

_Frames = Generator[CameraFrame | FeatureFrame, None, None]


class _ImuFeed:
    """Hands out a stream of IMU blocks in pieces that end at given times.

    Attributes:
        latest_ns: stamp of the last sample handed out, None before the first.
    """

    def __init__(self, blocks: Iterator[ImuData]) -> None:
        self.latest_ns: int | None = None
        self._blocks = blocks
        self._buffer = ImuData.empty()

    def up_to(self, stamp_ns: int) -> ImuData:
        """All samples not yet handed out, up to and including the first at or after `stamp_ns`."""
        if self.latest_ns is not None and self.latest_ns >= stamp_ns:
            return ImuData.empty()
        pending = [self._buffer]
        while not len(pending[-1]) or pending[-1].stamps_ns[-1] < stamp_ns:
            block = next(self._blocks, None)
            if block is None:
                break
            pending.append(block)
        data = ImuData.concatenate(pending) if len(pending) > 1 else self._buffer
        end = int(np.searchsorted(data.stamps_ns, stamp_ns, side="left")) + 1
        self._buffer = data[end:]
        if len(data):
            self.latest_ns = int(data.stamps_ns[min(end, len(data)) - 1])
        return data[:end]


def packetize(
    frames: _Frames,
    blocks: Iterator[ImuData],
    diagnostics: Diagnostics,
    history_ns: int | None = None,
    offset_ns: int = 0,
) -> Iterator[Packet]:
    """Join frames with the IMU samples that lead up to them.

    A frame without any IMU sample since the frame before it (or, for the first one, at or before
    its time) is delivered all the same and counted as `frame_without_imu`.

    Args:
        frames: with strictly increasing stamps; closed at the end.
        blocks: of the IMU stream, with strictly increasing stamps.
        diagnostics: where faults are counted.
        history_ns: how much of the IMU before the first frame its packet carries; None for all.
        offset_ns: time of a frame on the clock of the IMU since its stamp. Where it is negative,
            samples lead up to the stamp all the same.
    """
    feed = _ImuFeed(blocks)
    since = np.zeros(0, np.int64)  # times of the samples after the frame before
    with closing(frames):
        for number, frame in enumerate(frames):
            now_ns = frame.stamp_ns + offset_ns
            imu = feed.up_to(max(now_ns, frame.stamp_ns))
            if number == 0 and history_ns is not None:
                imu = imu[int(np.searchsorted(imu.stamps_ns, now_ns - history_ns)) :]
            since = np.concatenate([since, imu.stamps_ns])
            if not len(since) or since[0] > now_ns:
                diagnostics.warn(
                    "frame_without_imu", f"frame at {frame.stamp_ns} has no IMU samples"
                )
            since = since[np.searchsorted(since, now_ns, side="right") :]
            yield Packet(imu, frame)


def packetize_alone(frames: _Frames) -> Iterator[Packet]:
    """Packets of a recording without an IMU; `frames` is closed at the end."""
    with closing(frames):
        for frame in frames:
            yield Packet(ImuData.empty(), frame)
