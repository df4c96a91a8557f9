# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A function that is called again and again, in turn with the caller or in a process beside it.

The process is forked: it has a copy of all that is there at that moment, so nothing that it works
with (a recording, a front end) needs to be pickled, and starting it takes milliseconds. What it is
given and gives back goes through a socket; arrays as large as images go through shared memory.
"""

from __future__ import annotations

import gc
import mmap
import pickle
import signal
import sys
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import current_process, get_all_start_methods, get_context
from multiprocessing.connection import Connection, Pipe
from typing import Any, Generic, NoReturn, TypeVar

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError, SlamGraphError
from slam_graph.interrupts import Interrupts

_PROTOCOL = 5
"""Of pickle: the first one that leaves out large arrays."""

_LARGE = 1 << 15
"""Bytes from which on an array goes through shared memory."""

_GRACE_S = 2.0
"""Time for the process to end, when it is not wanted any more, before it is killed."""

_END = b""
"""Message that ends the process."""

A = TypeVar("A")
R = TypeVar("R")


class CallInTurn(Generic[A, R]):
    """A call that is done when its result is asked for."""

    def __init__(self, function: Callable[[A], R]) -> None:
        self._function = function

    def begin(self, argument: A) -> None:
        """Ask for the next call."""
        self._argument = argument

    def result(self) -> R:
        """The result of the call that was asked for last; raises what the function raises."""
        return self._function(self._argument)

    def close(self) -> None:
        """Nothing is left to do."""


class ForkedCall(Generic[A, R]):
    """A call that is done in a process of its own, while the caller does other work.

    The process ends with this one, however that ends: the socket between them is closed then. It
    leaves Ctrl-C to this one; SIGTERM ends it, and is an interruption of this one.

    Args:
        function: called in the process, one call after the other. What it changes is seen by later
            calls, and by nobody else.
        room: bytes of all large arrays of one result. What does not fit goes through the socket.
        diagnostics: that the function warns by. The warnings are counted and logged here, when the
            result is asked for.
    """

    def __init__(self, function: Callable[[A], R], room: int, diagnostics: Diagnostics) -> None:
        self._diagnostics = diagnostics
        self._connection, theirs = Pipe()
        self._arrays = _SharedArrays(room)
        self._process = get_context("fork").Process(
            target=_serve,
            args=(function, theirs, self._connection, self._arrays, diagnostics),
            daemon=True,
        )
        with warnings.catch_warnings():
            # Python 3.12 warns where there are threads. Those of OpenBLAS end before a fork, OpenCV
            # does without its own, and no other one shares a lock with the function.
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process.start()
        theirs.close()

    @staticmethod
    def is_possible() -> bool:
        """Whether a process can be forked here.

        Libraries of macOS do not survive it, and a daemon of `multiprocessing` may not.
        """
        forks = "fork" in get_all_start_methods() and sys.platform != "darwin"
        return forks and not current_process().daemon

    def begin(self, argument: A) -> None:
        """Ask for the next call, after the result of the one before.

        Raises:
            EstimationError: if the process has ended.
        """
        try:
            self._connection.send_bytes(pickle.dumps(argument, _PROTOCOL))
        except OSError:
            self._lost()

    def result(self) -> R:
        """Wait for the result of the call that was asked for last.

        Raises:
            EstimationError: if the process has ended.
            Exception: what the function raises.
        """
        try:
            message = self._connection.recv_bytes()
        except (EOFError, OSError):
            self._lost()
        outcome: _Outcome[R] = self._arrays.unpacked(message)
        for warning in outcome.warnings:
            self._diagnostics.warn(*warning)
        if outcome.error is not None:
            raise outcome.error
        return outcome.value  # type: ignore[return-value]  # the value of a call that did not fail

    def close(self) -> None:
        """End the process."""
        with suppress(OSError):
            self._connection.send_bytes(_END)  # another fork may hold this end of the socket too
        self._connection.close()
        self._process.join(_GRACE_S)
        self._process.kill()
        self._process.join()

    def _lost(self) -> NoReturn:
        """The process has ended without being asked to."""
        self._process.join()
        code = self._process.exitcode or 0
        if code == -signal.SIGTERM:
            raise KeyboardInterrupt from None  # this process is sent it too, perhaps later
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        raise EstimationError(
            f"the process of the front end has ended ({how}); "
            "overlap=false runs it in the process of the back end"
        ) from None


@dataclass(frozen=True)
class _Outcome(Generic[R]):
    """What came of a call: a value or an error, and warnings (kind, message)."""

    value: R | None
    error: Exception | None
    warnings: list[tuple[str, str]]


class _SharedArrays:
    """Sends and receives objects, their large arrays through memory that two processes share.

    There is room for two objects: one may be received while the next one is sent.

    Args:
        room: bytes of the large arrays of one object.
    """

    def __init__(self, room: int) -> None:
        self._room, self._turn = room, 0
        self._memory = memoryview(mmap.mmap(-1, max(2 * room, 1)))  # shared with what is forked

    def packed(self, thing: object) -> bytes:
        """A message with an object, whose arrays may change afterwards."""
        self._turn = 1 - self._turn
        begin = self._turn * self._room
        end = begin + self._room
        places: list[tuple[int, int]] = []

        def stays(array: pickle.PickleBuffer) -> bool:
            """Whether an array stays in the message; else its bytes are put into the memory."""
            nonlocal begin
            raw = array.raw()
            if raw.nbytes < _LARGE or begin + raw.nbytes > end:
                return True
            places.append((begin, begin + raw.nbytes))
            self._memory[slice(*places[-1])] = raw
            begin += raw.nbytes
            return False

        pickled = pickle.dumps(thing, _PROTOCOL, buffer_callback=stays)
        return pickle.dumps((pickled, places), _PROTOCOL)

    def unpacked(self, message: bytes) -> Any:
        """The object of a message, with arrays of its own."""
        pickled, places = pickle.loads(message)
        arrays = [bytearray(self._memory[slice(*place)]) for place in places]
        return pickle.loads(pickled, buffers=arrays)


def _serve(
    function: Callable[[A], R],
    connection: Connection,
    of_parent: Connection,
    arrays: _SharedArrays,
    diagnostics: Diagnostics,
) -> None:
    """The life of the process: do calls until it is told to end, or nobody is there any more."""
    of_parent.close()  # or it would never be closed
    Interrupts.leave_to_parent()
    gc.freeze()  # a collection would copy all memory that is still shared
    held = diagnostics.hold()
    with suppress(EOFError, OSError):
        while asked := connection.recv_bytes():
            try:
                answer = arrays.packed(_Outcome(function(pickle.loads(asked)), None, held))
            except Exception as error:
                answer = arrays.packed(_Outcome(None, _portable(error), held))
            held.clear()
            connection.send_bytes(answer)


def _portable(error: Exception) -> Exception:
    """An error that can be sent; where it is not one of ours it tells where it was raised."""
    if not isinstance(error, SlamGraphError):
        error.add_note("".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error, _PROTOCOL))
    except Exception:
        told = RuntimeError(f"{type(error).__name__}: {error}")
        told.__notes__ = getattr(error, "__notes__", [])
        return told
    return error
