# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 1 of the loop, cost construction: the variables and residuals of a step."""
