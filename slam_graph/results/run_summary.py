# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a result shows of itself: a picture, a table in Jupyter, and the Rerun viewer in a notebook.

The same of a result in memory and of one that was read back.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets import Sequence
from slam_graph.display import Displayed
from slam_graph.errors import DataError, closest
from slam_graph.geometry import Trajectory
from slam_graph.results.run_picture import (
    ALIGNED_IN,
    LOOPS_CLOSED,
    RunView,
    of_worlds,
    run_figure,
)
from slam_graph.results.scene import SceneParts, export_scene
from slam_graph.results.scene_files import (
    SCENE_FORMATS,
    require_models,
    write_colmap,
    write_nerfstudio,
)
from slam_graph.sensors import Rig

if TYPE_CHECKING:
    from slam_graph.maps import SlamMap
    from slam_graph.visualization import Picture


PoseChoice = Literal["best", "causal", "smoothed", "loop"]

_PREFERRED: tuple[PoseChoice, ...] = ("loop", "smoothed", "causal")
"""The better, the earlier."""

_POSES_OF_MAP: dict[str, PoseChoice] = {
    "loop_closed": "loop",
    "smoothed": "smoothed",
    "causal": "causal",
}


class RunSummary(Displayed):
    """Base of the results of a run."""

    metrics: Any  # a table, which the subclasses compute or read

    @property
    @abstractmethod
    def rig(self) -> Rig:
        """The sensors that were used, with the calibration from before the run."""

    @property
    @abstractmethod
    def estimated_rig(self) -> Rig:
        """The calibration at the end: as given, corrected at a start, or estimated online."""

    @property
    @abstractmethod
    def trajectory(self) -> Trajectory:
        """The causal estimate."""

    @property
    @abstractmethod
    def smoothed(self) -> Trajectory | None:
        """The trajectory of the final bundle adjustment, if there is one."""

    @property
    @abstractmethod
    def best_trajectory(self) -> Trajectory:
        """The smoothed trajectory if there is one, else the causal one."""

    @property
    @abstractmethod
    def loop_closed(self) -> Trajectory | None:
        """The best trajectory after loop closure, if loops were to be closed."""

    @property
    @abstractmethod
    def loop_ends_ns(self) -> IntArray:
        """(L, 2) times of the two keyframes of each accepted loop closure."""

    @property
    @abstractmethod
    def points(self) -> FloatArray:
        """(P, 3) last estimates of the features that were in the state, in the world, m."""

    @abstractmethod
    def _view(self) -> RunView:
        """What the picture shows, in the world of the truth if there is one."""

    @abstractmethod
    def _known_map(self) -> SlamMap | None:
        """The map of the run, if there is one."""

    def _paths_of_loops(self) -> dict[str, Trajectory]:
        """The path after loop closure by its name, if loops were accepted."""
        path = self.loop_closed
        return {} if path is None or not len(self.loop_ends_ns) else {LOOPS_CLOSED: path}

    def plot(self) -> Picture:
        """The picture of the run: paths, and errors or what smoothing changed, in ±3σ.

        It is what `trajectory.png` shows, as a matplotlib figure.
        """
        return run_figure(self._view(), self.metrics)

    def show(self, width: int = 950, height: int = 600) -> None:
        """The run in the Rerun viewer, inside the notebook.

        Args:
            width: of the viewer, pixels.
            height: of the viewer, pixels.

        Raises:
            ConfigError: if the viewer for notebooks is not installed.
        """
        view = self._view()
        paths = {name: estimate.trajectory for name, estimate in view.estimates.items()}
        paths |= dict(view.paths)
        self._drawn_by("inline_viewer").show_inline(paths, view.truth, view.points, (width, height))

    def export(
        self,
        folder: Path | str,
        recording: Sequence,
        formats: Iterable[str] = SCENE_FORMATS,
        spacing_m: float = 0.1,
        which: PoseChoice = "best",
    ) -> list[Path]:
        """Write keyframes with their images, and points, for COLMAP or nerfstudio.

        Keyframes are chosen by motion. Of a run that saved a map its keyframes are among them, the
        points are those of the map, and the images have observations of them.

        Args:
            folder: is given `images/`, and for `colmap` a model in `sparse/0/`, for `nerfstudio`
                `transforms.json` and `points.ply`.
            recording: that was run, for its images.
            formats: `colmap`, `nerfstudio`, or both.
            spacing_m: between keyframes; a turn of 0.1 rad makes one too.
            which: poses of the images, as for `exported_poses`.

        Returns:
            The files, without the images.

        Raises:
            DataError: if a format is unknown, there are no images, the formats lack the camera
                model, or the run has no such poses.
        """
        folder, formats = Path(folder), list(formats)
        for name in formats:
            if name not in SCENE_FORMATS:
                raise DataError(f"no format '{name}'; {closest(name, SCENE_FORMATS)}")
        rig = self.estimated_rig
        require_models(rig)
        trajectory = self.exported_poses(which)[1]
        parts = SceneParts(rig, trajectory, self.points, self._known_map(), spacing_m)
        scene = export_scene(parts, recording, folder / "images")
        files = []
        if "colmap" in formats:
            files += write_colmap(folder / "sparse" / "0", scene)
        if "nerfstudio" in formats:
            files += write_nerfstudio(folder, scene)
        return files

    def exported_poses(self, which: PoseChoice = "best") -> tuple[str, Trajectory]:
        """The poses of images that are exported: what they are called, and the trajectory.

        Args:
            which: `causal`, `smoothed`, `loop` (after loop closure), or `best`: those of the map if
                the run saved one, else the last of these that there is.

        Raises:
            DataError: if the run has no such poses, or the points of its map do not fit them.
        """
        found = {"loop": next(iter(self._paths_of_loops().values()), None)}
        found |= {"smoothed": self.smoothed, "causal": self.trajectory}
        known = self._known_map()
        own = None if known is None else _POSES_OF_MAP.get(known.recordings[0].poses)
        if which == "best":
            there: list[PoseChoice] = [name for name in _PREFERRED if found[name] is not None]
            which = there[0] if own is None else own
        elif own is not None and which != own:
            raise DataError(
                f"the map of the run was made of its poses '{own}', and its points do not fit "
                f"'{which}': give --which {own}, or export a run without --save-map"
            )
        trajectory = found[which]
        if trajectory is None:
            raise DataError(f"the run has no trajectory of the kind '{which}'")
        return which, trajectory

    def _facts(self) -> dict[str, object]:
        metrics = self.metrics
        data, extent, timing = metrics["dataset"], metrics["extent"], metrics["timing"]
        loops = metrics["loop_closure"] or {}
        mode = extent.get("unmeasured", "yaw")
        cameras = f"{metrics['cameras']} camera{'' if metrics['cameras'] == 1 else 's'}"
        return {
            "recording": f"{data['name']} ({data['format']}, {data['content']}, {cameras})",
            "algorithm": f"{metrics['algorithm']}, seed {metrics['seed']}",
            "status": f"{metrics['status']}. {metrics['message']}".rstrip(". "),
            "estimated": f"{extent['estimated_frames']} of {extent['frames']} frames, "
            f"{extent['coverage']:.1%} of {extent['recorded_s']:.1f} s",
            "scale": "unknown: lengths are up to scale"
            if extent.get("scale") == "unknown"
            else None,
            "worlds": of_worlds(metrics).removeprefix(", ") or None,
            "error": _errors(metrics["accuracy"], mode),
            "error, smoothed": _errors((metrics["final_ba"] or {}).get("accuracy"), mode),
            "error, loops closed": _errors(loops["accuracy"], mode)
            if loops.get("accepted")
            else None,
            "speed": (
                None
                if timing["real_time_factor"] is None
                else f"{timing['frames_per_s']:.0f} frames/s, "
                f"{timing['real_time_factor']:.1f} x real time"
            ),
            "warnings": ", ".join(f"{k} {n}" for k, n in metrics["warnings"].items()) or None,
        }

    def _sketch(self) -> Any:
        return self.plot()


def _errors(accuracy: dict[str, Any] | None, mode: str) -> str | None:
    """Root mean square errors after an alignment."""
    table = (accuracy or {}).get(mode, {}).get("ate")
    if table is None:
        return None
    return (
        f"{table['translation_m']['rmse']:.4f} m, {table['rotation_deg']['rmse']:.3f}° RMS, "
        f"{ALIGNED_IN[mode]}"
    )
