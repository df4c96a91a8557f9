# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Experiments: algorithms compared on the same feature tracks, and front ends on the same images.

`compare` (in `experiment/comparison.py`) records the tracks of every recording and seed once, runs
every algorithm on them in separate processes, and writes a report.
"""
