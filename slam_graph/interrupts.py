# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Signals: work that Ctrl-C must not cut, SIGTERM as Ctrl-C, children that end with us."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TypeAlias

__all__ = ["Interrupts"]

_GRACE_S = 10.0
"""Time for a process to end after Ctrl-C before it is killed."""
_deferring: list[Deferred] = []
"""Who defers signals in the main thread, the innermost last."""


class Deferred:
    """Notes the first SIGINT or SIGTERM; a second one takes effect at once.

    Attributes:
        heard: whether there was a signal.
    """

    def __init__(self) -> None:
        self.heard = False
        self._answered = False  # the signal that was heard has taken effect
        self._at_once = False
        self._before: signal._HANDLER | None = None

    def __call__(self, signum: int, frame: FrameType | None) -> None:
        """Note a signal."""
        raises = self.heard or self._at_once
        self.heard = True
        if raises:
            raise KeyboardInterrupt

    def install(self) -> None:
        """Take the place of the handler; SIGINT stays ignored where it is, as in a background job.

        Outside the main thread, which alone gets signals, this changes nothing.
        """
        if threading.current_thread() is not threading.main_thread():
            return
        if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
            self._before = signal.signal(signal.SIGINT, self)
        _deferring.append(self)

    def restore(self) -> None:
        """Give the place back."""
        if self in _deferring:
            _deferring.remove(self)
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def check(self) -> None:
        """Let a signal that was noted take effect.

        Raises:
            KeyboardInterrupt: if there was one.
        """
        if self.heard:
            self._answered = True
            raise KeyboardInterrupt

    def take(self) -> bool:
        """Whether there was a signal that has not taken effect; it counts as answered from now."""
        pending = self.heard and not self._answered
        self._answered |= pending
        return pending

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Let a signal take effect within the block, whatever other libraries make of it.

        An import or a callback from C may turn the interrupt into an error of its own, or lose it.

        Raises:
            KeyboardInterrupt: if there was a signal in the block, at its end at the latest.
        """
        before, self.heard = self.heard, False
        self._at_once = True
        try:
            yield
        except Exception as error:
            if self.heard:
                raise KeyboardInterrupt from error
            raise
        finally:
            self._at_once = False
            interrupted, self.heard = self.heard, before or self.heard
            self._answered |= interrupted
        if interrupted:
            raise KeyboardInterrupt


@contextmanager
def completed() -> Iterator[Callable[[], None]]:
    """Let Ctrl-C and SIGTERM wait until the block has ended; a second one takes effect at once.

    Yields:
        A function to call where the part of the block begins that is to be completed.

    Raises:
        KeyboardInterrupt: at the end, if there was a Ctrl-C meanwhile; where another block defers
            it, too, that one notes it.
    """
    handler = Deferred()
    try:
        yield handler.install
    finally:
        handler.restore()
    if handler.heard:
        _pass_on(signal.SIGINT, None)


@contextmanager
def deferred() -> Iterator[Deferred]:
    """Let Ctrl-C take effect where the block checks for it, so that no step is left half done.

    A second one takes effect at once.

    Yields:
        Its `check` raises KeyboardInterrupt after a Ctrl-C; `at_once` lets it take effect.
    """
    handler = Deferred()
    try:
        handler.install()
        yield handler
    finally:
        handler.restore()


def check_deferred() -> None:
    """Let a signal that a block around this one defers take effect, where a long wait may be cut.

    Raises:
        KeyboardInterrupt: if there was one.
    """
    if _deferring and threading.current_thread() is threading.main_thread():
        _deferring[-1].check()


def terminate_like_interrupt() -> None:
    """From now on SIGTERM does what SIGINT does then, unless it does something already."""
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _pass_on)


def _pass_on(signum: int, frame: FrameType | None) -> None:
    handler = _deferring[-1] if _deferring else signal.getsignal(signal.SIGINT)
    if callable(handler):
        handler(signum, frame)
    else:
        raise KeyboardInterrupt


def end_with(pipe: int) -> None:
    """End this process by SIGTERM when the other end of a pipe is closed.

    The process that holds that end need not do anything: it is closed also when it is killed.
    Needs `terminate_like_interrupt`, which makes that an orderly end: a background job of a shell
    ignores SIGINT.

    Args:
        pipe: file descriptor to read from; nothing is ever written to it.
    """

    def wait() -> None:
        while os.read(pipe, 1):
            continue
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_GRACE_S)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=wait, daemon=True).start()


def leave_to_parent() -> None:
    """Let Ctrl-C do nothing in this process, whose parent gets it too, and SIGTERM end it."""
    signal.set_wakeup_fd(-1)  # of an event loop of the parent
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


class Interrupts:
    """What is done about signals.

    Attributes:
        Deferral: what `deferred` yields.
    """

    Deferral: TypeAlias = Deferred
    check_deferred = staticmethod(check_deferred)
    completed = staticmethod(completed)
    deferred = staticmethod(deferred)
    end_with = staticmethod(end_with)
    leave_to_parent = staticmethod(leave_to_parent)
    terminate_like_interrupt = staticmethod(terminate_like_interrupt)
