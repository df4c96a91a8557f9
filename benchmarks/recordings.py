# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which recordings and seeds parameters were chosen on, and which are held out of every choice.

A figure on a recording that parameters were chosen on says how well the choice went. What to expect
elsewhere is said by the figures on what is held out; reports show these apart. Nobody may look at a
held-out figure in order to choose: not a threshold, not a default, not an algorithm.

V2_02 and MH_04 are held out from now on only: earlier comparisons of algorithms on real IMUs looked
at all four flights. No choice has looked at TUM-VI's room3.
"""

from __future__ import annotations

from slam_graph.errors import DataError

CHOSEN_ON = (
    "euroc/MH_01_easy_17s",
    "euroc_inertial/V1_01_easy",  # the truth of the demo
    "euroc_inertial/V1_02_medium",
    "euroc_inertial/V2_01_easy",
    "openvins_sim/euroc_V1_01",
    "posegraphs",
    "tumvi_inertial/room1",
)
"""Paths below the folder of recordings that any parameter may have been chosen on."""

HELD_OUT = (
    "euroc_inertial/V2_02_medium",
    "euroc_inertial/MH_04_difficult",
    "tumvi_inertial/room3",
)
"""Those that none may be chosen on."""

FIRST_HELD_OUT_SEED = 100
"""Seeds of simulations and front ends below this one may be used to choose, others not."""


def is_held_out(path: str) -> bool:
    """Whether a recording, by its path below the folder of recordings, is kept out of choices.

    Raises:
        DataError: if neither table knows it: say first what it is for.
    """
    if path not in CHOSEN_ON + HELD_OUT:
        raise DataError(f"{path}: not in the tables of benchmarks/recordings.py; add it there")
    return path in HELD_OUT
