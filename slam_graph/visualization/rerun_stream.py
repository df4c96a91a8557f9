# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A recording stream of Rerun: to a file, a window, a viewer that is open, or a browser."""

from __future__ import annotations

import ctypes
import os
import shutil
import socket
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.errors import DataError
from slam_graph.files import Files

RerunMode = Literal["save", "spawn", "connect", "serve"]

FRAME, SENSOR_TIME = "frame", "sensor_time"
"""The timelines: number of the frame, and its time on the clock of the sensors."""

DEFAULT_ADDRESS = "rerun+http://127.0.0.1:9876/proxy"

_ABSOLUTE_NS = 10**17
"""Stamps from here on (three years after 1970) are shown as dates, others as seconds."""

_TICK_S, _CHUNK_BYTES = 60.0, 8 << 20

_ROWS_IN_FILES = 400
"""Rows that are sent together where nobody waits for them: one by one they cost more time."""

_CONNECT_TIMEOUT_S = 3.0

_FLUSH_S = 5.0
"""A file that does not grow for so long while it is flushed cannot be written."""

_QUIET = "warn,re_log_encoding=off,re_sdk=off"
"""What Rerun logs on stderr: of files that cannot be written we tell ourselves."""


class RerunStream:
    """A recording stream of its own, with the two timelines of this package.

    Args:
        mode: `save` to a file, `spawn` a window, `connect` to a viewer that is open, or `serve` to
            browsers.
        name: of the recording.
        path: of the file to save; it appears when the stream is closed.
        address: of the viewer to connect to.

    Attributes:
        rr: the module `rerun`.
        saves: whether it goes to a file.
        url: where a browser shows a recording that is served; None in other modes.

    Raises:
        DataError: if no viewer can be shown or reached, or the file cannot be written.
    """

    def __init__(
        self, mode: RerunMode, name: str, path: Path | None = None, address: str | None = None
    ) -> None:
        rerun = _rerun()
        self.rr: Any = rerun
        self.url: str | None = None
        self._closed = False
        # a file is written in large pieces: small ones have more frame than content
        batches = rerun.ChunkBatcherConfig(flush_tick=_TICK_S, flush_num_bytes=_CHUNK_BYTES)
        self.saves = mode == "save"
        self._raw: Any = rerun.RecordingStream(
            "slam_graph", batcher_config=batches if self.saves else None
        )
        for switch in (rerun.set_log_time_enabled, rerun.set_log_tick_enabled):
            switch(False, recording=self._raw)
        self._path = self._partial = path if mode == "save" else None
        self._absolute: bool | None = None
        self._layout: Any = None
        self._now = (0, 0)
        self._kept: dict[str, tuple[Any, list[tuple[int, int]], list[Mapping[str, Any]]]] = {}
        if mode == "save":
            self._save(path)
        elif mode == "spawn":
            self._spawn()
        elif mode == "connect":
            address = address or DEFAULT_ADDRESS
            require_viewer(address)
            self._raw.connect_grpc(address)
        else:
            self._serve()
        self._raw.send_recording_name(name)

    def at(self, frame: int, stamp_ns: int) -> None:
        """Set the time of what is logged next."""
        self._now = frame, stamp_ns
        self._raw.set_time(FRAME, sequence=frame)
        self._raw.set_time(SENSOR_TIME, **self._time(np.int64(stamp_ns)))

    def log(self, entity: str, *what: Any, static: bool = False) -> None:
        """Log something at the time that was set, or for all times."""
        self._raw.log(entity, *what, static=static)

    def log_rows(self, entity: str, kind: Any, **fields: Any) -> None:
        """Log things of one kind at the time that was set: in a file many times together.

        Args:
            entity: where; of it all calls have the same kind and fields.
            kind: an archetype of Rerun.
            fields: of the things (M, …), each of the same length.
        """
        if not self.saves:
            self.log(entity, kind.from_fields(**fields))
            return
        _, times, rows = self._kept.setdefault(entity, (kind, [], []))
        times.append(self._now)
        rows.append(fields)
        if len(times) >= _ROWS_IN_FILES:
            self._send_kept(entity)

    def _send_kept(self, entity: str) -> None:
        kind, times, rows = self._kept.pop(entity)
        lengths = [len(next(iter(fields.values()))) for fields in rows]
        frames, stamps_ns = np.array(times, np.int64).T
        together = {name: np.concatenate([fields[name] for fields in rows]) for name in rows[0]}
        columns = kind.columns(**together).partition(lengths)
        self.send_columns(entity, frames, stamps_ns, columns)

    def send_columns(
        self, entity: str, frames: IntArray, stamps_ns: IntArray, columns: Any
    ) -> None:
        """Log N rows at their times at once.

        Args:
            entity: where.
            frames: (N,) numbers of the frames.
            stamps_ns: (N,) times.
            columns: of an archetype of Rerun.
        """
        if len(frames) == 0:
            return
        times = [
            self.rr.TimeColumn(FRAME, sequence=frames),
            self.rr.TimeColumn(SENSOR_TIME, **self._time(stamps_ns)),
        ]
        self._raw.send_columns(entity, indexes=times, columns=columns)

    def send_along(self, entity: str, times: Any, columns: Any) -> None:
        """Log N rows on a timeline of their own.

        Args:
            entity: where.
            times: `TimeColumn` of Rerun.
            columns: of an archetype of Rerun.
        """
        self._raw.send_columns(entity, indexes=[times], columns=columns)

    def arrange(self, blueprint: Any) -> None:
        """Send the layout of the viewer; a file gets the last one only, as each is 0.2 MB."""
        if self.saves:
            self._layout = blueprint
        else:
            self._raw.send_blueprint(blueprint)

    def close(self) -> None:
        """Send what is left; a saved file appears under its name. A server goes on serving."""
        for entity in list(self._kept):
            self._send_kept(entity)
        if self._layout is not None:
            self._raw.send_blueprint(self._layout)
            self._layout = None
        self._flush()
        self._closed = True
        if self.url is not None:  # to disconnect would end it
            return
        self._raw.disconnect()
        if self._path is not None and self._partial is not None:
            with Files.writing(self._path):
                os.replace(self._partial, self._path)
            self._partial = None

    def _flush(self) -> None:
        """Send what is left. Its file must grow: on a full disk Rerun waits for ever.

        Raises:
            DataError: if the file cannot be written.
        """
        if self._partial is None:
            self._raw.flush()
            return
        size = -1
        while True:
            try:
                self._raw.flush(timeout_sec=_FLUSH_S)
                return
            except (RuntimeError, ValueError) as error:
                before, size = size, self._partial.stat().st_size
                if size == before:
                    self._abandon()
                    raise DataError(
                        f"{self._path}: cannot be written; is the disk full?"
                    ) from error

    def _abandon(self) -> None:
        """Leave a stream whose file cannot be written as it is, for good.

        Rerun would wait for ever for the thread that wrote it, when the stream is disconnected or
        collected, and at the end of the process.
        """
        self._closed = True
        if self._partial is not None:
            self._partial.unlink(missing_ok=True)
        self.rr.unregister_shutdown()
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._raw))

    def discard(self) -> None:
        """End without what was sent: no file appears. A stream that is closed stays as it is."""
        if self._closed:
            return
        self._raw.disconnect()
        if self._partial is not None:
            self._partial.unlink(missing_ok=True)
            self._partial = None

    def _time(self, stamps_ns: Any) -> Mapping[str, Any]:
        """Stamps as dates or, where they count from another time than 1970, as seconds."""
        if self._absolute is None:
            self._absolute = bool(np.max(stamps_ns) >= _ABSOLUTE_NS)
        if self._absolute:
            return {"timestamp": stamps_ns.astype("datetime64[ns]")}
        return {"duration": stamps_ns.astype("timedelta64[ns]")}

    def _save(self, path: Path | None) -> None:
        if path is None:
            raise ValueError("a recording to save needs a path")
        self._partial = path.with_name(f".{path.name}.partial")
        try:
            self._partial.touch()
        except OSError as error:
            raise DataError(f"{path}: cannot be written ({error.strerror})") from error
        self._raw.save(self._partial)

    def _spawn(self) -> None:
        if not has_display():
            raise DataError(
                "cannot open a Rerun window: there is no display (DISPLAY and WAYLAND_DISPLAY are "
                "not set); use --rerun save, or --rerun serve for a browser"
            )
        # the viewer of this installation, which need not be on the path
        places = [sysconfig.get_path("scripts"), os.environ.get("PATH", "")]
        viewer = shutil.which("rerun", path=os.pathsep.join(places))
        try:
            self.rr.spawn(executable_path=viewer, recording=self._raw)
            # of a viewer that ends at once, as on a display that is gone, Rerun only warns
            require_viewer(DEFAULT_ADDRESS)
        except DataError as error:
            raise DataError(
                "cannot open a Rerun window: the viewer did not start; use --rerun save, or "
                "--rerun serve for a browser"
            ) from error
        except (RuntimeError, OSError) as error:
            first = str(error).splitlines()[0]
            raise DataError(f"cannot open a Rerun window ({first}); use --rerun save") from error

    def _serve(self) -> None:
        try:
            source = self._raw.serve_grpc(grpc_port=free_port())
            port = free_port()
            self.rr.serve_web_viewer(web_port=port, open_browser=False, connect_to=source)
        except (RuntimeError, OSError, ValueError) as error:
            first = str(error).splitlines()[0]
            raise DataError(f"cannot serve to browsers ({first}); use --rerun save") from error
        self.url = f"http://localhost:{port}/?url={source.replace('+', '%2B')}"


def _rerun() -> Any:
    """The module `rerun`; what it logs is settled when it is first imported."""
    given = os.environ.get("RUST_LOG")
    if given is None:
        os.environ["RUST_LOG"] = _QUIET
    try:
        import rerun
    finally:
        if given is None:
            del os.environ["RUST_LOG"]
    return rerun


def has_display() -> bool:
    """Whether a window can be opened here."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def require_viewer(address: str) -> None:
    """Make sure that something listens at an address.

    Raises:
        DataError: if nothing does, or the address is none.
    """
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or not port or not parts.scheme.startswith("rerun"):
        raise DataError(f"{address}: no address of a viewer; one looks like {DEFAULT_ADDRESS}")
    try:
        socket.create_connection((host, port), _CONNECT_TIMEOUT_S).close()
    except OSError as error:
        raise DataError(
            f"{address}: no Rerun viewer can be reached ({error.strerror or error}); start one "
            "with `rerun`, or use --rerun save"
        ) from error


def free_port() -> int:
    """A port of this machine that nothing listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port
