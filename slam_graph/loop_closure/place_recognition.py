# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Place recognition: keyframes of similar appearance, by bags of binary words.

A descriptor is quantised to the nearest word of a vocabulary, a keyframe becomes a vector of word
frequencies weighted by the rarity of the words (tf-idf), and keyframes are compared by the cosine
of their vectors (Sivic and Zisserman 2003; with binary words, Galvez-Lopez and Tardos 2012). An
inverted index reaches the keyframes that share a word without visiting the others.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.loop_closure.loop_config import PlaceConfig
from slam_graph.loop_closure.loop_keyframes import Descriptors, Keyframe

TRAINING_DESCRIPTORS = 30_000
"""Largest number of descriptors that a vocabulary is trained on, for its time (some seconds)."""
TRAINING_ROUNDS = 6
"""Rounds of k-majority: later ones hardly move the words."""
MIN_SCORE_RATIO = 0.3
"""Least similarity of a candidate relative to that of the preceding keyframe, which shows nearly
the same view (Galvez-Lopez and Tardos 2012)."""
CONSECUTIVE = 1
"""Number of preceding keyframes that must have had candidates of the same place."""
SAME_PLACE = 5
"""Keyframes whose numbers differ by no more than this show the same place."""


@dataclass(frozen=True, slots=True, eq=False)
class WordVector:
    """A bag of words.

    Attributes:
        words: (M,) numbers of its words, ascending.
        weights: (M,) tf-idf weights, of unit length.
    """

    words: IntArray
    weights: FloatArray


class Vocabulary:
    """Binary words and their weights.

    Attributes:
        words: (W, B) descriptors.
        idf: (W,) inverse document frequency of each word.
    """

    def __init__(self, words: Descriptors, idf: FloatArray) -> None:
        self.words = words
        self.idf = idf
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        self._matcher.add([words])

    def quantize(self, descriptors: Descriptors) -> IntArray:
        """The nearest word (N,) of each descriptor (N, B)."""
        matches = self._matcher.match(descriptors)
        return np.fromiter((m.trainIdx for m in matches), np.int64, len(matches))

    def words_of(self, descriptors: Descriptors) -> WordVector:
        """The bag of words of a keyframe with descriptors (N, B)."""
        words, counts = np.unique(self.quantize(descriptors), return_counts=True)
        weights = counts * self.idf[words]
        return WordVector(words, weights / max(float(np.linalg.norm(weights)), 1e-12))

    def index(self, documents: Iterable[Descriptors]) -> PlaceDatabase:
        """An index of keyframes with these descriptors (N, B) each."""
        database = PlaceDatabase(len(self.words))
        for descriptors in documents:
            database.add(self.words_of(descriptors))
        return database

    @staticmethod
    def train(
        documents: list[Descriptors],
        words: int,
        rng: np.random.Generator,
        limit: int = TRAINING_DESCRIPTORS,
        rounds: int = TRAINING_ROUNDS,
    ) -> Vocabulary:
        """Cluster descriptors by k-majority: a centre has the majority of the bits of its cluster.

        Args:
            documents: (N, B) descriptors of each keyframe.
            words: number of clusters; fewer if there are fewer descriptors.
            rng: draws descriptors and initial centres.
            limit: largest number of descriptors to train on.
            rounds: of assignment and update.
        """
        pool = np.concatenate(documents)
        pool = pool[rng.permutation(len(pool))[:limit]]
        centres = np.unique(pool[:words], axis=0)
        bits = np.unpackbits(pool, axis=1).astype(np.int32)
        for _ in range(rounds):
            nearest = Vocabulary(centres, np.zeros(len(centres))).quantize(pool)
            centres = majority(bits, nearest, centres)
        unweighted = Vocabulary(centres, np.zeros(len(centres)))
        present = np.zeros(len(centres))
        for document in documents:
            present[np.unique(unweighted.quantize(document))] += 1
        # words of all keyframes have no weight; those of none count as the rarest
        return Vocabulary(centres, np.log((len(documents) + 1) / np.maximum(present, 1.0)))


def majority(bits: NDArray[np.int32], nearest: IntArray, centres: Descriptors) -> Descriptors:
    """New centres: the majority of the bits of each cluster; those of empty clusters stay."""
    order = np.argsort(nearest, kind="stable")
    used, first, sizes = np.unique(nearest[order], return_index=True, return_counts=True)
    ones = np.add.reduceat(bits[order], first, axis=0)
    moved = centres.copy()
    moved[used] = np.packbits(2 * ones > sizes[:, None], axis=1)
    return moved


class PlaceDatabase:
    """An inverted index of keyframes by their words.

    Args:
        words: size of the vocabulary.
    """

    def __init__(self, words: int) -> None:
        self._count = 0
        self._keyframes = [array("q") for _ in range(words)]
        self._weights = [array("d") for _ in range(words)]

    def __len__(self) -> int:
        return self._count

    def add(self, bag: WordVector) -> None:
        """Add the next keyframe."""
        for word, weight in zip(bag.words.tolist(), bag.weights.tolist(), strict=True):
            self._keyframes[word].append(self._count)
            self._weights[word].append(weight)
        self._count += 1

    def query(self, bag: WordVector) -> FloatArray:
        """Similarity (K,) to every keyframe, from 0 to 1."""
        if len(bag.words) == 0:
            return np.zeros(self._count)
        words = bag.words.tolist()
        shared = [np.array(self._keyframes[word], dtype=np.int64) for word in words]
        weights = [np.array(self._weights[word], dtype=np.float64) for word in words]
        products = np.concatenate(weights) * np.repeat(bag.weights, [len(x) for x in shared])
        return np.bincount(np.concatenate(shared), products, self._count).astype(np.float64)

    def similar(self, bag: WordVector, count: int) -> IntArray:
        """The `count` most similar keyframes of different places, best first."""
        return best_places(self.query(bag), 0.0, count)


def best_places(scores: FloatArray, least: float, count: int, apart: int = SAME_PLACE) -> IntArray:
    """The most similar keyframes, best first, each the best of its neighbourhood.

    Args:
        scores: (K,) similarities.
        least: lowest score of a candidate.
        count: largest number of candidates.
        apart: numbers of two candidates differ by more than this.
    """
    remaining = scores.copy()
    best: list[int] = []
    while len(best) < count and len(remaining):
        at = int(np.argmax(remaining))
        if remaining[at] < least or remaining[at] <= 0:
            break
        best.append(at)
        remaining[max(at - apart, 0) : at + apart + 1] = 0.0
    return np.array(best, dtype=np.int64)


class PlaceRecognition:
    """Loop candidates, keyframe by keyframe.

    A candidate must be similar, and temporally consistent: the preceding keyframe must have had a
    candidate of the same place.

    Args:
        vocabulary: of words.
        config: thresholds.
    """

    def __init__(self, vocabulary: Vocabulary, config: PlaceConfig) -> None:
        self._vocabulary = vocabulary
        self._database = PlaceDatabase(len(vocabulary.words))
        self._config = config
        self._stamps_ns: list[int] = []
        self._similar: list[IntArray] = []

    def add(self, keyframe: Keyframe) -> IntArray:
        """Add the next keyframe; returns the numbers of its candidates."""
        config = self._config
        bag = self._vocabulary.words_of(keyframe.descriptors)
        scores = self._database.query(bag)
        old = np.searchsorted(self._stamps_ns, keyframe.stamp_ns - config.min_gap_s * 1e9)
        # the preceding keyframe shows how similar views of one place are here
        least = MIN_SCORE_RATIO * scores[-1] if len(scores) else 0.0
        similar = best_places(scores[:old], least, config.candidates)
        consistent = [place for place in similar.tolist() if self._was_similar(place)]
        self._database.add(bag)
        self._stamps_ns.append(keyframe.stamp_ns)
        self._similar.append(similar)
        return np.array(consistent, dtype=np.int64)

    def _was_similar(self, place: int) -> bool:
        """Whether the preceding keyframes had candidates of this place too."""
        before = self._similar[len(self._similar) - CONSECUTIVE :]
        return len(before) == CONSECUTIVE and all(
            bool(np.any(np.abs(similar - place) <= SAME_PLACE)) for similar in before
        )
