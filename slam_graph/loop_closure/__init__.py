# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure at the end of a run.

Start at `close_loops.py` (`close_loops`): keyframes (`loop_keyframes.py`), place recognition,
verification, a pose graph in four degrees of freedom (`loop_pose_graph.py`). Settings are in
`loop_config.py`.
"""
