# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The door to Rerun for the rest of the package: watch a run, show a result, make a picture."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

from slam_graph.visualization.rerun_images import ImagesMode
from slam_graph.visualization.rerun_stream import RerunMode, RerunStream
from slam_graph.visualization.rerun_viewer import DetailMode, RerunViewer


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
        self.close()

    def close(self) -> None:
        """Send what is left; a saved file appears under its name."""
        self._stream.close()

    def viewer(self, images: ImagesMode = "all", detail: DetailMode = "normal") -> RerunViewer:
        """A viewer of a run for the pipeline, which closes the recording.

        Args:
            images: of which frames images are sent.
            detail: `graph` adds the factor graph of every window and its information.
        """
        return RerunViewer(self._stream, images, detail)
