# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Parts for slam_graph, found by it through the entry points in pyproject.toml."""
