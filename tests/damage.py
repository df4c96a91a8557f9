# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Damages files in many ways, and judges how they are read.

`SLAM_GRAPH_MUTATIONS=20000` makes a campaign of it, with new mutations each time.
"""

import os
import random
import shutil
import time
import traceback
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import pytest

from slam_graph.errors import SlamGraphError
from slam_graph.settings import tree

CAMPAIGN = int(os.environ.get("SLAM_GRAPH_MUTATIONS", "0"))
SEED = os.environ.get("SLAM_GRAPH_MUTATIONS_SEED", str(time.time_ns()) if CAMPAIGN else "0")
HALVES = range(100), range(100, 200)
"""Numbers of the mutations of a file: `make test` tries the first half, `make slow` the second."""

half = 0
"""Which of the two is tried; the fixture of this name sets it."""

ON_LINUX = Path("/proc/self/status").exists()

MOST_S, MOST_MB = 2.0, 256.0
"""No damaged file of some 10 kB may take more time of the CPU and more memory."""

NUMBERS = (
    b"nan inf -inf 1e308 -1e308 1e-320 1e30 1e9999999 0 -0.0 -1 0.5 1_0 0x10 007 "
    b"9223372036854775807 -9223372036854775808 9223372036854775808 4294967296 65536 255"
)
PIECES = [
    *NUMBERS.split(),
    *(b"\0", b"\xff", b"\xc3\x28", b"\n", b",", b" ", b":", b"- ", b"&a ", b"*a", b"[", b"}", b"#"),
    *(b"!!int ", b"2001-13-41", b"..", b"/", "é".encode(), b"1" * 5000, b"\xff" * 8),
]


Edit = tuple[str, float, float, bytes]
"""What is done to a file: a kind, two places as parts of its length, and some bytes."""

KINDS = ["flip", "cut", "number", "insert", "double", "swap", "remove"]


def edits(number: int) -> list[Edit]:
    """The mutation of a number: one to four edits."""
    rng = random.Random(f"{SEED}/{number}")
    return [
        (rng.choice(KINDS), rng.random(), rng.random(), rng.choice(PIECES))
        for _ in range(rng.randint(1, 4))
    ]


def damaged(content: bytes, changes: list[tuple[str, float, float, bytes]]) -> bytes:
    """The content after some changes."""
    for kind, first, second, piece in changes:
        at = int(first * len(content))
        if kind == "flip":
            flipped = bytes([content[at] ^ (1 << int(second * 8))]) if content else b""
            content = content[:at] + flipped + content[at + 1 :]
        elif kind == "cut":
            content = content[:at]
        elif kind == "insert":
            content = content[:at] + piece + content[at:]
        elif kind == "number":
            begin, end = token(content, at)
            content = content[:begin] + piece + content[end:]
        else:
            lines = content.splitlines(keepends=True) or [b""]
            one, other = int(first * len(lines)), int(second * len(lines))
            if kind == "double":
                lines.insert(other, lines[one])
            elif kind == "swap":
                lines[one], lines[other] = lines[other], lines[one]
            else:
                del lines[one]
            content = b"".join(lines)
    return content


def token(content: bytes, at: int) -> tuple[int, int]:
    """Where the word at a place begins and ends."""
    begin = end = at
    while begin > 0 and content[begin - 1] not in b" ,\n\t:[]":
        begin -= 1
    while end < len(content) and content[end] not in b" ,\n\t:[]":
        end += 1
    return begin, end


def tried(
    file: Path, read: Callable[[], object], in_ci: int | None = None, most_s: float = MOST_S
) -> None:
    """Damage a file in many ways, and read it each time.

    All failures are collected, the first of each kind, each with its damaged file beside `file`.

    Args:
        file: a valid one.
        read: reads it, and does what is to be done with what it says.
        in_ci: how many ways, outside of campaigns; those of the present half if not given.
        most_s: time of the CPU that it may take.
    """
    whole = file.read_bytes()
    read()  # it is valid
    read()  # what is loaded once is loaded
    failures: dict[str, str] = {}
    numbers = HALVES[half] if in_ci is None else range(in_ci)
    if CAMPAIGN:  # the slow half tries as many others
        numbers = range(half * CAMPAIGN, (half + 1) * CAMPAIGN)
    with pytest.MonkeyPatch.context() as patch:
        # of the other files, which are the same each time, YAML is parsed once
        patch.setattr(tree, "parse_node", lru_cache(maxsize=16)(tree.parse_node))
        for number in numbers:
            file.unlink()  # a file that is cut and written again is waited for until it is on disk
            file.write_bytes(damaged(whole, edits(number)))
            failure = failure_of(read, most_s)
            if failure is not None and failure[0] not in failures:
                kept = shutil.copy(file, file.with_name(f"{file.name}.damaged{number}"))
                said = f"mutation {number} of seed {SEED}, kept as {kept}: {failure[1]}"
                failures[failure[0]] = said
    file.write_bytes(whole)
    assert not failures, "\n\n".join(failures.values())


def memory_mb(reset: bool = False) -> float:
    """Peak of the resident memory since it was reset; 0 where the system does not say it."""
    if not ON_LINUX:
        return 0.0
    if reset:
        with open("/proc/self/clear_refs", "wb", buffering=0) as file:
            file.write(b"5")
    with open("/proc/self/status", "rb", buffering=0) as file:
        status = file.read(1 << 14)
    return int(status.partition(b"VmHWM:")[2].split(maxsplit=1)[0]) / 1024


def failure_of(read: Callable[[], object], most_s: float = MOST_S) -> tuple[str, str] | None:
    """What is wrong with how a damaged file is read: its kind and a text; None if nothing is."""
    begin_s, before_mb = time.process_time(), memory_mb(reset=True)
    try:
        read()
    except SlamGraphError as error:
        said = str(error)
        if "\n" in said or len(said) > 2000:
            return "text", f"not one short line: {said!r}"
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        kind = f"{type(error).__name__} in {place.filename}:{place.lineno}"
        return kind, "".join(traceback.format_exception(error))
    taken_s = time.process_time() - begin_s
    more_mb = memory_mb() - before_mb
    if taken_s > most_s or more_mb > MOST_MB:
        return "cost", f"{taken_s:.1f} s and {more_mb:.0f} MB for a small file"
    return None
