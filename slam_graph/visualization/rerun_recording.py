# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The door to Rerun for the rest of the package: watch a run, show a result, make a picture."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from slam_graph.arrays import FloatArray
from slam_graph.bundle_adjustment import BalSolution
from slam_graph.datasets import Sequence
from slam_graph.maps import SlamMap
from slam_graph.pose_graph import PoseGraphSolution
from slam_graph.sensors import Rig
from slam_graph.visualization.rerun_comparison import ComparedRun, show_comparison
from slam_graph.visualization.rerun_images import ImagesMode
from slam_graph.visualization.rerun_map import show_map
from slam_graph.visualization.rerun_outcome import FinishedRun
from slam_graph.visualization.rerun_problems import show_bundle, show_pose_graph
from slam_graph.visualization.rerun_screenshot import (
    open_recording,
    require_picture,
    save_screenshot,
    send_recording,
    serve_recording,
    stop,
)
from slam_graph.visualization.rerun_stream import RerunMode, RerunStream
from slam_graph.visualization.rerun_viewer import DetailMode, RerunViewer
from slam_graph.visualization.rerun_world import SavedDetails, show_recording, show_saved_run


class RerunRecording:
    """A recording for Rerun; a context manager that completes it.

    Args:
        mode: `save` to a file, `spawn` a window, `connect` to a viewer that is open, or `serve` to
            browsers.
        name: of the recording.
        path: of the file to save; it appears when the recording is closed.
        address: of the viewer to connect to.

    Attributes:
        url: where a browser shows it, if it is served.

    Raises:
        DataError: if no viewer can be shown or reached, or the file cannot be written.
    """

    def __init__(
        self, mode: RerunMode, name: str, path: Path | None = None, address: str | None = None
    ) -> None:
        self._stream = RerunStream(mode, name, path, address)
        self.url = self._stream.url

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
        else:
            self._stream.discard()

    def close(self) -> None:
        """Send what is left; a saved file appears under its name."""
        self._stream.close()

    def discard(self) -> None:
        """End without what was sent; does nothing to a recording that is closed."""
        self._stream.discard()

    def viewer(
        self,
        images: ImagesMode = "all",
        detail: DetailMode = "normal",
        known_map: SlamMap | None = None,
    ) -> RerunViewer:
        """A viewer of a run for the pipeline, which closes the recording.

        Args:
            images: of which frames images are sent.
            detail: `graph` adds the factor graph of every window and its information.
            known_map: the map that the run is located in, if there is one.
        """
        return RerunViewer(self._stream, images, detail, known_map)

    def show_run(
        self,
        run: FinishedRun,
        points: FloatArray,
        timing: Mapping[str, FloatArray],
        by_frame: Mapping[str, Any] | None = None,
        rig: Rig | None = None,
        log: Iterable[str] = (),
        known_map: SlamMap | None = None,
        recording: Sequence | None = None,
        images: bool = True,
    ) -> None:
        """A run that has ended, from what its files hold.

        Args:
            run: trajectories and errors.
            points: (P, 3) its map, m.
            timing: (F,) milliseconds of stages by their names, and `stamp_ns`.
            by_frame: (F,) columns of `frames.csv` by their titles.
            rig: the sensors, if they are known.
            log: lines.
            known_map: the map that it was located in, if it is at hand.
            recording: that was run, if its images or tracks and IMU samples are to be shown.
            images: whether images of the recording are shown.
        """
        of_fixes = recording is not None and run.metrics.get("world", {}).get("of_fixes", False)
        aiding = run.config.backend if of_fixes else None
        details = SavedDetails(
            rig, points, timing, by_frame or {}, log, known_map, recording, images, aiding
        )
        show_saved_run(self._stream, run, details)

    def show_map(self, content: SlamMap) -> None:
        """A map."""
        show_map(self._stream, content)

    def show_recording(self, sequence: Sequence, images: bool = True) -> None:
        """A recording as it is; images only if wanted."""
        show_recording(self._stream, sequence, images)

    def show_pose_graph(
        self, solution: PoseGraphSolution, titles: Mapping[str, str] | None = None
    ) -> None:
        """A pose graph before and after its optimisation.

        Args:
            solution: the graph with its poses.
            titles: what `before` and `after` are, or one of the two, which is then shown alone.
        """
        show_pose_graph(self._stream, solution, titles)

    def show_bundle(self, solution: BalSolution) -> None:
        """A bundle adjustment before and after."""
        show_bundle(self._stream, solution)

    def show_comparison(
        self,
        runs: Mapping[str, Mapping[str, FloatArray]],
        true_paths: Mapping[str, FloatArray],
        note: str = "",
    ) -> None:
        """Several runs over one another.

        Args:
            runs: for each name `path` (S, 3) of all states in m, `time_s` (N,), and errors (N,) at
                these times by the titles of their plots.
            true_paths: (M, 3) in the same world by their labels.
            note: what else is to be known of the errors.
        """
        compared = [
            ComparedRun(
                name,
                columns["path"],
                columns["time_s"],
                {title: c for title, c in columns.items() if title not in ("path", "time_s")},
            )
            for name, columns in runs.items()
        ]
        show_comparison(self._stream, compared, true_paths, note)

    @staticmethod
    def screenshot(recording: Path, picture: Path, size: tuple[int, int] = (1600, 1000)) -> None:
        """A picture of how a saved recording opens; see `save_screenshot` for arguments."""
        save_screenshot(recording, picture, size)

    @staticmethod
    def check_picture(picture: Path) -> None:
        """Make sure that a screenshot can be written; see `require_picture` for errors."""
        require_picture(picture)

    @staticmethod
    def open(recording: Path) -> None:
        """Open a saved recording in a window, and go on; see `open_recording` for errors."""
        open_recording(recording)

    @staticmethod
    def send(recording: Path, address: str | None = None) -> None:
        """Send a saved recording to a viewer that is open; see `send_recording` for errors."""
        send_recording(recording, address)

    @staticmethod
    @contextmanager
    def serve(recording: Path) -> Iterator[str]:
        """Serve a saved recording to browsers while the block runs; gives the address to open."""
        server, url = serve_recording(recording)
        try:
            yield url
        finally:
            stop(server)
