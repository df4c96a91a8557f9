# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run and its ground truth for Rerun: where the truth is in the world of the run, and errors.

Errors are in metres, as in `metrics.json`: of one camera whose scale nothing measured they are
those of the camera, as it is its path that is known up to a scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.errors import DataError
from slam_graph.evaluation import ape, synchronize
from slam_graph.geometry import AlignmentMode, Similarity, Trajectory

if TYPE_CHECKING:
    from slam_graph.visualization.rerun_outcome import FinishedRun


def placed_truth(estimate: Trajectory, truth: Trajectory, alignment: AlignmentMode) -> Similarity:
    """The map from the world of the truth to that of an estimate, fitted over what both share.

    Raises:
        DataError: if the two share no time, or do not determine the map.
    """
    if alignment == "none":
        return Similarity.identity()
    true, own = synchronize(truth, estimate)
    return Similarity.of_positions(own.positions, true.positions, alignment)


@dataclass(frozen=True, eq=False)
class JudgedRun:
    """The paths of a run that errors are taken of.

    Attributes:
        truth: the true path.
        causal: the causal estimate.
        best: the smoothed one if there is one, else the causal one.
        sigmas: (N, 6) standard deviations of rotation and position of the causal poses, in their
            axes and in units of the estimate.
        alignment: with the truth.
        breaks_ns: times between worlds of the run, each of which is aligned by itself.
        closed: the path after loop closure, where that has joined some of the worlds.
        closed_breaks_ns: times between those that are left.
        camera: body_T_camera, where these are the paths of a camera instead of the body.
    """

    truth: Trajectory
    causal: Trajectory
    best: Trajectory
    sigmas: FloatArray
    alignment: AlignmentMode
    breaks_ns: list[int]
    closed: Trajectory | None = None
    closed_breaks_ns: Sequence[int] = ()
    camera: gtsam.Pose3 | None = None

    @staticmethod
    def of(run: FinishedRun, truth: Trajectory) -> JudgedRun:
        """Those of a run."""
        extent, sigmas, causal = run.metrics["extent"], run.sigmas[:, :6], run.trajectory
        best, camera = causal if run.smoothed is None else run.smoothed, None
        breaks_ns = extent.get("world_breaks_ns", [])
        left_ns = (run.metrics.get("loop_closure") or {}).get("world_breaks_ns", breaks_ns)
        closed = None if left_ns == breaks_ns else run.loop_closed
        if extent.get("scale") == "unknown":
            camera = run.rig.cameras[0].body_T_camera
            truth, causal, best = (path.mounted(camera) for path in (truth, causal, best))
            closed = None if closed is None else closed.mounted(camera)
            sigmas = _mounted_sigmas(sigmas, camera)
        mode = extent.get("alignment", "yaw")  # earlier runs do not say it
        return JudgedRun(truth, causal, best, sigmas, mode, breaks_ns, closed, left_ns, camera)

    def true_paths(self, truth: Trajectory) -> list[FloatArray]:
        """(M, 3) the true positions of the body in each world of the run, and of the closed path.

        Raises:
            DataError: if truth and estimate share no time, or do not determine the maps.
        """
        onto = ape(self.truth, self.best, alignment=self.alignment, breaks_ns=self.breaks_ns)
        paths = onto.alignment.to_estimate(truth)
        if self.closed is not None:
            left_ns = self.closed_breaks_ns
            with suppress(DataError):
                onto = ape(self.truth, self.closed, alignment=self.alignment, breaks_ns=left_ns)
                paths += onto.alignment.to_estimate(truth)
        return paths

    def errors(self) -> tuple[IntArray, dict[str, tuple[FloatArray, FloatArray]]]:
        """Times (K,), and errors (K, 3) with standard deviations (K, 3) by the plots.

        Those of position are in metres, of orientation in degrees, in the axes of the estimate.

        Raises:
            DataError: if truth and estimate share no time, or do not determine the maps.
        """
        found = ape(self.truth, self.causal, alignment=self.alignment, breaks_ns=self.breaks_ns)
        true, own = synchronize(self.truth, found.alignment.apply(self.causal))
        sigmas = self.sigmas[np.searchsorted(self.causal.stamps_ns, own.stamps_ns)]
        back = Rotation.from_quat(own.quaternions).inv()
        turned = (back * Rotation.from_quat(true.quaternions)).as_rotvec()
        metres = found.alignment.scales(own.stamps_ns)[:, None]
        if self.breaks_ns:  # they may be those of the worlds to one another
            sigmas[~found.alignment.placed(sigmas[:, 3:] ** 2)] = np.nan
        rows: dict[str, tuple[FloatArray, Any]] = {
            "error/position": (
                back.apply(true.positions - own.positions),
                metres * sigmas[:, 3:],
            ),
            "error/orientation": (np.rad2deg(turned), np.rad2deg(sigmas[:, :3])),
        }
        return own.stamps_ns, rows


def _mounted_sigmas(sigmas: FloatArray, body_T_part: gtsam.Pose3) -> FloatArray:
    """Standard deviations (N, 6) of rotation and position of a part of the body, in its axes.

    Those of the body are taken as independent: files do not say more.
    """
    by_body = body_T_part.inverse().AdjointMap()
    return np.asarray(np.sqrt(sigmas**2 @ (by_body**2).T))
