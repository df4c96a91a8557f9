# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment (BA) of problems in BAL's format: all cameras and points until convergence.

Start at `bal_solve.py` (`adjust_bundle`), which names the three modules of the table: cost
(`bal_cost.py`), Levenberg-Marquardt steps with the points eliminated (`bal_schur.py`), no
marginalization.
`bal_problem.py` has the problem and the camera model, `bal_file.py` reads and writes files,
`bal_policy.py` has the settings.
"""
