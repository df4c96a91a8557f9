# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m slam_graph`: the command `slam-graph`, where it is not on the path."""

from slam_graph.cli.launch import main

if __name__ == "__main__":
    main()
