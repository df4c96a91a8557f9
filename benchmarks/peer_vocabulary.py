# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A small vocabulary of ORB descriptors, in the text format of DBoW2.

A tree of k-medians in Hamming's distance (Gálvez-López & Tardós 2012). A place recogniser would
want a million words from many places; a clip without loops needs it only to look for matches among
descriptors of the same node.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

BRANCHES, LEVELS = 10, 4
ROUNDS = 6
"""Of assigning descriptors to medians, at each node."""
FEATURES_PER_IMAGE = 1000

TF_IDF, L1_NORM = 0, 0
"""How the format counts words, and how it compares images."""

Bytes = NDArray[np.uint8]
Bits = NDArray[np.float32]


def train(images: Iterable[Path], file: Path, seed: int = 0) -> None:
    """Write a vocabulary.

    Args:
        images: other ones than those it will be used on.
        file: is written.
        seed: of the choice of first medians.
    """
    per_image = [descriptors(path) for path in images]
    described = np.concatenate(per_image)
    owners = np.repeat(np.arange(len(per_image)), [len(rows) for rows in per_image])
    rng = np.random.default_rng(seed)
    lines = [f"{BRANCHES} {LEVELS} {L1_NORM} {TF_IDF}"]

    def grow(parent: int, rows: NDArray[np.int64], level: int) -> None:
        """Add the children of a node, depth first; a node's number is that of its line."""
        bits = np.unpackbits(described[rows], axis=1).astype(np.float32)
        medians, nearest = clusters(bits, rng)
        for child, median in enumerate(medians):
            inside = rows[nearest == child]
            leaf = level == LEVELS or len(inside) <= BRANCHES
            seen_in = max(len(np.unique(owners[inside])), 1)
            weight = np.log(len(per_image) / seen_in) if leaf else 0.0
            packed = np.packbits(median.astype(np.uint8))
            number = len(lines)
            lines.append(f"{parent} {int(leaf)} {' '.join(map(str, packed))} {weight:.6f}")
            if not leaf:
                grow(number, inside, level + 1)

    grow(0, np.arange(len(described)), 1)
    # a line break at the end would be read as one more node
    file.write_text("\n".join(lines), encoding="utf-8")


def descriptors(path: Path) -> Bytes:
    """(N, 32) ORB descriptors of an image; none if it cannot be decoded."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        return np.empty((0, 32), np.uint8)
    found = cv2.ORB_create(FEATURES_PER_IMAGE).detectAndCompute(image, None)[1]  # type: ignore[attr-defined]
    return np.empty((0, 32), np.uint8) if found is None else np.asarray(found, np.uint8)


def clusters(bits: Bits, rng: np.random.Generator) -> tuple[Bits, NDArray[np.int64]]:
    """Medians (K, 256) of N descriptors, K at most `BRANCHES`, and the nearest of each (N,)."""
    medians = np.unique(bits[rng.permutation(len(bits))[:BRANCHES]], axis=0)
    for _ in range(ROUNDS):
        nearest = np.argmin(hamming(bits, medians), axis=1)
        for k in range(len(medians)):
            if np.any(nearest == k):
                medians[k] = bits[nearest == k].mean(axis=0) > 0.5
    return medians, np.argmin(hamming(bits, medians), axis=1)


def hamming(a: Bits, b: Bits) -> Bits:
    """(N, K) distances of descriptors (N, 256) and (K, 256) of zeros and ones."""
    return np.asarray(a.sum(1)[:, None] + b.sum(1)[None, :] - 2.0 * a @ b.T)
