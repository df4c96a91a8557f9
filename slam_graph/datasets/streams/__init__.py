# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Parts that readers share: image sequences, IMU streams, CSV rows, grouping by time."""
