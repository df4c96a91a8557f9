# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Faults put into a recording on purpose, to see what an estimator makes of them.

`fault.py` has the base class, `frame_faults.py`, `imu_faults.py` and `clock_faults.py` the faults,
`injection.py` the recording that has them.
"""
