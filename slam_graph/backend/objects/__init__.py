# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects: which tracks move, which move together, and how each of these objects moves.

Start at `moving_objects.py`. `object_tracker.py` does one frame: it tests tracks for motion of
their own (`motion_test.py`), finds those that move together (`motion_segmentation.py`), and follows
each object (`tracked_object.py`) by the engine in the frame of the object (`relative_motion.py`).
"""
