# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The experiment: one front end's tracks under every algorithm, in a table and in figures."""
