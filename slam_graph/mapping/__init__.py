# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Maps and whole trajectories: pose graphs read, initialised, optimised, certified."""
