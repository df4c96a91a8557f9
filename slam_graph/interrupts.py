# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Signals: what may not be cut in two, SIGTERM as Ctrl-C, and processes that outlive nobody."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["Interrupts"]

_GRACE_S = 10.0
"""Time for a process to end after Ctrl-C before it is killed."""


@contextmanager
def completed() -> Iterator[Callable[[], None]]:
    """Let Ctrl-C wait until the block has ended; a second one takes effect at once.

    Outside the main thread, which alone gets signals, this changes nothing.

    Yields:
        A function to call where the part of the block begins that is to be completed.

    Raises:
        KeyboardInterrupt: at the end, if there was a Ctrl-C meanwhile.
    """
    pending = False
    before = None

    def note(signum: int, frame: FrameType | None) -> None:
        nonlocal pending
        if pending:
            raise KeyboardInterrupt
        pending = True

    def begin() -> None:
        nonlocal before
        if threading.current_thread() is threading.main_thread():
            before = signal.signal(signal.SIGINT, note)

    try:
        yield begin
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)
    if pending:
        raise KeyboardInterrupt


def terminate_like_interrupt() -> None:
    """From now on SIGTERM does what SIGINT does then, unless it does something already."""
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _pass_on)


def _pass_on(signum: int, frame: FrameType | None) -> None:
    handler = signal.getsignal(signal.SIGINT)
    if callable(handler):
        handler(signum, frame)
    else:
        raise KeyboardInterrupt


def end_with(pipe: int) -> None:
    """End this process, as by Ctrl-C, when the other end of a pipe is closed.

    The process that holds that end need not do anything: it is closed also when it is killed.

    Args:
        pipe: file descriptor to read from; nothing is ever written to it.
    """

    def wait() -> None:
        while os.read(pipe, 1):
            continue
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(_GRACE_S)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=wait, daemon=True).start()


class Interrupts:
    """What is done about signals."""

    completed = staticmethod(completed)
    end_with = staticmethod(end_with)
    terminate_like_interrupt = staticmethod(terminate_like_interrupt)
