# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What tests of untrusted files share."""

from pathlib import Path

from slam_graph.datasets import open_dataset

ALIASES = "a: &l0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"k{k}: &l{k} [{', '.join([f'*l{k - 1}'] * 10)}]\n" for k in range(1, 10)
)
"""Ten lines that stand for 10¹⁰ values."""


def read_all(path: Path) -> None:
    """Everything that a run reads of a recording."""
    sequence = open_dataset(path)
    sequence.info()
    sequence.groundtruth()
    sequence.initial_state()
    for _ in sequence.packets():
        pass
