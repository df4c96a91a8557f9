# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What readers share: image sequences, IMU streams, tables, pairing by time."""
