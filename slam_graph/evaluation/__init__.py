# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How good an estimate is: ATE, RPE, NEES, and the report of a run."""
