# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run from end to end: `run` is the table of contents, each other file one stage of it."""
