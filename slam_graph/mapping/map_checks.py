# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What must hold in a map that came from outside, beyond types and shapes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_graph.errors import DataError
from slam_graph.mapping.map_model import NO_FEATURE, SlamMap

FARTHEST_M = 1e8
"""No coordinate of a map is larger."""

FARTHEST_RAY = 1e4
"""No coordinate on the plane z = 1 is larger."""


def check_map(content: SlamMap, path: Path) -> None:
    """Refuse a map whose numbers make no sense.

    Raises:
        DataError: naming the array at fault, and where in it.
    """
    if len(content) == 0 or len(content.features) == 0:
        raise DataError(f"{path}: the map is empty: no keyframes that see anything; make it again")
    if content.descriptors.shape[1] == 0 or len(content.vocabulary.words) == 0:
        raise DataError(
            f"{path}: the map has no descriptors, so that no place can be recognised in it; make "
            "it from images, or from tracks with descriptors"
        )
    for name, good, what in _rows(content):
        if not good.all():
            row = int(np.flatnonzero(~good.reshape(len(good), -1).all(axis=1))[0])
            raise DataError(f"{path}: {name}.npy: row {row} {what}; make the map again")


def _rows(content: SlamMap) -> Iterator[tuple[str, NDArray[np.bool_], str]]:
    """Name of each array, whether its rows are good, and what is wrong with those that are not."""
    links, words = content.links, content.vocabulary
    for name, values, largest in (
        ("positions", content.poses.translations, FARTHEST_M),
        ("points", content.points, FARTHEST_M),
        ("normalized", content.normalized, FARTHEST_RAY),
        ("link_positions", links.measured.translations, FARTHEST_M),
        ("link_covariances", links.covariances, FARTHEST_M),
        ("word_weights", words.idf, FARTHEST_M),
    ):
        yield name, np.abs(values) <= largest, f"is not finite or beyond {largest:g}"
    count, offsets = len(content), content.offsets
    ends = (offsets[0] == 0) & (offsets[-1] == len(content.features))
    rising = np.diff(offsets, prepend=offsets[0]) >= 0
    yield "offsets", rising & ends, "does not lead from 0 to all observations"
    yield "features", _within(content.features, NO_FEATURE, len(content.points)), "is no feature"
    number = content.recording_of
    yield "recording_of", _within(number, 0, len(content.recordings)), "is no recording"
    yield "recording_of", np.diff(number, prepend=number[0]) >= 0, "is of an earlier recording"
    later = np.concatenate([[True], content.stamps_ns[1:] > content.stamps_ns[:-1]])
    first = np.diff(number, prepend=number[0]) > 0
    yield "stamps_ns", later | first, "is not later than the row before"
    yield "link_ends", _within(links.ends, 0, count), "is no keyframe"
    yield "link_ends", links.ends[:, 0] != links.ends[:, 1], "joins a keyframe with itself"
    covariances = links.covariances
    same = np.isclose(covariances, covariances.transpose(0, 2, 1)).reshape(-1, 36)
    sound = same.all(axis=1) & (np.linalg.eigvalsh(covariances)[:, 0] > 0)
    yield "link_covariances", sound, "is not a covariance"
    yield "word_weights", words.idf >= 0, "is negative"


def _within(values: NDArray[Any], low: int, end: int) -> NDArray[np.bool_]:
    """Which values are at least `low` and below `end`."""
    return np.asarray((values >= low) & (values < end))
