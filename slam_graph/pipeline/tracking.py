# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Tracking: reading and the front end, in a process beside the back end or in turn with it.

While the back end works on frame k, the front end tracks frame k + 1. So the back end's feedback on
frame k reaches the front end before frame k + 2, in either mode: results are the same.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace

import numpy as np

from slam_graph.datasets import Sequence
from slam_graph.diagnostics import Diagnostics
from slam_graph.frontend import Feedback, Frontend
from slam_graph.pipeline.forked_call import CallInTurn, ForkedCall
from slam_graph.pipeline.frame_watch import FrameWatch
from slam_graph.results import RunInput
from slam_graph.sensors import AidingData, CameraFrame, FeatureFrame, ImuData, Packet, Rig

_LEAD_MARGIN_NS = 10_000_000
"""Packets lead by so much more than the time offset wants: it is estimated on."""


class Stopwatch:
    """Times the stages of one frame.

    Attributes:
        milliseconds: of each stage, of its parts as `stage.part`, and of all as `total`.
    """

    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {"total": 0.0}
        self._since = time.perf_counter()

    def restart(self) -> None:
        """Do not count the time since the last stage ended."""
        self._since = time.perf_counter()

    def lap(self, stage: str, parts: Mapping[str, float] | None = None) -> None:
        """End a stage, which began when the stage before it ended.

        Args:
            stage: its name.
            parts: milliseconds of its parts, by name; they were timed elsewhere.
        """
        now = time.perf_counter()
        elapsed_ms = 1e3 * (now - self._since)
        self.milliseconds[stage] = elapsed_ms
        self.milliseconds["total"] += elapsed_ms
        self.milliseconds |= {f"{stage}.{part}": value for part, value in (parts or {}).items()}
        self._since = now


@dataclass(frozen=True, eq=False)
class TrackedPacket:
    """A packet and what the front end made of it.

    Attributes:
        packet: as it was read.
        features: found in its frame.
        frame_stats: counts and milliseconds of the front end.
        clock: has timed reading and front end; the back end's time is added to it.
    """

    packet: Packet
    features: FeatureFrame
    frame_stats: dict[str, float]
    clock: Stopwatch


class _LeadingPackets:
    """Packets whose IMU samples lead beyond the stamp of the frame, as soon as that is asked for.

    A time offset that was found on the way wants the IMU up to a later time. A frame then waits
    until the packets behind it have brought these samples.

    Attributes:
        lead_ns: how far beyond the stamp of its frame the samples of a packet lead.
    """

    def __init__(self, packets: Iterator[Packet]) -> None:
        self.lead_ns = 0
        self._packets = packets
        self._frames: deque[CameraFrame | FeatureFrame] = deque()
        self._imu: list[ImuData] = []
        self._aiding: list[AidingData] = []
        self._newest_ns = np.iinfo(np.int64).min

    def __iter__(self) -> _LeadingPackets:
        return self

    def __next__(self) -> Packet:
        if self.lead_ns == 0 and not self._frames:
            return next(self._packets)
        while not self._frames or (
            self._newest_ns < self._frames[0].stamp_ns + self.lead_ns
            and self._frames[-1].stamp_ns <= self._frames[0].stamp_ns + 2 * self.lead_ns
        ):
            packet = next(self._packets, None)
            if packet is None:
                break
            self._frames.append(packet.frame)
            self._imu.append(packet.imu)
            if packet.aiding is not None:
                self._aiding.append(packet.aiding)
            if len(packet.imu):
                self._newest_ns = int(packet.imu.stamps_ns[-1])
        if not self._frames:
            raise StopIteration
        imu, self._imu = ImuData.concatenate(self._imu), []
        aiding = AidingData.concatenate(self._aiding) if self._aiding else None
        self._aiding = []
        return Packet(imu, self._frames.popleft(), aiding)


class Tracking:
    """Tracks the packets of a sequence one after the other.

    Args:
        packets: to track; read where the front end works.
        frontend: tracks them.
    """

    def __init__(self, packets: Iterator[Packet], frontend: Frontend) -> None:
        self._packets = _LeadingPackets(packets)
        self._frontend = frontend
        self._feedback: Feedback | None = None

    def give_feedback(self, feedback: Feedback) -> None:
        """Pass on what the back end knows after the packet that was yielded last."""
        self._feedback = feedback

    @contextmanager
    def in_turn(self) -> Iterator[Iterator[TrackedPacket]]:
        """The tracked packets, each tracked when it is asked for."""
        yield self._tracked(CallInTurn(self._track))

    @contextmanager
    def beside(self, rig: Rig, diagnostics: Diagnostics) -> Iterator[Iterator[TrackedPacket]]:
        """The same packets, each tracked in a process of its own, one ahead of the caller.

        A fault in a packet is raised when its turn comes, not while it is read ahead.

        Args:
            rig: tells how large images are.
            diagnostics: that reader and front end warn by.
        """
        with closing(ForkedCall(self._track, _image_bytes(rig), diagnostics)) as process:
            yield self._tracked(process)

    def _tracked(
        self,
        frontend: CallInTurn[Feedback | None, TrackedPacket | None]
        | ForkedCall[Feedback | None, TrackedPacket | None],
    ) -> Generator[TrackedPacket, None, None]:
        frontend.begin(None)
        while (tracked := frontend.result()) is not None:
            feedback, self._feedback = self._feedback, None
            frontend.begin(feedback)
            tracked.clock.restart()
            yield tracked

    def _track(self, feedback: Feedback | None) -> TrackedPacket | None:
        """Read and track the next packet; None at the end."""
        clock = Stopwatch()
        if feedback is not None:
            self._frontend.receive_feedback(feedback)
            if feedback.rig is not None:
                first = feedback.rig.cameras[0]
                end_ns = round((first.time_offset_s + first.end_s) * 1e9)
                self._packets.lead_ns = max(0, end_ns + _LEAD_MARGIN_NS)
        packet = next(self._packets, None)
        if packet is None:
            return None
        clock.lap("read")
        features = self._frontend.track(packet.frame, packet.imu)
        stats = dict(self._frontend.frame_stats)
        clock.lap("frontend", _milliseconds(stats))
        return TrackedPacket(packet, features, stats, clock)


def _image_bytes(rig: Rig) -> int:
    """Bytes of the images of a frame: grey ones of all cameras, and depth as float32."""
    pixels = [mounted.camera.width * mounted.camera.height for mounted in rig.cameras]
    depth = 0 if rig.depth is None else 4 * pixels[rig.depth.camera]
    return sum(pixels) + depth


def _milliseconds(frame_stats: Mapping[str, float]) -> dict[str, float]:
    """The stages among what a front end counts: the keys that end in `_ms`, without that end."""
    return {
        key.removesuffix("_ms"): value for key, value in frame_stats.items() if key.endswith("_ms")
    }


def can_overlap() -> bool:
    """Whether a process beside this one can be started here, and has a core of its own.

    Not from a thread beside the main one: another run may hold a lock then, for ever in the copy.
    """
    if threading.current_thread() is not threading.main_thread():
        return False
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return ForkedCall.is_possible() and (cores or 1) > 1


def packets_of(sequence: Sequence, asked: RunInput) -> Iterator[Packet]:
    """The packets of the part that is asked for, with the cameras that are asked for.

    What is wrong between frames is counted on the way.
    """
    packets = sequence.packets(
        asked.start_ns if asked.config.start_s > 0 else None,
        asked.end_ns if asked.config.duration_s is not None else None,
    )
    count, watch = len(asked.rig.cameras), FrameWatch(asked.rig, sequence.diagnostics)
    for packet in packets:
        imu = packet.imu if asked.rig.has_imu else ImuData.empty()
        frame = _first_cameras(packet.frame, count)
        watch.look(frame)
        yield Packet(imu, frame, packet.aiding)


def _first_cameras(frame: CameraFrame | FeatureFrame, count: int) -> CameraFrame | FeatureFrame:
    """The same frame without the cameras that are not used."""
    if isinstance(frame, CameraFrame):
        if len(frame.images) <= count:
            return frame
        return replace(frame, images=frame.images[:count])
    if len(frame.cameras) <= count:
        return frame
    return replace(frame, cameras=frame.cameras[:count], outliers=(), moving=frame.moving[:count])
