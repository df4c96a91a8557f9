# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences that never happened: flights, IMU, landmarks, feature tracks and rendered images."""
