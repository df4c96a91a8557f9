# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The unit in which costs are told, one Lucas-Kanade flow, and the clock that takes it.

Imports nothing of this package: programs that run other systems use it too, in environments of
their own.
"""

from __future__ import annotations

import os
import time
from array import array

import cv2
import numpy as np
from numpy.typing import NDArray

REFERENCE_POINTS = 200
REFERENCE_WINDOW = (21, 21)
REFERENCE_LEVELS = 3

Image = NDArray[np.uint8]


class Watch:
    """Times the same thing again and again.

    Attributes:
        wall: milliseconds of each time.
        cpu: milliseconds that this thread was computing in it; others cannot lengthen these.
    """

    def __init__(self) -> None:
        self.wall = array("d")  # 8 bytes a time: a long run has many
        self.cpu = array("d")
        self.start()

    def start(self) -> None:
        """Begin."""
        self._since = time.perf_counter(), time.thread_time()

    def stop(self) -> None:
        """Note the time since the beginning."""
        wall_s, cpu_s = time.perf_counter() - self._since[0], time.thread_time() - self._since[1]
        self.wall.append(1e3 * wall_s)
        self.cpu.append(1e3 * cpu_s)


def time_flow(before: Image, after: Image, watch: Watch) -> None:
    """Time the flow of exactly 200 corners, with OpenCV's other defaults."""
    corners = cv2.goodFeaturesToTrack(before, REFERENCE_POINTS, 1e-3, 10).reshape(-1, 2)
    points = np.resize(corners, (REFERENCE_POINTS, 2)).astype(np.float32)
    watch.start()
    cv2.calcOpticalFlowPyrLK(
        before,
        after,
        points,
        np.empty_like(points),
        winSize=REFERENCE_WINDOW,
        maxLevel=REFERENCE_LEVELS,
    )
    watch.stop()


def hold_to_one_core() -> None:
    """Keep all threads of this process, and those it will start, on one core."""
    cv2.setNumThreads(1)
    if not hasattr(os, "sched_setaffinity"):
        return
    core = {max(os.sched_getaffinity(0))}
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), core)
