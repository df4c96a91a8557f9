# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""GTSAM's own smoothers (iSAM2, fixed lag) as engines of the estimator."""
