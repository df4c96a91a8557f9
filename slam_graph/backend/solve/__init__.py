# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 2 of the loop, Gauss-Newton steps: the state, its square-root information, the steps."""
