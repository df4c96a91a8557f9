# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files: rigs in the formats of Kalibr and EuRoC, whose faults name file and line."""
