# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How long a test waits for another process."""

HANG_S = 1200
"""Against hangs only: ten times what the slowest command of the tests takes on a loaded machine."""
