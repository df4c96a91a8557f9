# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings: one protocol (`sequence`), a reader per format, and `open_dataset`."""
