# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A module that cannot be imported: what it must not break is tested."""

from a_library_that_nobody_has import Detector  # noqa: F401
