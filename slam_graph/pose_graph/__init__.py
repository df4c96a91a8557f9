# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose-graph optimization: files, initialization, steps, GNC, certificate of optimality."""
