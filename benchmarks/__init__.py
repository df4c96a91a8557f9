# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmarks: how accurate and how fast slam_graph is, beside others on the same measurements.

Every figure that counts is an accuracy or a ratio of times that were measured in the same run.
"""
