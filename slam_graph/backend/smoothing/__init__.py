# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Smoothing: a whole recording as one visual-inertial bundle adjustment, at the end of a run.

Start at `final_adjustment.py` (`adjust_recording`). A run records its frames in a `frame_log.py`,
which is read back in segments (`recording_segment.py`); `track_fusion.py` finds tracks of the same
point, `recording_problem.py` minimises the cost of `recording_factors.py`. Moving objects are
smoothed likewise, each in its own frame (`object_smoothing.py`), and at last together with the
platform (`joint_objects.py`). Settings are in `smoothing_config.py`.
"""
