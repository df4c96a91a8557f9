# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""GTSAM's own smoothers (iSAM2, fixed lag) behind the same interface as the engine."""
