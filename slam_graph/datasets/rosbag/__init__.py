# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 and ROS 2 and MCAP files as recordings."""
