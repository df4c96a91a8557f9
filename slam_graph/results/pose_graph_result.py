# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""All that an optimisation of a pose graph found out, and its files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.config import dump_yaml
from slam_graph.geometry import tum_lines
from slam_graph.pose_graph import (
    Certificate,
    PoseGraphPolicy,
    PoseGraphSolution,
    Poses,
    along_tree,
    chi2_of_edges,
    chi2_table,
    g2o_lines,
)
from slam_graph.results.metrics import SCHEMA_VERSION, Table, finite, versions
from slam_graph.results.result_files import ResultFolder, appearing


@dataclass(eq=False, repr=False)
class PoseGraphResult:
    """What an optimisation found out.

    Attributes:
        policy: how it was done.
        solution: the estimates.
        certificate: whether they are the global optimum, if that was asked for.
        covariances: (N, k, k) of all poses, if they were asked for.
        seconds: wall time of each part.
        warnings: counted faults and repairs.
    """

    policy: PoseGraphPolicy
    solution: PoseGraphSolution
    certificate: Certificate | None = None
    covariances: FloatArray | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: Counter[str] = field(default_factory=Counter)

    def __repr__(self) -> str:
        graph, minimum = self.solution.graph, self.solution.minimum
        return (
            f"PoseGraphResult({graph.name}: {len(graph.keys)} poses, {len(graph.edges)} edges, "
            f"cost {minimum.cost:.6g}, {'' if minimum.converged else 'not '}converged)"
        )

    @cached_property
    def before(self) -> Poses:
        """The poses before the optimisation: those of the file, or odometry."""
        graph = self.solution.graph
        return along_tree(graph) if graph.estimates is None else graph.estimates

    @cached_property
    def metrics(self) -> Table:
        """The content of `metrics.json`; JSON can hold every value of it."""
        solution, graph = self.solution, self.solution.graph
        chi2 = {
            "before": chi2_table(graph, self.before),
            "start": chi2_table(graph, solution.start, solution.weights),
            "after": chi2_table(graph, solution.poses, solution.weights),
        }
        table: Table = finite(
            {
                "schema_version": SCHEMA_VERSION,
                "graph": {
                    "name": graph.name,
                    "dimension": graph.dimension,
                    "poses": len(graph.keys),
                    "edges": len(graph.edges),
                    "loop_closures": int(np.count_nonzero(~graph.is_odometry)),
                    "connected_parts": len(graph.anchors),
                },
                "method": self.policy.gauss_newton.method,
                "robust": self.policy.cost.robust,
                "cost": solution.minimum.cost,
                "steps": solution.minimum.steps,
                "converged": solution.minimum.converged,
                "rejected_edges": int(np.count_nonzero(solution.weights < 0.5)),
                "chi2": chi2,
                "certificate": self._certificate(),
                "timing_s": self.seconds,
                "warnings": dict(sorted(self.warnings.items())),
                "versions": versions(),
            }
        )
        return table

    def _certificate(self) -> Table | None:
        if self.certificate is None:
            return None
        found = self.certificate
        table = {name: getattr(found, name) for name in found.__slots__ if name != "poses"}
        return {**table, "gap": found.gap}

    def save(self, folder: Path | str) -> list[Path]:
        """Write all files into a folder, each whole or not at all.

        Args:
            folder: made if it is missing.

        Returns:
            The files, in the order in which they were written.
        """
        solution, graph = self.solution, self.solution.graph
        files = ResultFolder(folder)
        files.text("optimized.g2o", g2o_lines(graph, solution.poses))
        files.text("trajectory.tum", tum_lines(graph.trajectory(solution.poses)))
        files.text("edges.csv", self._edge_lines())
        files.text("config.yaml", [dump_yaml(self.policy)])
        files.json("metrics.json", self.metrics)
        if self.covariances is not None:
            files.text("covariances.csv", self._covariance_lines(self.covariances))
        if self.certificate is not None:
            files.text("certified.g2o", g2o_lines(graph, self.certificate.poses))
        self._draw(files.path("pose_graph.png"))
        return files.files

    def _edge_lines(self) -> Iterator[str]:
        """Edges as CSV: ids, χ² in GTSAM's convention, weight."""
        graph, solution = self.solution.graph, self.solution
        squared = chi2_of_edges(graph, solution.poses)
        yield "from,to,chi2,weight\n"
        rows = zip(
            graph.keys[graph.edges].tolist(),
            squared.tolist(),
            solution.weights.tolist(),
            strict=True,
        )
        for (i, j), value, weight in rows:
            yield f"{i},{j},{value:.9g},{weight:.6g}\n"

    def _covariance_lines(self, covariances: FloatArray) -> Iterator[str]:
        """Covariances as CSV: id, and the upper triangle by rows."""
        names = (
            ("x", "y", "theta") if covariances.shape[1] == 3 else ("x", "y", "z", "rx", "ry", "rz")
        )
        above = np.triu_indices(len(names))
        yield (
            ",".join(["id", *(f"{names[i]}_{names[j]}" for i, j in zip(*above, strict=True))])
            + "\n"
        )
        entries = covariances[:, *above].tolist()
        for key, row in zip(self.solution.graph.keys.tolist(), entries, strict=True):
            yield ",".join([str(key), *(f"{value:.9g}" for value in row)]) + "\n"

    def _draw(self, path: Path) -> None:
        from slam_graph.visualization import plot_pose_graph

        graph, weights = self.solution.graph, self.solution.weights
        title = f"{graph.name}: {len(graph.keys)} poses, {len(graph.edges)} edges"
        with appearing(path) as partial:
            plot_pose_graph(
                partial,
                title,
                self.before.translations,
                self.solution.poses.translations,
                graph.edges,
                weights < 0.5,
            )
