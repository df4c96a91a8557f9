# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 3 of the loop, marginalization: variables leave, and the prior they leave behind."""
