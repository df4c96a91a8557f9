# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The options `--rerun…`: how a run is watched."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from slam_graph.cli.options import RerunMode, refuse_ignored

if TYPE_CHECKING:
    from slam_graph.maps import SlamMap
    from slam_graph.visualization import RerunRecording


@dataclass
class Watching:
    """What the options say.

    Attributes:
        mode: whether, and where the run is seen.
        images: of which frames images are sent.
        detail: `graph` adds the factor graph of every window.
        address: of the viewer to connect to; None means the usual one.

    Raises:
        ConfigError: if an option would change nothing.
    """

    mode: RerunMode = "off"
    images: Literal["none", "keyframes", "all"] = "all"
    detail: Literal["normal", "graph"] = "normal"
    address: str | None = None

    def __post_init__(self) -> None:
        if self.mode != "connect":
            refuse_ignored({"--rerun-address": self.address}, "is for --rerun connect")
        if self.mode == "off":
            refuse_ignored({"--rerun-detail graph": self.detail == "graph"}, "needs --rerun")

    @contextmanager
    def viewer(self, path: Path, name: str, known_map: SlamMap | None = None) -> Iterator[Any]:
        """The viewer that was asked for, or None, for the time of a run.

        The run closes it. If it ended before it was shown, nothing of the viewer is left: no part
        of a file, and no server.

        Args:
            path: of the file, if the run is saved.
            name: of the recording.
            known_map: the map that the run is located in, if there is one.

        Raises:
            DataError: if it cannot be shown or reached.
        """
        if self.mode == "off":
            yield None
            return
        recording = self.recording(path, name)
        try:
            yield recording.viewer(self.images, self.detail, known_map)
        finally:
            recording.discard()

    def show(self, folder: Path, name: str, log: Callable[[RerunRecording], None]) -> list[Path]:
        """Show a result, if that was asked for.

        Args:
            folder: of the result; a recording is saved there.
            name: of the recording.
            log: logs the result.

        Returns:
            The file that was written, if one was.
        """
        if self.mode == "off":
            return []
        path = folder / "recording.rrd"
        with self.recording(path, name) as recording:
            log(recording)
        return [path] if self.mode == "save" else []

    def recording(self, path: Path, name: str) -> RerunRecording:
        """The recording that was asked for; arguments and errors as for `viewer`."""
        from slam_graph.visualization import RerunRecording

        assert self.mode != "off"
        made = RerunRecording(self.mode, name, path, self.address)
        if made.url is not None:
            typer.echo(f"open {made.url} in a browser", err=True)
        return made


def keep_serving(mode: RerunMode) -> None:
    """Go on serving to browsers until Ctrl-C."""
    if mode != "serve":
        return
    typer.echo("serving until Ctrl-C", err=True)
    try:
        while True:
            time.sleep(1.0)
    except KeyboardInterrupt:
        return
