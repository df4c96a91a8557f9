# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Memory that is free, but that the C library keeps, is given back to the system."""

from __future__ import annotations

import ctypes
import sys

__all__ = ["give_back"]


def give_back() -> None:
    """Give free memory back to the system, where the C library is glibc.

    It keeps what was freed for what may come, most of it until the program ends, as the arrays that
    files were made of (1.8 kB a state), or those of up to 32 MB of a bundle adjustment.
    """
    if sys.platform.startswith("linux"):
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
