# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment (BA) of problems in BAL's format: all cameras and points until convergence.

Start at `bal_solve.py` (`adjust_bundle`), which names the three modules of the table: cost
(`bal_cost.py`), Levenberg-Marquardt steps with the points eliminated (`bal_schur.py`), no
marginalization.
`bal_problem.py` has the problem and the camera model, `bal_file.py` reads and writes files,
`bal_policy.py` has the settings, `bal_solution.py` the solution.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "BalPolicy",
    "BalSolution",
    "adjust_bundle",
    "is_bal",
    "read_bal",
]

if TYPE_CHECKING:
    from slam_graph.bundle_adjustment.bal_file import is_bal, read_bal
    from slam_graph.bundle_adjustment.bal_policy import BalPolicy
    from slam_graph.bundle_adjustment.bal_solution import BalSolution
    from slam_graph.bundle_adjustment.bal_solve import adjust_bundle
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "bal_file": (
                "is_bal",
                "read_bal",
            ),
            "bal_policy": ("BalPolicy",),
            "bal_solution": ("BalSolution",),
            "bal_solve": ("adjust_bundle",),
        },
    )
