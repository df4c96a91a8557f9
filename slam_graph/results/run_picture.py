# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a run: its paths from above and from the side, and errors and ±3σ over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph import evaluation
from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.geometry import AlignmentMode, Similarity, StateHistory, Trajectory, interpolate

if TYPE_CHECKING:
    import gtsam

    from slam_graph.backend import FinalBa
    from slam_graph.visualization import Panel, Picture

ALIGNED_IN = {
    "none": "not aligned",
    "yaw": "aligned in yaw and position",
    "se3": "aligned in rotation and position",
    "sim3": "aligned in rotation, position and scale",
}
"""What the alignments of runs mean."""

CAUSAL, SMOOTHED, LOOPS_CLOSED, IN_MAP = "causal", "smoothed", "loops closed", "in the map"
_TRUTH = "ground truth"

_TRUTH_ELSEWHERE = "groundtruth_elsewhere"
"""Warning: the ground truth shares no time with the run."""

_AXES = ("x [m]", "y [m]", "z [m]", "yaw [deg]")
_COLUMNS = ("AAAAABBB", "CDEF")
_WIDTHS_INCHES = (5.0, 5.8)
_HEIGHT_INCHES = 6.6

_POINTS_REACH = 0.4
"""Features are drawn as far from the path as this part of its largest extent."""


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Poses with their covariances.

    Attributes:
        trajectory: N poses.
        covariances: (N, 6, 6) rotation before position, body frame; NaN where unknown.
    """

    trajectory: Trajectory
    covariances: FloatArray

    @staticmethod
    def of_sigmas(trajectory: Trajectory, sigmas: FloatArray) -> PoseEstimate:
        """With standard deviations (N, 15 or more) alone, in the order of `NavState.COMPONENTS`."""
        return PoseEstimate(trajectory, sigmas[:, :6, None] ** 2 * np.eye(6))

    @staticmethod
    def of_history(history: StateHistory) -> PoseEstimate:
        """The poses of all states."""
        return PoseEstimate(history.trajectory(), history.pose_covariances())

    def moved(self, similarity: Similarity) -> PoseEstimate:
        """The same in another world; covariances are in the body, in the units of that world."""
        covariances = _in_units(self.covariances, np.array([[similarity.scale]]))
        return PoseEstimate(similarity.apply(self.trajectory), covariances)

    def at_camera(self, body_T_camera: gtsam.Pose3) -> PoseEstimate:
        """The poses of a camera on the body."""
        by_body = body_T_camera.inverse().AdjointMap()
        covariances = by_body @ self.covariances @ by_body.T
        return PoseEstimate(self.trajectory.mounted(body_T_camera), covariances)

    def world_sigmas(self) -> FloatArray:
        """(N, 4) standard deviations of x, y, z [m] and yaw [deg], in the axes of the world."""
        R = Rotation.from_quat(self.trajectory.quaternions).as_matrix()
        position = np.einsum("nij,njk,nik->ni", R, self.covariances[:, 3:, 3:], R)
        up = R[:, 2, :]
        yaw = np.einsum("nj,njk,nk->n", up, self.covariances[:, :3, :3], up)
        sigmas = np.sqrt(np.maximum(np.column_stack([position, yaw]), 0.0))
        return np.asarray(sigmas * (1.0, 1.0, 1.0, np.degrees(1.0)))


def _in_units(covariances: FloatArray, scales: FloatArray) -> FloatArray:
    """Covariances (N, 6, 6) of poses, rotation first, with lengths times scales (N or 1, 1)."""
    units = np.hstack([np.ones((len(scales), 3)), np.repeat(scales, 3, axis=1)])
    return np.asarray(units[:, :, None] * covariances * units[:, None, :])


@dataclass(frozen=True, eq=False)
class RunView:
    """What the picture of a run shows, in one world: that of the truth, if there is one.

    Attributes:
        estimates: by their names.
        paths: other trajectories, by their names.
        truth: ground truth, or None.
        points: (P, 3) features.
        start_ns: where time begins.
        path_breaks_ns: times between the worlds of the paths, after loop closure.
    """

    estimates: Mapping[str, PoseEstimate]
    paths: Mapping[str, Trajectory]
    truth: Trajectory | None
    points: FloatArray
    start_ns: int
    path_breaks_ns: Sequence[int] = ()

    def moved(self, similarity: Similarity) -> RunView:
        """All but the truth in another world."""
        points = similarity.scale * self.points @ similarity.rotation.T + similarity.translation
        return replace(
            self,
            estimates={name: own.moved(similarity) for name, own in self.estimates.items()},
            paths={name: similarity.apply(path) for name, path in self.paths.items()},
            points=points,
        )

    def at_camera(self, body_T_camera: gtsam.Pose3) -> RunView:
        """The same of a camera on the body."""
        return replace(
            self,
            estimates={name: own.at_camera(body_T_camera) for name, own in self.estimates.items()},
            paths={name: path.mounted(body_T_camera) for name, path in self.paths.items()},
            truth=None if self.truth is None else self.truth.mounted(body_T_camera),
        )

    def aligned(self, mode: AlignmentMode = "yaw", breaks_ns: Sequence[int] = ()) -> RunView:
        """In the world of the truth, by the alignment that fits the best path over its whole.

        The covariances stay relative to the first state of each world.

        Args:
            mode: `yaw` and translation; `se3` where gravity was not measured.
            breaks_ns: times between worlds. Each is aligned by itself, and so are those that are
                left in the paths; of points it is not known in which world they are.
        """
        if self.truth is None:
            return self
        best = self.estimates.get(SMOOTHED, self.estimates[CAUSAL]).trajectory
        try:
            onto = evaluation.ape(self.truth, best, alignment=mode, breaks_ns=breaks_ns).alignment
        except DataError:  # no common time, or what never moves determines no yaw
            return self
        if not len(breaks_ns):
            return self.moved(onto.first)
        estimates, paths = {}, {}
        for name, own in self.estimates.items():
            stamps_ns = own.trajectory.stamps_ns
            known, scales = onto.known(stamps_ns), onto.scales(stamps_ns)
            covariances = _in_units(own.covariances[known], scales[known, None])
            places = np.diagonal(own.covariances[known, 3:, 3:], axis1=1, axis2=2)
            covariances[~onto.placed(places)] = np.nan  # of the worlds to one another
            estimates[name] = PoseEstimate(onto.apply(own.trajectory), covariances)
        for name, path in self.paths.items():
            with suppress(DataError):
                left = evaluation.ape(
                    self.truth, path, alignment=mode, breaks_ns=self.path_breaks_ns
                )
                paths[name] = left.alignment.apply(path)
        return replace(self, estimates=estimates, paths=paths, points=np.zeros((0, 3)))


def with_path_in_map(
    view: RunView, path: Trajectory | None, located: Mapping[str, Any] | None = None
) -> RunView:
    """The view with a path in the world of a map, aligned by itself in what nothing measured there.

    Args:
        view: in the world of the truth if there is one.
        path: in the world of the map; None where there is no map.
        located: what `metrics.json` says of it.
    """
    reference = view.truth
    if reference is None:
        reference = view.estimates.get(SMOOTHED, view.estimates[CAUSAL]).trajectory
    if path is None or not len(path):
        return view
    with suppress(DataError):  # no common time, or what never moves determines no yaw
        there, own = evaluation.synchronize(reference, path)
        mode = _alignment_in_map(located)
        onto = Similarity.of_positions(there.positions, own.positions, mode)
        return replace(view, paths={**view.paths, IN_MAP: onto.apply(path)})
    return view


def _alignment_in_map(located: Mapping[str, Any] | None) -> AlignmentMode:
    """The alignment of what nothing measured of the world of a map; earlier runs do not say it."""
    mode: AlignmentMode = (located or {}).get("alignment", "yaw")
    return mode


def with_covariances_after_alignment(
    view: RunView,
    histories: Mapping[str, StateHistory],
    of_truth: bool,
    final_ba: FinalBa | None,
    breaks_ns: Sequence[int] = (),
) -> RunView:
    """The view in the world of the truth, with the covariances of what the alignment leaves.

    Args:
        view: in the world of the run.
        histories: states of the estimates, by the names of these.
        of_truth: whether the estimate lives in the world of the truth already.
        final_ba: the smoothed trajectory, by which the run is aligned.
        breaks_ns: times between worlds.
    """
    if view.truth is None:
        return view
    camera, free = histories[CAUSAL].scaled_camera, histories[CAUSAL].free
    if camera is not None:  # its path is scaled, and not that of the body
        return view.at_camera(camera).aligned(free, breaks_ns)
    if breaks_ns:
        return view.aligned(free, breaks_ns)
    if of_truth:
        return view
    estimates = {}
    similarity = None
    for name, history in histories.items():
        with suppress(DataError):
            judged, alignment = evaluation.nees_of_run(view.truth, history, False, final_ba)
            if alignment == "yaw":
                trajectory = history.trajectory()
                covariances = np.full((len(trajectory), 6, 6), np.nan)
                rows = np.searchsorted(trajectory.stamps_ns, judged.stamps_ns)
                covariances[rows] = judged.covariances
                mapped = judged.similarity.apply(trajectory)
                estimates[name] = PoseEstimate(mapped, covariances)
                similarity = judged.similarity
    if similarity is None:
        return view.aligned(free)
    moved = view.moved(similarity)
    return replace(moved, estimates={**moved.estimates, **estimates})


def run_figure(view: RunView, metrics: Mapping[str, Any]) -> Picture:
    """Draw a run.

    Args:
        view: what to draw.
        metrics: the content of `metrics.json`, for the title.
    """
    from slam_graph.visualization import panel_figure

    panels = [_path_panel(view, 1, "from above"), _path_panel(view, 2, "from the side")]
    panels += _series_panels(view)
    return panel_figure(_title(metrics), panels, _COLUMNS, _WIDTHS_INCHES, _HEIGHT_INCHES)


def _path_panel(view: RunView, axis: int, title: str) -> Panel:
    """All paths over x and another axis of the world."""
    from slam_graph.visualization import Panel

    paths = {} if view.truth is None else {_TRUTH: view.truth}
    paths |= {name: estimate.trajectory for name, estimate in view.estimates.items()}
    paths |= view.paths
    curves = {
        name: (path.positions[:, 0], path.positions[:, axis])
        for name, path in paths.items()
        if len(path)
    }
    dots = _near(view.points, [path.positions for path in paths.values() if len(path)])
    return Panel(
        "x [m]",
        f"{'xyz'[axis]} [m]",
        curves,
        "path",
        dots=dots[:, [0, axis]] if len(dots) else None,
        title=title,
    )


def _near(points: FloatArray, paths: list[FloatArray]) -> FloatArray:
    """The points that are not far from the paths: a few wrong ones would make these small."""
    if not paths or not len(points):
        return np.zeros((0, 3))
    positions = np.concatenate(paths)
    low, high = positions.min(axis=0), positions.max(axis=0)
    reach = _POINTS_REACH * float((high - low).max())
    inside = ((points > low - reach) & (points < high + reach)).all(axis=1)
    return np.asarray(points[inside])


def _series_panels(view: RunView) -> list[Panel]:
    """Errors of position and yaw, or without a truth what smoothing changed, in ±3σ."""
    from slam_graph.visualization import Panel

    lines: dict[str, tuple[FloatArray, FloatArray]] = {}
    sigmas: dict[str, tuple[FloatArray, FloatArray]] = {}
    for name, estimate in view.estimates.items():
        if not len(estimate.trajectory):
            continue
        sigmas[name] = (_seconds(view, estimate.trajectory), 3.0 * estimate.world_sigmas())
    paths = {name: estimate.trajectory for name, estimate in view.estimates.items()}
    for name, path in (paths | dict(view.paths)).items():
        if view.truth is not None and len(path):
            with suppress(DataError):
                true, own = evaluation.synchronize(view.truth, path)
                lines[name] = (_seconds(view, own), _differences(own, true))
    if view.truth is None and SMOOTHED in sigmas:
        causal, smoothed = (view.estimates[name].trajectory for name in (CAUSAL, SMOOTHED))
        reference, valid = interpolate(smoothed, causal.stamps_ns)
        own = causal.select(valid)
        lines[f"{CAUSAL} − {SMOOTHED}"] = (_seconds(view, own), _differences(own, reference))
    title = "errors in the axes of the world, and ±3σ"
    if view.truth is None:
        changed = ", and what smoothing changed" if SMOOTHED in sigmas else ""
        title = f"±3σ in the axes of the world{changed}"
    return [
        Panel(
            "time [s]",
            axis,
            {name: (x, values[:, k]) for name, (x, values) in lines.items()},
            "errors",
            bounds={name: (x, values[:, k]) for name, (x, values) in sigmas.items()},
            title=title if k == 0 else "",
        )
        for k, axis in enumerate(_AXES)
    ]


def _seconds(view: RunView, trajectory: Trajectory) -> FloatArray:
    return np.asarray((trajectory.stamps_ns - view.start_ns) * 1e-9)


def _differences(estimate: Trajectory, reference: Trajectory) -> FloatArray:
    """(N, 4) estimate less reference at the same times: x, y, z [m] and yaw [deg], world axes."""
    turned = Rotation.from_quat(estimate.quaternions) * (
        Rotation.from_quat(reference.quaternions).inv()
    )
    yaw = np.degrees(turned.as_rotvec()[:, 2])
    return np.column_stack([estimate.positions - reference.positions, yaw])


def of_worlds(metrics: Mapping[str, Any]) -> str:
    """What is to be added to the name of an alignment, where a run is in several worlds."""
    worlds = len(metrics["extent"].get("world_breaks_ns", [])) + 1
    return f", each of {worlds} worlds by itself" if worlds > 1 else ""


def _no_errors(metrics: Mapping[str, Any]) -> str:
    """Why there are no errors."""
    if metrics["warnings"].get(_TRUTH_ELSEWHERE):
        return "the ground truth shares no time with the run"
    return "no ground truth" if metrics["accuracy"] is None else "no errors against the truth"


def _title(metrics: Mapping[str, Any]) -> str:
    """What was run, how it ended, and the root mean square errors where there is a truth."""
    cameras = metrics["cameras"]
    ending = "" if metrics["status"] == "ok" else f"  ·  {metrics['status']}"
    lines = [
        f"{metrics['dataset']['name']}  ·  {metrics['algorithm']}, "
        f"{cameras} camera{'' if cameras == 1 else 's'}{ending}"
    ]
    given = metrics["extent"].get("start_was_given", False)
    mode = metrics["extent"].get("alignment", "none" if given else "yaw")
    loops, located = metrics["loop_closure"] or {}, metrics["localization"] or {}
    tables = {
        CAUSAL: (metrics["accuracy"], mode),
        SMOOTHED: ((metrics["final_ba"] or {}).get("accuracy"), mode),
        LOOPS_CLOSED: (loops["accuracy"] if loops.get("accepted") else None, mode),
        IN_MAP: (located.get("accuracy"), _alignment_in_map(located)),
    }
    errors = [
        f"{name} {ate['translation_m']['rmse']:.3f} m, {ate['rotation_deg']['rmse']:.2f}°"
        + (" (aligned)" if alignment != mode else "")
        for name, (table, alignment) in tables.items()
        if (ate := ((table or {}).get(alignment) or {}).get("ate")) is not None
    ]
    if errors:
        how = ALIGNED_IN[mode] + of_worlds(metrics)
        lines.append(f"RMSE ({how}): {'  ·  '.join(errors)}")
    elif metrics["extent"]["estimated_frames"]:
        lengths = "" if metrics["extent"].get("scale") != "unknown" else "; lengths up to scale"
        lines.append(f"{_no_errors(metrics)}; ±3σ is relative to the first state{lengths}")
    else:
        lines.append(metrics["message"] or "no estimate")
    return "\n".join(lines)
