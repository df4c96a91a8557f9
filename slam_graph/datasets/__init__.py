# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded sequences: one file per format behind one protocol, and a registry that guesses."""
