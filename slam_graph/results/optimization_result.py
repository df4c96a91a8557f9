# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The results of pose-graph optimisation and bundle adjustment, and their files."""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.bundle_adjustment import BalPolicy, BalSolution
from slam_graph.display import Displayed
from slam_graph.files import Files
from slam_graph.pose_graph import Certificate, PoseGraphPolicy, PoseGraphSolution
from slam_graph.results.folders_written import FoldersWritten
from slam_graph.results.map_output import write_ply
from slam_graph.results.metrics import SCHEMA_VERSION, Table, finite, versions


@dataclass(eq=False, repr=False)
class BalResult(Displayed):
    """What a bundle adjustment found out.

    Attributes:
        policy: how it was done.
        solution: the estimates.
        seconds: wall time of each part.
        warnings: counted faults and repairs.
        folders_written: folders that have files of this result, which stay when it is saved again.
    """

    policy: BalPolicy
    solution: BalSolution
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: Counter[str] = field(default_factory=Counter)
    folders_written: FoldersWritten = field(default_factory=FoldersWritten)

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
                    for stage, errors in self.solution.errors_px.items()
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

        Files of another bundle adjustment in the folder are removed before (`earlier_result.py`).
        `metrics.json` is last; until then it has the status `unfinished`.

        Args:
            folder: made if it is missing.

        Returns:
            The files, in the order in which they were written.

        Raises:
            DataError: if the folder has a result of another kind, or a file cannot be written.
        """
        adjusted, written = self.solution.adjusted, self.folders_written
        with written.complete(Path(folder), "bundle adjustment", self.metrics) as files:
            files.text("problem.txt", self.solution.problem_lines())
            files.text("optimized.txt", self.solution.lines())
            files.text("config.yaml", [self.policy.as_yaml()])
            write_ply(files.path("scene.ply"), adjusted.points, adjusted.centres())
            with files.appearing("bundle_adjustment.png") as partial:
                self.plot().write(partial)
        return files.files

    def save_problem(self, path: Path | str) -> None:
        """Write the whole problem with its estimates, compressed if the name ends with `.bz2`."""
        path = Path(path)
        if path.suffix != ".bz2":
            Files.write_text(path, self.solution.lines())
            return
        with Files.appearing(path) as partial:
            partial.write_bytes(bz2.compress("".join(self.solution.lines()).encode("ascii")))

    def _facts(self) -> dict[str, object]:
        return {"solution": self.solution, "seconds": _seconds_text(self.seconds)}

    def _sketch(self) -> Any:
        return self.plot()

    def plot(self) -> Any:
        """The scene from three sides, and a histogram of the reprojection errors, as a figure."""
        return self.solution.plot()


@dataclass(eq=False, repr=False)
class PoseGraphResult(Displayed):
    """What an optimisation found out.

    Attributes:
        policy: how it was done.
        solution: the estimates.
        certificate: whether they are the global optimum, if that was asked for.
        covariances: (N, k, k) of all poses, if they were asked for.
        seconds: wall time of each part.
        warnings: counted faults and repairs.
        folders_written: folders that have files of this result, which stay when it is saved again.
    """

    policy: PoseGraphPolicy
    solution: PoseGraphSolution
    certificate: Certificate | None = None
    covariances: FloatArray | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: Counter[str] = field(default_factory=Counter)
    folders_written: FoldersWritten = field(default_factory=FoldersWritten)

    def __repr__(self) -> str:
        graph, minimum = self.solution.graph, self.solution.minimum
        return (
            f"PoseGraphResult({graph.name}: {len(graph.keys)} poses, {len(graph.edges)} edges, "
            f"cost {minimum.cost:.6g}, {'' if minimum.converged else 'not '}converged)"
        )

    @cached_property
    def metrics(self) -> Table:
        """The content of `metrics.json`; JSON can hold every value of it."""
        solution, graph = self.solution, self.solution.graph
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
                "chi2": solution.chi2(),
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

        Files of another pose graph in the folder are removed before (`earlier_result.py`).
        `metrics.json` is last; until then it has the status `unfinished`.

        Args:
            folder: made if it is missing.

        Returns:
            The files, in the order in which they were written.

        Raises:
            DataError: if the folder has a result of another kind, or a file cannot be written.
        """
        solution, graph = self.solution, self.solution.graph
        with self.folders_written.complete(Path(folder), "pose graph", self.metrics) as files:
            files.text("optimized.g2o", solution.g2o_lines())
            files.text("trajectory.tum", graph.trajectory(solution.poses).tum_lines())
            files.text("edges.csv", self._edge_lines())
            files.text("config.yaml", [self.policy.as_yaml()])
            if self.covariances is not None:
                files.text("covariances.csv", self._covariance_lines(self.covariances))
            if self.certificate is not None:
                files.text("certified.g2o", solution.g2o_lines(self.certificate.poses))
            with files.appearing("pose_graph.png") as partial:
                self.plot().write(partial)
        return files.files

    def save_problem(self, path: Path | str) -> None:
        """Write the graph with its estimates as a g2o file."""
        Files.write_text(Path(path), self.solution.g2o_lines())

    def _edge_lines(self) -> Iterator[str]:
        """Edges as CSV: ids, χ² in GTSAM's convention, weight."""
        graph, solution = self.solution.graph, self.solution
        squared = solution.chi2_of_edges()
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

    def _facts(self) -> dict[str, object]:
        return {
            "solution": self.solution,
            "certificate": self._certificate(),
            "seconds": _seconds_text(self.seconds),
        }

    def _sketch(self) -> Any:
        return self.plot()

    def plot(self) -> Any:
        """The graph before and after, with its edges, as a figure."""
        return self.solution.plot()


def _seconds_text(seconds: Mapping[str, float]) -> str | None:
    """Wall time of each part."""
    return ", ".join(f"{part} {value:.2f}" for part, value in seconds.items()) or None
