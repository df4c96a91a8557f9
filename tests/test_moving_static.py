# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of moving and static tracks: its truth of every track, and what it counts."""

import numpy as np
import pytest

from benchmarks.moving_static import TrackTruth, answers, simulated, track_truth
from slam_graph.backend import ObjectFrame

SEED, SPEED = 0, 0.6


def test_the_flight_with_known_landmarks_is_the_same_flight() -> None:
    pairs = zip(simulated(SEED, SPEED).frames(), simulated(SEED, SPEED, True).frames(), strict=True)
    numbers: dict[int, int] = {}
    for plain, twin in pairs:
        seen, known = plain.cameras[0], twin.cameras[0]
        np.testing.assert_array_equal(seen.pixels, known.pixels)
        for track, landmark in zip(seen.ids.tolist(), known.ids.tolist(), strict=True):
            assert numbers.setdefault(track, landmark) == landmark


def test_the_truth_of_tracks_is_that_of_the_object_they_are_on() -> None:
    """A box that does not turn moves as its middle does; nothing else moves."""
    truth = track_truth(SEED, SPEED)
    sequence = simulated(SEED, SPEED)
    path = sequence.object_truth()[1]
    velocities = np.gradient(path.positions, 1e-9 * path.stamps_ns, axis=0, edge_order=2)
    on_object = 0
    for frame, velocity in list(zip(truth, velocities, strict=True))[2:-2]:
        assert np.all(frame.sideways[~frame.on_object] == 0.0)
        assert np.all(np.diff(frame.ids) > 0)
        on_object += np.count_nonzero(frame.on_object)
        # differences over 0.2 s: the acceleration changes in that time
        assert np.all(frame.sideways[frame.on_object] < np.linalg.norm(velocity) + 0.1)
    assert on_object > 20 * len(truth)


def made_up(
    called: dict[int, list[int]], speed: float = 0.5
) -> tuple[list[TrackTruth], list[ObjectFrame]]:
    """Seven frames in 0.6 s of a track on an object, number 1, and two static ones, 2 and 3.

    Args:
        called: frames in which each track is called moving.
        speed: of the first, to the side.
    """
    ids = np.array([1, 2, 3])
    truth, found = [], []
    for k in range(7):
        truth.append(TrackTruth(k * 10**8, ids, ids == 1, np.array([speed, 0.0, 0.0])))
        moving = np.array([j for j in ids.tolist() if k in called.get(j, ())], np.int64)
        probabilities = np.isin(ids, moving).astype(float)
        found.append(ObjectFrame(moving=moving, probabilities=(ids, probabilities)))
    return truth, found


@pytest.mark.parametrize(
    ("frames", "right", "delay"),
    [([2, 3, 4, 5, 6], True, 0.2), ([6], False, 0.6), ([1, 2], False, 0.1), ([], False, np.inf)],
)
def test_an_answer_is_right_if_it_is_there_after_half_a_second(
    frames: list[int], right: bool, delay: float
) -> None:
    found = answers(*made_up({1: frames}))
    assert found.right.tolist() == [right]
    assert found.seconds.tolist() == [pytest.approx(delay)]
    assert found.lost.tolist() == [False, False]


def test_a_static_track_that_is_called_moving_once_is_lost() -> None:
    found = answers(*made_up({1: [2, 3, 4, 5, 6], 3: [4]}))
    assert found.lost.tolist() == [False, True]
    assert np.count_nonzero(found.moves) == 7
    assert len(found.moves) == 21


def test_what_moves_slowly_counts_neither_way() -> None:
    found = answers(*made_up({1: [2, 3, 4, 5, 6]}, speed=0.2))
    assert len(found.right) == 0
    assert len(found.moves) == 14
    assert not found.moves.any()
