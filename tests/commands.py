# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph` as a process of its own that is ready at once: forked from one with the imports.

A new interpreter takes one to two seconds until it has imported what a command needs, which is more
than most commands then take. Here one process imports it once; each command is a child of that
process, with its own folder, environment, output, limits, and end of the interpreter. Nothing of
the tests' process is in it. What is about imports, or about signals while they are done, starts an
interpreter instead.
"""

import atexit
import gc
import json
import os
import resource
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import typer.main
from limits import HANG_S
from unrendered import render_nothing

IMPORTED = (
    "slam_graph.cli.main",
    "slam_graph.config",
    "slam_graph.datasets.dataset_registry",
    "slam_graph.experiment.comparison",
    "slam_graph.frontend",
    "slam_graph.pipeline.run_recording",
    "slam_graph.results.run_result",
    "slam_graph.simulation.simulator",
)
"""Not Matplotlib and Rerun: they look at the environment, and start threads."""

Done = subprocess.CompletedProcess[str]


def slam_graph(
    *arguments: str | Path,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    limit: int | None = None,
    rendered: bool = False,
) -> Done:
    """Run a command to its end, as `subprocess.run` with `capture_output` does.

    Args:
        arguments: of `slam-graph`.
        cwd: the folder it runs in; the present one if not given.
        env: the whole environment; the present one if not given.
        limit: bytes that a file may have.
        rendered: whether pictures are rendered.
    """
    words = [str(argument) for argument in arguments]
    asked = {
        "words": words,
        "cwd": str(cwd or Path.cwd()),
        "env": dict(os.environ if env is None else env),
        "limit": limit,
        "rendered": rendered,
    }
    process = _forking_process()
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(json.dumps(asked) + "\n")
    process.stdin.flush()
    answer = process.stdout.readline()
    assert answer, "the process that is forked has ended"
    told = json.loads(answer)
    return subprocess.CompletedProcess(words, told["code"], told["out"], told["err"])


@cache
def _forking_process() -> "subprocess.Popen[str]":
    """The process with the imports; it ends when its input does."""
    process = subprocess.Popen(
        [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    atexit.register(process.communicate)
    return process


# --- in the process that is forked ----------------------------------------------------------------


def _serve() -> None:
    gc.disable()
    for name in IMPORTED:
        import_module(name)
    typer.main.get_command = cache(typer.main.get_command)
    typer.main.get_command(import_module("slam_graph.cli.main").app)
    gc.freeze()  # else each child looks at all that was imported when it ends, for half a second
    gc.enable()
    for line in sys.stdin:
        asked = json.loads(line)
        reading, writing = zip(os.pipe(), os.pipe(), strict=True)
        pid = os.fork()
        if pid == 0:
            _become(asked, writing)
            return  # the command follows, without anything of this loop around it
        for end in writing:
            os.close(end)
        out, err = _read(pid, reading)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        sys.stdout.write(json.dumps({"code": code, "out": out, "err": err}) + "\n")
        sys.stdout.flush()
    os._exit(0)


def _become(asked: dict[str, Any], writing: tuple[int, ...]) -> None:
    """The state of a new interpreter: streams, folder, environment, signals, limits, arguments."""
    for number, end in zip((0, 1, 2), (os.open(os.devnull, os.O_RDONLY), *writing), strict=True):
        os.dup2(end, number)
        os.close(end)
    sys.stdin, sys.stdout, sys.stderr = _stream(0, "r"), _stream(1, "w"), _stream(2, "w")
    os.setsid()
    os.chdir(asked["cwd"])
    os.environ.clear()
    os.environ.update(asked["env"])
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if asked["limit"] is not None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # to write gives an error then
        resource.setrlimit(resource.RLIMIT_FSIZE, (asked["limit"],) * 2)
    if not asked["rendered"]:
        render_nothing()
    sys.path[0] = asked["cwd"]
    sys.argv = ["slam-graph", *asked["words"]]


def _stream(number: int, mode: str) -> IO[str]:
    return open(number, mode, encoding="utf-8", closefd=False)


def _read(pid: int, reading: tuple[int, ...]) -> list[str]:
    """What a child writes to its streams; it is killed when it takes too long."""
    parts: dict[int, bytes] = dict.fromkeys(reading, b"")
    deadline = time.monotonic() + HANG_S
    with selectors.DefaultSelector() as selector:
        for end in reading:
            selector.register(end, selectors.EVENT_READ)
        while selector.get_map():
            if time.monotonic() > deadline:
                os.killpg(pid, signal.SIGKILL)  # with all processes that hold its streams
                break
            for key, _ in selector.select(timeout=1.0):
                part = os.read(key.fd, 1 << 16)
                parts[key.fd] += part
                if not part:
                    selector.unregister(key.fd)
    for end in reading:
        os.close(end)
    return [parts[end].decode(errors="replace") for end in reading]


if __name__ == "__main__":
    _serve()
    from slam_graph.cli.launch import main

    main()
