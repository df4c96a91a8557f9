# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Camera models, the IMU model, the calibration of a rig, and the measurements that they make."""
