# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The words that an evaluation understands; imports nothing heavy, so that `--help` is fast."""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal, get_args

from slam_graph.errors import ConfigError, closest

PoseRelation = Literal["full", "trans_part", "rot_part", "angle_deg", "angle_rad"]
"""Which part of the difference of two poses is the error (see `ape`)."""

ERROR_UNITS: dict[PoseRelation, str] = {
    "full": "",
    "trans_part": "m",
    "rot_part": "",
    "angle_deg": "deg",
    "angle_rad": "rad",
}

DeltaUnit = Literal["f", "m", "d", "r"]
"""The unit of the length of a step of a relative error."""

STEP_UNITS: dict[DeltaUnit, str] = {"f": "frames", "m": "m", "d": "deg", "r": "rad"}

Pairing = Literal["interpolate", "nearest"]
"""How an estimated pose gets the true pose of its time (see `truth_pairing`)."""

PAIRINGS: tuple[Pairing, ...] = get_args(Pairing)


def require_known(word: str, known: Collection[str], what: str) -> None:
    """Make sure that a word is one of those that are understood.

    Args:
        word: what the caller asked for.
        known: all words that have a meaning there.
        what: the argument, for the message.

    Raises:
        ConfigError: naming the argument and the known word that is most like `word`.
    """
    if word not in known:
        raise ConfigError(f"unknown {what} '{word}'; {closest(str(word).lower(), known)}")
