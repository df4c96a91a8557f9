# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Place recognition: the place that was seen is found, and none for a new one."""

import numpy as np
import pytest

from slam_graph.loop_closure.place_recognition import (
    PlaceDatabase,
    Vocabulary,
    WordVector,
    best_places,
)


def noisy(descriptors: np.ndarray, rng: np.random.Generator, share: float = 0.08) -> np.ndarray:
    """The same descriptors seen again, with wrong bits."""
    wrong = rng.random((len(descriptors), 256)) < share
    return descriptors ^ np.packbits(wrong, axis=1)


@pytest.fixture(scope="module")
def places() -> list[np.ndarray]:
    """Descriptors of 40 places, 60 of each."""
    rng = np.random.default_rng(1)
    return list(rng.integers(0, 256, (40, 60, 32), dtype=np.uint8))


@pytest.fixture(scope="module")
def vocabulary(places: list[np.ndarray]) -> Vocabulary:
    rng = np.random.default_rng(2)
    seen = [noisy(place, rng) for place in places]
    return Vocabulary.train(seen, 1000, rng, 5000, 3)


def test_a_place_is_found_again(places: list[np.ndarray], vocabulary: Vocabulary) -> None:
    rng, database = np.random.default_rng(3), PlaceDatabase(len(vocabulary.words))
    for place in places:
        database.add(vocabulary.words_of(noisy(place, rng)))
    for number, place in enumerate(places):
        scores = database.query(vocabulary.words_of(noisy(place, rng)))
        others = np.delete(scores, number)
        assert scores[number] > 2.0 * others.max()


def test_a_new_place_is_like_none(places: list[np.ndarray], vocabulary: Vocabulary) -> None:
    rng, database = np.random.default_rng(4), PlaceDatabase(len(vocabulary.words))
    for place in places:
        database.add(vocabulary.words_of(noisy(place, rng)))
    again = database.query(vocabulary.words_of(noisy(places[7], rng)))[7]
    for _ in range(10):
        new = rng.integers(0, 256, (60, 32), dtype=np.uint8)
        assert database.query(vocabulary.words_of(new)).max() < 0.3 * again


def test_scores_are_cosines(vocabulary: Vocabulary) -> None:
    rng, size = np.random.default_rng(5), len(vocabulary.words)
    database, vectors = PlaceDatabase(size), np.zeros((30, size))
    for row in vectors:
        bag = vocabulary.words_of(rng.integers(0, 256, (50, 32), dtype=np.uint8))
        row[bag.words] = bag.weights
        database.add(bag)
    bag = vocabulary.words_of(rng.integers(0, 256, (50, 32), dtype=np.uint8))
    dense = np.zeros(size)
    dense[bag.words] = bag.weights
    np.testing.assert_allclose(database.query(bag), vectors @ dense, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0)


def test_words_are_medians_of_what_they_stand_for() -> None:
    rng = np.random.default_rng(6)
    true = rng.integers(0, 256, (20, 32), dtype=np.uint8)
    seen = noisy(np.repeat(true, 50, axis=0), rng)
    vocabulary = Vocabulary.train([seen], 60, rng, 10_000, 8)
    bits = np.unpackbits(vocabulary.words[:, None] ^ true[None], axis=2).sum(axis=2)
    # several words may share a cluster, but the nearest to each is nearer than what was seen of it
    assert np.median(bits.min(axis=0)) < 0.08 * 256 / 2


def test_an_empty_keyframe_is_like_none(vocabulary: Vocabulary) -> None:
    database = PlaceDatabase(len(vocabulary.words))
    database.add(vocabulary.words_of(vocabulary.words[:10]))
    assert database.query(WordVector(np.zeros(0, np.int64), np.zeros(0))).tolist() == [0.0]


def test_best_places_are_the_best_of_their_neighbours() -> None:
    scores = np.array([0.1, 0.5, 0.9, 0.6, 0.0, 0.0, 0.4, 0.2])
    assert best_places(scores, 0.3, 5, apart=2).tolist() == [2, 6]
    assert best_places(scores, 0.3, 1, apart=2).tolist() == [2]
    assert best_places(scores, 0.95, 5, apart=2).tolist() == []
    assert best_places(np.zeros(3), 0.0, 5, apart=0).tolist() == []
