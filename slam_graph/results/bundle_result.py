# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""All that a bundle adjustment of a BAL problem found out, and its files."""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.bundle_adjustment import (
    BalEstimates,
    BalPolicy,
    BalSolution,
    bal_lines,
    reprojection_errors,
)
from slam_graph.config import dump_yaml
from slam_graph.results.metrics import SCHEMA_VERSION, Table, finite, versions
from slam_graph.results.point_map import write_ply
from slam_graph.results.result_files import ResultFolder, appearing, write_text


@dataclass(eq=False, repr=False)
class BalResult:
    """What a bundle adjustment found out.

    Attributes:
        policy: how it was done.
        solution: the estimates.
        seconds: wall time of each part.
        warnings: counted faults and repairs.
    """

    policy: BalPolicy
    solution: BalSolution
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: Counter[str] = field(default_factory=Counter)

    def __repr__(self) -> str:
        part, minimum = self.solution.part.problem, self.solution.minimum
        return (
            f"{type(self).__name__}({self.name}: {part.cameras} cameras, {part.points} points, "
            f"cost {minimum.cost:.6g}, {'' if minimum.converged else 'not '}converged)"
        )

    @property
    def name(self) -> str:
        """The name of the problem."""
        return self.solution.problem.name

    @cached_property
    def after(self) -> BalEstimates:
        """The estimates of the cameras and points that were in the cost."""
        return self.solution.estimates.select(self.solution.part.cameras, self.solution.part.points)

    @cached_property
    def errors_px(self) -> dict[str, FloatArray]:
        """Reprojection errors of the observations in the cost: (N,) before and after."""
        problem = self.solution.part.problem
        return {
            "before": reprojection_errors(problem, problem.estimates),
            "after": reprojection_errors(problem, self.after),
        }

    @cached_property
    def metrics(self) -> Table:
        """The content of `metrics.json`; JSON can hold every value of it."""
        problem, part, minimum = self.solution.problem, self.solution.part, self.solution.minimum
        table: Table = finite(
            {
                "schema_version": SCHEMA_VERSION,
                "problem": {
                    "name": problem.name,
                    "cameras": problem.cameras,
                    "points": problem.points,
                    "observations": len(problem.camera),
                    "used_cameras": part.problem.cameras,
                    "used_points": part.problem.points,
                    "used_observations": len(part.problem.camera),
                    "groups": int(part.groups.max()) + 1,
                },
                "intrinsics": self.policy.cost.intrinsics,
                "robust": self.policy.cost.robust,
                "cost": {"before": minimum.start_cost, "after": minimum.cost},
                "reprojection_px": {
                    stage: {
                        "rmse": float(np.sqrt(np.mean(errors**2))),
                        "median": float(np.median(errors)),
                        "max": float(np.max(errors)),
                    }
                    for stage, errors in self.errors_px.items()
                },
                "steps": minimum.steps,
                "rejected_steps": minimum.rejected,
                "converged": minimum.converged,
                "timing_s": self.seconds,
                "warnings": dict(sorted(self.warnings.items())),
                "versions": versions(),
            }
        )
        return table

    def save(self, folder: Path | str) -> list[Path]:
        """Write all files into a folder, each whole or not at all.

        Args:
            folder: made if it is missing.

        Returns:
            The files, in the order in which they were written.
        """
        files = ResultFolder(folder)
        files.text("optimized.txt", self.lines())
        files.text("config.yaml", [dump_yaml(self.policy)])
        files.json("metrics.json", self.metrics)
        write_ply(files.path("scene.ply"), self.after.points, self.after.centres())
        self._draw(files.path("bundle_adjustment.png"))
        return files.files

    def lines(self) -> Iterable[str]:
        """The whole problem with its estimates, in BAL's format."""
        return bal_lines(self.solution.problem, self.solution.estimates)

    def save_problem(self, path: Path | str) -> None:
        """Write the whole problem with its estimates, compressed if the name ends with `.bz2`."""
        path = Path(path)
        if path.suffix != ".bz2":
            write_text(path, self.lines())
            return
        with appearing(path) as partial:
            partial.write_bytes(bz2.compress("".join(self.lines()).encode("ascii")))

    def _draw(self, path: Path) -> None:
        from slam_graph.visualization import plot_bundle

        part = self.solution.part.problem
        title = f"{self.name}: {part.cameras} cameras, {part.points} points"
        with appearing(path) as partial:
            plot_bundle(partial, title, self.after.points, self.after.centres(), self.errors_px)
