# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The recording as a whole: keyframes, fused tracks, the final bundle adjustment."""
