# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps: images of several cameras grouped into frames, and stamps out of order left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FOLLOWERS = 7
"""Stamps by which it is judged whether the one before them is from the future."""


def in_order(
    stamps_ns: NDArray[np.int64],
    dropped: Callable[[int, int], None],
    latest_ns: int | None = None,
    following_ns: NDArray[np.int64] | None = None,
) -> NDArray[np.intp]:
    """Indices of stamps that increase.

    Of two stamps in the wrong order the second is dropped, unless it, or most of the `FOLLOWERS`
    stamps from it on, continue those before the first: then that is from the future, and would
    block all that follow.

    Args:
        stamps_ns: (N,) in the order of the recording.
        dropped: called with the index of each stamp that is left out, and the last one kept.
        latest_ns: the last stamp before these.
        following_ns: the first stamps after these, in a recording that is read in parts.
    """
    ahead = stamps_ns[:0] if following_ns is None else following_ns
    together = np.concatenate([stamps_ns, ahead])
    latest = int(np.iinfo(np.int64).min) if latest_ns is None else latest_ns
    if np.all(together[1:] > together[:-1]) and not np.any(stamps_ns[:1] <= latest):
        return np.arange(len(stamps_ns))
    kept = []
    times = together.tolist()
    for k, stamp in enumerate(times[: len(stamps_ns)]):
        if stamp <= latest or _blocks(stamp, times[k + 1 : k + 1 + FOLLOWERS], latest):
            dropped(k, latest)
            continue
        latest = stamp
        kept.append(k)
    return np.array(kept, np.intp)


def _blocks(stamp_ns: int, following_ns: list[int], latest_ns: int) -> bool:
    """Whether a stamp is from the future, by the stamps after it and the last one kept."""
    earlier = [latest_ns < following < stamp_ns for following in following_ns]
    return any(earlier[:1]) or 2 * sum(earlier) > len(earlier)


ABSENT = -1
"""Stands in a group for a camera that has no image in it."""

_LARGEST_TOLERANCE_PERIODS = 0.4
"""The tolerance is at most this share of a camera's period, so that neighbours are never paired."""


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """Images grouped by time.

    Attributes:
        stamps_ns: (F,) int64, strictly increasing: the stamp of the first camera in each group.
        members: (F, C) int64: index of the image of each camera, `ABSENT` where it has none.
        skipped: stamps of groups left out, because they are not later than the one before.
    """

    stamps_ns: NDArray[np.int64]
    members: NDArray[np.int64]
    skipped: list[int]


def group_by_time(cameras: Sequence[NDArray[np.int64]], tolerance_ns: int) -> Groups:
    """Group the stamps of C cameras.

    A group begins with the earliest image that is in no group, and takes from each other camera its
    next image if that is at most `tolerance_ns` later.

    Args:
        cameras: C arrays of strictly increasing stamps.
        tolerance_ns: largest difference within a group; at most 0.4 periods of the cameras.
    """
    tolerance_ns = min(tolerance_ns, *(_largest_tolerance(stamps) for stamps in cameras))
    stamps = np.concatenate(cameras)
    owner = np.repeat(np.arange(len(cameras)), [len(c) for c in cameras])
    index = np.concatenate([np.arange(len(c)) for c in cameras])
    order = np.lexsort((owner, stamps))
    rows: list[list[int]] = []
    begin = 0
    for stamp, camera, k in zip(
        stamps[order].tolist(), owner[order].tolist(), index[order].tolist(), strict=True
    ):
        if not rows or stamp - begin > tolerance_ns or rows[-1][camera] != ABSENT:
            rows.append([ABSENT] * len(cameras))
            begin = stamp
        rows[-1][camera] = k
    return _name_groups(cameras, np.array(rows, np.int64).reshape(-1, len(cameras)))


def _name_groups(cameras: Sequence[NDArray[np.int64]], members: NDArray[np.int64]) -> Groups:
    """Give each group the stamp of its first camera, and leave out groups out of order."""
    stamps = np.zeros(len(members), np.int64)
    for camera in reversed(range(len(cameras))):
        there = members[:, camera] != ABSENT
        stamps[there] = cameras[camera][members[there, camera]]
    latest = np.maximum.accumulate(stamps)
    keep = np.ones(len(stamps), bool)
    keep[1:] = stamps[1:] > latest[:-1]
    return Groups(stamps[keep], members[keep], stamps[~keep].tolist())


def _largest_tolerance(stamps: NDArray[np.int64]) -> int:
    if len(stamps) < 2:
        return int(np.iinfo(np.int64).max)
    return int(_LARGEST_TOLERANCE_PERIODS * float(np.median(np.diff(stamps))))
