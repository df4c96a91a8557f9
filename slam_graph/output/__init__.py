# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a run leaves behind: states, timing, metrics, and the files that hold them."""
