# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories, alignment and interpolation. Lie groups are GTSAM's."""
