# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The version, in one place."""

__all__ = ["__version__"]

__version__ = "0.1.0.dev0"
