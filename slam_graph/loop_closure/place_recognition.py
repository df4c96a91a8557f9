# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Place recognition: which keyframes look like this one, by bags of binary words.

A descriptor is quantised to the nearest word of a vocabulary, a keyframe becomes a vector of word
frequencies weighted by how rare the words are (tf-idf), and keyframes are compared by the cosine of
their vectors (Sivic and Zisserman 2003; with binary words, Galvez-Lopez and Tardos 2012). An
inverted index reaches the keyframes that share a word without looking at the others.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray

Descriptors = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class WordVector:
    """A bag of words.

    Attributes:
        words: (M,) numbers of the words that it has, ascending.
        weights: (M,) tf-idf weights, of unit length.
    """

    words: IntArray
    weights: FloatArray


class Vocabulary:
    """Binary words, and how much each says.

    Attributes:
        words: (W, B) descriptors.
        idf: (W,) inverse document frequency: the logarithm of how rare a word is.
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

    @staticmethod
    def train(
        documents: list[Descriptors],
        words: int,
        limit: int,
        iterations: int,
        rng: np.random.Generator,
    ) -> Vocabulary:
        """Cluster descriptors by k-majority: the centre of a cluster has the bits of most of it.

        Args:
            documents: (N, B) descriptors of each keyframe.
            words: how many clusters; fewer where there are fewer descriptors.
            limit: how many descriptors to train on at most.
            iterations: rounds of assignment and update.
            rng: draws descriptors and first centres.
        """
        pool = np.concatenate(documents)
        pool = pool[rng.permutation(len(pool))[:limit]]
        centres = np.unique(pool[:words], axis=0)
        bits = np.unpackbits(pool, axis=1).astype(np.int32)
        for _ in range(iterations):
            nearest = Vocabulary(centres, np.zeros(len(centres))).quantize(pool)
            centres = majority(bits, nearest, centres)
        unweighted = Vocabulary(centres, np.zeros(len(centres)))
        present = np.zeros(len(centres))
        for document in documents:
            present[np.unique(unweighted.quantize(document))] += 1
        # a word that every keyframe has says nothing; one that none has is as rare as can be
        return Vocabulary(centres, np.log((len(documents) + 1) / np.maximum(present, 1.0)))


def majority(bits: NDArray[np.int32], nearest: IntArray, centres: Descriptors) -> Descriptors:
    """New centres: the bits of most of each cluster; empty clusters stay."""
    order = np.argsort(nearest, kind="stable")
    used, first, sizes = np.unique(nearest[order], return_index=True, return_counts=True)
    ones = np.add.reduceat(bits[order], first, axis=0)
    moved = centres.copy()
    moved[used] = np.packbits(2 * ones > sizes[:, None], axis=1)
    return moved


class PlaceDatabase:
    """Keyframes by the words that they have.

    A query is one pass over the entries of the words that it has.

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


def best_places(scores: FloatArray, least: float, count: int, apart: int) -> IntArray:
    """Numbers of the most similar keyframes, the best first, each the best of its neighbours.

    Args:
        scores: (K,) similarities.
        least: what a candidate must reach.
        count: how many at most.
        apart: numbers of two candidates differ by more than this.
    """
    left = scores.copy()
    best: list[int] = []
    while len(best) < count and len(left):
        at = int(np.argmax(left))
        if left[at] < least or left[at] <= 0:
            break
        best.append(at)
        left[max(at - apart, 0) : at + apart + 1] = 0.0
    return np.array(best, dtype=np.int64)
