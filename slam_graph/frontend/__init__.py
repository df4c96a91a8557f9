# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""From images to feature tracks: extraction, data association, outlier rejection."""
