# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Time that runs backwards: which of some stamps to keep so that they increase."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray


def in_order(
    stamps_ns: NDArray[np.int64],
    dropped: Callable[[int, int], None],
    latest_ns: int | None = None,
) -> NDArray[np.intp]:
    """Indices of stamps that increase.

    Of two stamps in the wrong order the second goes, unless it continues those before them: then
    the first one is from the future, and must not block all that follow.

    Args:
        stamps_ns: (N,) in the order of the recording.
        dropped: is told the index of each stamp that is left out, and the last one kept before it.
        latest_ns: the last stamp before these.
    """
    latest = int(np.iinfo(np.int64).min) if latest_ns is None else latest_ns
    if np.all(stamps_ns[1:] > stamps_ns[:-1]) and not np.any(stamps_ns[:1] <= latest):
        return np.arange(len(stamps_ns))
    kept = []
    times = stamps_ns.tolist()
    for k, (stamp, following) in enumerate(pairwise([*times, times[-1] + 1])):
        if stamp <= latest or latest < following < stamp:
            dropped(k, latest)
            continue
        latest = stamp
        kept.append(k)
    return np.array(kept, np.intp)
