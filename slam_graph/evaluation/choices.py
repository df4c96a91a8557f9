# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Names of what can be asked of an evaluation; imports nothing, so that `--help` is fast."""

from __future__ import annotations

from typing import Literal

PoseRelation = Literal["full", "trans_part", "rot_part", "angle_deg", "angle_rad"]
"""Which part of the difference of two poses is the error (see `relations`)."""

ERROR_UNITS: dict[PoseRelation, str] = {
    "full": "",
    "trans_part": "m",
    "rot_part": "",
    "angle_deg": "deg",
    "angle_rad": "rad",
}

DeltaUnit = Literal["f", "m", "d", "r"]
"""In what the steps of a relative error are measured."""

STEP_UNITS: dict[DeltaUnit, str] = {"f": "frames", "m": "m", "d": "deg", "r": "rad"}
