# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""From feature tracks to states: cost construction, Gauss-Newton steps, marginalization."""
