# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings in the viewer of Rerun: in a window, in a browser, or as a picture without either."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.visualization.rerun_stream import (
    DEFAULT_ADDRESS,
    free_port,
    has_display,
    require_viewer,
)

_START_S, _SETTLE_S, _PERIOD_S = 20.0, 40.0, 1.0
"""Longest times to wait for the viewer and for a picture that does not change; time between two."""

_OPENS_S = 3.0
"""A viewer that runs for so long has found its display; it goes on by itself."""

_OTHER_WAYS = "use --rerun serve for a browser, or --screenshot PICTURE.png"

_SAME = 0.2
"""Mean difference of the grey values of two pictures that are the same."""

_NO_GRAPHICS = (
    "no picture could be made: the viewer found no Vulkan driver. On a machine without a graphics "
    "card install a software one, e.g. `apt-get install mesa-vulkan-drivers`"
)


def save_screenshot(recording: Path, picture: Path, size: tuple[int, int] = (1600, 1000)) -> None:
    """A picture of how a recording opens in the viewer, without a window.

    Args:
        recording: `.rrd`.
        picture: PNG to write.
        size: width and height in pixels.

    Raises:
        DataError: if the recording cannot be read, or there is no driver to draw with.
    """
    require_readable(recording)
    require_picture(picture)
    port = free_port()
    command = [*_viewer_command(), "--headless", "--window-size", f"{size[0]}x{size[1]}"]
    command += ["--port", str(port), "--bind", "127.0.0.1", "--hide-welcome-screen", str(recording)]
    with tempfile.TemporaryFile() as output:
        viewer = subprocess.Popen(
            command,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**os.environ, "RUST_LOG": "error"},  # warnings would lie over the views
            start_new_session=True,
        )
        try:
            drawn = _settled_picture(viewer, f"rerun+http://127.0.0.1:{port}/proxy")
        finally:
            stop(viewer)
        output.seek(0)
        said = output.read().decode(errors="replace")
    if drawn is None:
        raise DataError(_reason(said))
    smaller = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)
    good, data = cv2.imencode(".png", smaller, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert good
    with Files.appearing(picture) as partial:
        partial.write_bytes(data.tobytes())


def require_picture(picture: Path) -> None:
    """Make sure that a picture can be written, before the work is done; its folder is made.

    Raises:
        DataError: if it has another suffix than `.png`, or cannot be written there.
    """
    if picture.suffix.lower() != ".png":
        raise DataError(f"{picture}: cannot be written; screenshots are .png")
    try:
        picture.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=picture.parent):
            pass
    except OSError as error:
        raise DataError(f"{picture}: cannot be written ({error.strerror})") from error
    if picture.is_dir():
        raise DataError(f"{picture}: is a folder; name a file")
    if picture.exists() and not os.access(picture, os.W_OK):
        raise DataError(f"{picture}: cannot be replaced; it is write-protected")


def require_readable(recording: Path) -> None:
    """Make sure that a recording can be read to its end: the viewer would show what it can.

    Raises:
        DataError: if there is no such file, or it is damaged.
    """
    from rerun.chunk import RrdReader

    if not recording.is_file():
        raise DataError(f"{recording}: no such file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a recording without an index can be shown
            for _ in RrdReader(recording).stream():
                pass
    except (RuntimeError, OSError, ValueError) as error:
        reason = " ".join(str(error).split()).rpartition(f"{recording}: ")[2]
        raise DataError(f"{recording}: damaged, or no recording of Rerun ({reason})") from error


def open_recording(recording: Path) -> None:
    """Open a recording in a window, and go on.

    Raises:
        DataError: if there is no such file, it is damaged, there is no display, or no window opens
            on it.
    """
    require_readable(recording)
    if not has_display():
        raise DataError(f"{recording}: cannot be shown here: there is no display; {_OTHER_WAYS}")
    viewer = subprocess.Popen([*_viewer_command(), str(recording)], start_new_session=True)
    with suppress(subprocess.TimeoutExpired):
        if viewer.wait(_OPENS_S) != 0:
            raise DataError(f"{recording}: no window could be opened; {_OTHER_WAYS}")


def serve_recording(recording: Path) -> tuple[subprocess.Popen[bytes], str]:
    """Serve a recording to browsers.

    Returns:
        The server, and the address to open.

    Raises:
        DataError: if there is no such file, or it is damaged.
    """
    require_readable(recording)
    port, web_port = free_port(), free_port()
    command = [*_viewer_command(), "--serve-web", "--port", str(port), "--bind", "127.0.0.1"]
    command += ["--web-viewer-port", str(web_port), str(recording)]
    environment = {**os.environ, "RUST_LOG": "error"}
    server = subprocess.Popen(command, env=environment, start_new_session=True)
    source = f"rerun%2Bhttp://localhost:{port}/proxy"
    return server, f"http://localhost:{web_port}/?url={source}"


def send_recording(recording: Path, address: str | None = None) -> None:
    """Send a recording to a viewer that is open.

    Args:
        recording: `.rrd`.
        address: of the viewer; None means the usual one.

    Raises:
        DataError: if there is no such file, it is damaged, or no viewer can be reached.
    """
    import rerun
    from rerun.chunk import RrdReader

    require_readable(recording)
    require_viewer(address or DEFAULT_ADDRESS)
    # with the id of the file nothing else appears in the viewer beside it
    stored = RrdReader(recording).recordings()[0]
    stream = rerun.RecordingStream(stored.application_id, recording_id=stored.recording_id)
    stream.connect_grpc(address or DEFAULT_ADDRESS)
    stream.log_file_from_path(recording)
    stream.flush()
    stream.disconnect()


def stop(viewer: subprocess.Popen[bytes]) -> None:
    """End a viewer that leads a session of its own, with the program that it has started."""
    with suppress(ProcessLookupError):
        os.killpg(viewer.pid, signal.SIGKILL)
    viewer.wait()


def _viewer_command() -> list[str]:
    """How the viewer is started that belongs to the installed library."""
    return [sys.executable, "-m", "rerun"]


def _settled_picture(viewer: subprocess.Popen[bytes], address: str) -> np.ndarray | None:
    """The first picture that does not change any more; None if the viewer ends before."""
    from rerun.experimental import ViewerClient

    client = last = None
    begin = time.monotonic()
    while viewer.poll() is None and time.monotonic() - begin < _START_S + _SETTLE_S:
        time.sleep(_PERIOD_S)
        try:
            client = client or ViewerClient.connect(address)
            data = client.take_screenshot()
        except (RuntimeError, OSError, ConnectionError):
            if time.monotonic() - begin > _START_S and client is None:
                break
            continue
        drawn = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if drawn is None:
            continue
        if last is not None and float(np.mean(cv2.absdiff(drawn, last))) < _SAME:
            return np.asarray(drawn)
        last = drawn
    return last


def _reason(said: str) -> str:
    """Why there is no picture, from what the viewer said."""
    low = said.lower()
    if any(word in low for word in ("adapter", "vulkan", "render context", "graphics")):
        return _NO_GRAPHICS
    lines = [line for line in said.splitlines() if line.strip()]
    return f"no picture could be made: {lines[-1] if lines else 'the viewer ended'}"
