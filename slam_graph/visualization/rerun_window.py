# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The factor graph of a window and its information matrix, before and after marginalization."""
