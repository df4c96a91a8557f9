# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment (BA) of problems in BAL's format: all cameras and points until convergence.

Start at `bal_solve.py` (`adjust_bundle`), which names the three modules of the table: cost
(`bal_cost.py`), Levenberg-Marquardt steps with the points eliminated (`bal_schur.py`), no
marginalization.
`bal_problem.py` has the problem and the camera model, `bal_file.py` reads and writes files,
`bal_policy.py` has the settings.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "BalEstimates",
    "BalPolicy",
    "BalSolution",
    "adjust_bundle",
    "bal_lines",
    "is_bal",
    "read_bal",
    "reprojection_errors",
]

if TYPE_CHECKING:
    from slam_graph.bundle_adjustment.bal_cost import reprojection_errors
    from slam_graph.bundle_adjustment.bal_file import bal_lines, is_bal, read_bal
    from slam_graph.bundle_adjustment.bal_policy import BalPolicy, BalSolution
    from slam_graph.bundle_adjustment.bal_problem import BalEstimates
    from slam_graph.bundle_adjustment.bal_solve import adjust_bundle
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "bal_cost": ("reprojection_errors",),
            "bal_file": ("bal_lines", "is_bal", "read_bal"),
            "bal_policy": ("BalPolicy", "BalSolution"),
            "bal_problem": ("BalEstimates",),
            "bal_solve": ("adjust_bundle",),
        },
    )
