# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Starts the command line: Ctrl-C before and after the work ends it without a word.

Nothing has been written then, or all of it. In between `slam_graph.cli.main` decides.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from types import FrameType

_INTERRUPTED = 130


def _leave(signum: int, frame: FrameType | None) -> None:
    os._exit(_INTERRUPTED)  # an exception could not be raised in the middle of an import


def main() -> None:
    """Import the commands, and run the one that is asked for."""
    heard = signal.getsignal(signal.SIGINT) != signal.SIG_IGN  # of a job in the background
    for number in (signal.SIGINT, signal.SIGTERM):
        if heard or number == signal.SIGTERM:
            signal.signal(number, _leave)
    gc.disable()  # imports leave no garbage, and each collection would look at all of them
    from slam_graph.cli.main import run_command

    gc.freeze()
    gc.enable()
    if heard:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    code = run_command()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # all is written: what ends now is the interpreter
    gc.freeze()  # the interpreter would look through all that was imported once more, for nothing
    if code == _INTERRUPTED:
        # Python kills itself with SIGINT at its end where `exec` of a text was interrupted, as in
        # the import of a data class, although the interrupt was handled; the code would be lost
        sys.stderr.flush()
        os._exit(_INTERRUPTED)
    sys.exit(code)


if __name__ == "__main__":
    main()
